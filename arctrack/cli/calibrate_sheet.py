"""`arctrack calibrate sheet`: the laser sheet anew, from a scan of any flat plate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, check_outputs, run_calibration
from arctrack.cli.inputs import look_at_recording, read_setup
from arctrack.errors import ArctrackError


def sheet(
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="RECORDING...", help="Recordings of one plate that stays where it is."),
    ],
    setup: Annotated[
        Path | None, typer.Option(help="A recording.toml, or a recording; default: the first recording's.")
    ] = None,
    plate_mm: Annotated[
        float | None,
        typer.Option(
            help="How well the setup's joint states the plate's height, 1 sigma, mm; default: not at all."
        ),
    ] = None,
    out: Out = None,
    report: Report = None,
) -> None:
    """Correct the laser sheet from its stripe on any flat plate, scanned at two or three heights or tilts.

    It is for a laser that was knocked or put back: lens and the camera's pose in the tool stay as they are.
    The plate's own height and tilt are found as well, and the robot's error. What the plate does not tell of
    the sheet is named, with the motion that would. A bow stays as stated.
    """
    for folder in recordings:
        look_at_recording(folder, setup)
    from arctrack.calibrate.sheet.stage import sheet_stage
    from arctrack.cli import console
    from arctrack.recording import read_recording

    if plate_mm is not None and not plate_mm > 0.0:
        raise ArctrackError(f"--plate-mm {plate_mm:g}: must be > 0 mm")
    stated = read_setup(recordings[0] if setup is None else setup)
    read = [read_recording(folder, stated.path, must_fit=False) for folder in recordings]
    for recording in read:
        console.warn(recording.warnings)
    target = out or stated.path
    for recording in read[1:]:
        check_outputs(target, report or target.with_name("calibrate_sheet.html"), stated.path, recording)
    run_calibration(
        "sheet",
        read[0].path,
        lambda steps, warn: sheet_stage(read, stated, plate_mm, steps, warn),
        setup=stated.path,
        out=out,
        report=report,
        recording=read[0],
    )
