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
    from arctrack.calibrating.delay import delay_stage
    from arctrack.cli import console
    from arctrack.recording import read_recording
    from tracker.warm_up import heard_compilations

    read = read_recording(recording)
    console.warn(read.warnings)
    target = out or read.setup_path
    page_path = report or target.with_name(REPORT)
    check_outputs(target, page_path, read.setup_path, read)
    with console.progress() as bar, heard_compilations(console.compiling(bar, read.name)):
        stage, bad_frames = delay_stage(read, console.steps(bar))
    finish(stage.page, page_path)
    if stage.refusal is not None:
        raise ArctrackError(f"{read.path}: {stage.refusal}")
    write_calibrated(target, read.setup_path, *stage.records)
    complaint = read.complaint(bad_frames, "the delay is that of the others")
    if complaint is not None:
        raise ArctrackError(complaint)
