"""`arctrack calibrate arc`: the arc's radius, place and brightness, and its metal, from the arc's light."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, check_outputs, finish
from arctrack.cli.setups import write_calibrated
from arctrack.errors import ArctrackError

REPORT = "calibrate_arc.html"

EXAMPLE = "Example: arctrack calibrate arc /tmp/straight --out /tmp/arc.toml"


def arc(
    recording: Annotated[
        Path, typer.Argument(help="A recording with frames of the arc alone, at several poses.")
    ],
    out: Out = None,
    report: Report = None,
) -> None:
    """Find the arc's radius, place and brightness, and the metal's reflectance, from frames of the arc alone.

    Frames with the arc on and the laser off are compared with the arc map. What they do not tell is refused
    and keeps its stated value: which frames would tell it is said, and which values cannot be told apart. The
    values go into [arc] and [material] of the setup, their covariance beside them.
    """
    from arctrack.calibrating.arc import arc_stage
    from arctrack.cli import console
    from arctrack.recording import read_recording
    from tracker.warm_up import heard_compilations

    read = read_recording(recording)
    console.warn(read.warnings)
    target = out or read.setup_path
    page_path = report or target.with_name(REPORT)
    check_outputs(target, page_path, read.setup_path, read)
    with console.progress() as bar, heard_compilations(console.compiling(bar, read.name)):
        stage, bad_frames = arc_stage(read, console.steps(bar))
    finish(stage.page, page_path)
    write_calibrated(target, read.setup_path, *stage.records)
    complaint = read.complaint(bad_frames, "the values are those of the others")
    if complaint is not None:
        raise ArctrackError(complaint)
