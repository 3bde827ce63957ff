"""`arctrack calibrate sensor`: gain, noise and response of a sensor from flat and dark frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, check_outputs, finish
from arctrack.cli.setups import read_setup, write_calibrated
from arctrack.errors import ArctrackError, no_such_path

if TYPE_CHECKING:
    from arctrack.recording import SetupFile

REPORT = "calibrate_sensor.html"

EXAMPLE = "Example: arctrack calibrate sensor /tmp/flats --setup examples/v_groove --out /tmp/sensor.toml"


def sensor(
    source: Annotated[
        Path, typer.Argument(help="Folder of flat and dark frames, or a recording of a still stripe.")
    ],
    setup: Annotated[
        Path | None,
        typer.Option(help="A recording.toml, or a recording, that it belongs to; default: the recording's."),
    ] = None,
    out: Out = None,
    report: Report = None,
    gamma: Annotated[float | None, typer.Option(help="Hold this gamma in place of fitting it.")] = None,
) -> None:
    """Find gain, read noise, black level, full well, gamma, DSNU and PRNU of a sensor, each with its sigma.

    The folder holds two or more frames of an even, steady light at five or more exposures, and two or more in
    the dark. Names say which is which: flat_2.5ms_1.png, dark_500us/0002.tif; or a table exposures.csv does,
    with file,exposure_ms,lit. What the frames cannot determine is refused, with the frames that are missing.

    Of a recording, twenty or more frames of the laser alone on a part at rest will do. They say gain, read
    noise, black level, and the speckle's contrast and grain, less sharply. Gamma and full well stay as
    stated.
    """
    from arctrack.recording.setup_writer import FILE_NAME

    if not source.is_dir():
        if source.exists():
            raise ArctrackError(f"{source}: is a file; give a folder of frames, or a recording")
        what = "there is no such folder; give a folder of frames, or a recording"
        raise no_such_path(source, what, Path.is_dir)
    is_recording = (source / FILE_NAME).exists()
    if setup is None and not is_recording:
        raise ArctrackError(f"{source}: holds flat and dark frames: give --setup, the setup of their sensor")
    if is_recording and gamma is not None:
        raise ArctrackError("--gamma: a still recording cannot tell it; state it in the setup")
    if gamma is not None and not 0.1 < gamma < 10.0:
        raise ArctrackError(f"--gamma {gamma:g}: a sensor's lies between 0.1 and 10")
    stated = read_setup(source if setup is None else setup)
    target = out or stated.path
    page_path = report or target.with_name(REPORT)
    if is_recording:
        _still_recording(source, stated, target, page_path)
    else:
        _flat_fields(source, stated, target, page_path, gamma)


def _still_recording(source: Path, stated: SetupFile, target: Path, page_path: Path) -> None:
    from arctrack.calibrate.sensor.stage import still_stage
    from arctrack.cli import console
    from arctrack.recording import read_recording

    read = read_recording(source, stated.path, must_fit=False)
    check_outputs(target, page_path, stated.path, read)
    with console.progress() as bar:
        stage = still_stage(read, console.steps(bar), console.warn)
    finish(stage.page, page_path)
    write_calibrated(target, stated.path, *stage.records)


def _flat_fields(source: Path, stated: SetupFile, target: Path, page_path: Path, gamma: float | None) -> None:
    from arctrack.calibrate.sensor.flat_frames import find_flat_frames
    from arctrack.calibrate.sensor.stage import flat_stage
    from arctrack.cli import console

    files, vague = find_flat_frames(source)
    check_outputs(target, page_path, stated.path, images=[file.path for file in files])
    console.warn(vague)
    with console.progress() as bar:
        stage = flat_stage(source, files, stated, console.steps(bar), console.warn, gamma)
    finish(stage.page, page_path)
    write_calibrated(target, stated.path, *stage.records)
