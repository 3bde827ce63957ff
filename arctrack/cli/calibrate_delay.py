"""`arctrack calibrate delay`: how late the poses' clock is, from a moving recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, check_outputs, finish
from arctrack.cli.setups import write_calibrated
from arctrack.errors import ArctrackError

REPORT = "calibrate_delay.html"

EXAMPLE = "Example: arctrack calibrate delay examples/v_groove --out /tmp/in_time.toml"


def delay(
    recording: Annotated[Path, typer.Argument(help="A recording whose tool weaves or rises as it travels.")],
    out: Out = None,
    report: Report = None,
) -> None:
    """Find the delay between poses and frames, with its sigma: the seam stands still, whatever the tool does.

    With a wrong delay the tool's own weave shows in the seam. The likelihood of a smooth seam is largest at
    the right one. It goes into the effect pose_delay of the setup. Where the motion is too weak, the answer
    is 'unestimated': what motion is missing is said, nothing but the page is written, and the exit code is 2.
    """
    from arctrack.calibration_files.delay_record import delay_record
    from arctrack.cli import console
    from arctrack.recording import read_recording
    from arctrack.report.calibration.delay import delay_page
    from calibration.pose_delay import MAX_TRACKINGS, PoseTrack, estimate_pose_delay
    from tracker.warm_up import heard_compilations

    read = read_recording(recording)
    console.warn(read.warnings)
    target = out or read.setup_path
    page_path = report or target.with_name(REPORT)
    check_outputs(target, page_path, read.setup_path, read)
    frames, bad_frames = read.readable_frames()
    track = PoseTrack.through(read.poses.timestamps_s, read.poses.T_base_tool)
    with console.progress() as bar:
        on_round = console.track(bar, "rounds", MAX_TRACKINGS, unit="rounds")
        try:
            with heard_compilations(console.compiling(bar, read.name)):
                result = estimate_pose_delay(read.setup, frames, track, lambda done, _: on_round(done))
        except ValueError as error:
            raise ArctrackError(f"{read.path}: {error}") from None
    finish(delay_page(result, read), page_path)
    if result.unestimated is not None:
        raise ArctrackError(f"{read.path}: the delay is unestimated: {result.unestimated}")
    write_calibrated(target, read.setup_path, delay_record(result))
    complaint = read.complaint(bad_frames, "the delay is that of the others")
    if complaint is not None:
        raise ArctrackError(complaint)
