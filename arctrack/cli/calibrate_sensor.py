"""`arctrack calibrate sensor`: gain, noise and response of a sensor from flat and dark frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, check_outputs, finish
from arctrack.cli.setups import read_setup, write_calibrated
from arctrack.errors import ArctrackError, in_file

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
    from arctrack.recording.setup_file import FILE_NAME

    if not source.is_dir():
        is_what = "is a file" if source.exists() else "there is no such folder"
        raise ArctrackError(f"{source}: {is_what}; give a folder of frames, or a recording")
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
    from arctrack.calibration_files.sensor_record import still_record
    from arctrack.calibration_files.still_recording import read_still_frames
    from arctrack.cli import console
    from arctrack.recording import read_recording
    from arctrack.report.calibration.still import still_page
    from calibration.sensor.still import calibrate_still

    read = read_recording(source, stated.path, must_fit=False)
    check_outputs(target, page_path, stated.path, read)
    with console.progress() as bar:
        try:
            frames, problems = read_still_frames(read, console.track(bar, read.name, len(read.rows)))
            result = calibrate_still(frames, read.setup.sensor)
        except ValueError as error:
            raise in_file(source, str(error)) from None
    console.warn(problems)
    finish(still_page(result, read.name, problems), page_path)
    write_calibrated(target, stated.path, still_record(result))


def _flat_fields(source: Path, stated: SetupFile, target: Path, page_path: Path, gamma: float | None) -> None:
    from arctrack.calibration_files.flat_frames import find_flat_frames, read_levels
    from arctrack.calibration_files.sensor_record import flat_record
    from arctrack.cli import console
    from arctrack.importing.grey import channel_of_laser
    from arctrack.report.calibration.sensor import sensor_page
    from calibration.sensor.flat_fields import calibrate_sensor

    files, vague = find_flat_frames(source)
    check_outputs(target, page_path, stated.path, images=[file.path for file in files])
    bits = stated.setup.sensor.bits
    with console.progress() as bar:
        task = bar.add_task("exposures", total=None, unit="exposures")
        try:
            levels, lossy = read_levels(
                files,
                channel_of_laser(stated.setup),
                bits,
                lambda done, total: bar.update(task, completed=done, total=total),
            )
            result = calibrate_sensor(levels, bits, gamma)
        except ValueError as error:
            raise in_file(source, str(error)) from None
    warnings = [*vague, *lossy]
    console.warn(warnings)
    finish(sensor_page(result, levels, source.name, warnings), page_path)
    write_calibrated(target, stated.path, flat_record(result))
