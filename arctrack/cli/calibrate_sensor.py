"""`arctrack calibrate sensor`: gain, noise and response of a sensor from flat and dark frames."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out, Report, run_calibration
from arctrack.cli.inputs import read_setup
from arctrack.errors import ArctrackError, no_such_path


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
    from arctrack.calibrate.sensor.flat_frames import find_flat_frames
    from arctrack.calibrate.sensor.stage import sensor_stage
    from arctrack.recording import read_recording

    run_calibration(
        "sensor",
        source,
        lambda steps, warn: sensor_stage(source, stated, steps, warn, gamma),
        setup=stated.path,
        out=out,
        report=report,
        recording=read_recording(source, stated.path, must_fit=False) if is_recording else None,
        images=() if is_recording else [file.path for file in find_flat_frames(source)[0]],
    )
