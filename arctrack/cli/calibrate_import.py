"""`arctrack calibrate import`: a lens that another program calibrated, into a setup."""

from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out
from arctrack.cli.inputs import (
    check_can_be_replaced,
    look_at_file,
    look_at_setup,
    read_setup,
    write_calibrated,
)
from arctrack.errors import in_file
from arctrack.output import real


def import_lens(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="mrcal's .cameramodel, Kalibr's camchain, ROS' camera_info, OpenCV's YAML or XML, HALCON's "
            "camera parameters as text; the content tells.",
        ),
    ],
    setup: Annotated[Path, typer.Option(help="A recording.toml, or a recording, to write the values into.")],
    out: Out = None,
    camera: Annotated[
        str | None, typer.Option(help="The camera in a file of several, such as cam0 of a camchain.")
    ] = None,
) -> None:
    """Take focal lengths, principal point and distortion from the file of another program.

    The file must be of the frames' size; camera_info's region of interest and binning are applied. To a
    distortion that OpenCV has not, such as HALCON's or a fisheye's, one of OpenCV's is fitted, and its error
    said. Poses are not taken: arctrack calibrate hand-eye finds the camera on the robot.
    """
    look_at_file(file)
    look_at_setup(setup)
    from arctrack.calibrate.exchange.read_lens import read_lens
    from arctrack.calibrate.exchange.record import import_notes, imported_camera
    from arctrack.cli import console

    stated = read_setup(setup)
    target = out or stated.path
    check_can_be_replaced(target)
    if real(target) == real(file):
        raise in_file(target, "is the calibration itself; give --out another file")
    read = read_lens(file, camera)
    record = imported_camera(read, file, stated)
    console.warn(import_notes(read, file, stated))
    fx, fy, cx, cy = read.pinhole
    console.say(f"{file}: a lens of {read.program}: fx {fx:.8g}, fy {fy:.8g}, cx {cx:.8g}, cy {cy:.8g} px")
    if read.error_px:
        console.say(f"its distortion is fitted by one of OpenCV's, {read.error_px:.2g} px off at most")
    write_calibrated(target, stated.path, record)
