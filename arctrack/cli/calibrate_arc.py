"""`arctrack calibrate arc`: the arc's radius, place and brightness, and its metal, from the arc's light."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, calibrate_from_recording
from arctrack.cli.inputs import look_at_recording


def arc(
    recording: Annotated[
        Path, typer.Argument(help="A recording with frames of the arc alone, at several poses.")
    ],
    out: Out = None,
    report: Report = None,
) -> None:
    """Find the arc's radius, place and brightness, and the metal's reflectance, from frames of the arc alone.

    It compares frames with the arc on and the laser off with the arc map. A value that they do not determine
    keeps its stated one, and the page names the frames that would determine it. The values go into [arc] and
    [material] of the setup, with their covariance.
    """
    look_at_recording(recording)
    from arctrack.calibrate.arc.stage import arc_stage

    calibrate_from_recording("arc", arc_stage, recording, out, report)
