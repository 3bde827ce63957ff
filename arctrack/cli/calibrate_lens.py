"""`arctrack calibrate import` and `export`: a lens from and for other programs, and its setup."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.calibration_output import Out
from arctrack.cli.inputs import (
    check_can_be_replaced,
    check_can_be_written,
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


LensFormat = StrEnum("LensFormat", ["mrcal", "kalibr", "ros"])
"""A program that reads the file."""


def export_lens(
    setup: Annotated[Path, typer.Argument(metavar="SETUP", help="A recording.toml, or a recording.")],
    program: Annotated[
        LensFormat,
        typer.Option("--format", help="mrcal's .cameramodel, Kalibr's camchain, or ROS' camera_info."),
    ],
    out: Annotated[Path, typer.Option(help="The file to write; one that is there already is kept.")],
) -> None:
    """Write focal lengths, principal point and distortion of a setup for another program.

    All digits are kept. A distortion that the program has no model for is refused. Kalibr's rostopic is
    /camera/image_raw, mrcal's extrinsics are none.
    """
    look_at_setup(setup)
    from arctrack.calibrate.exchange.write_lens import WRITERS
    from arctrack.cli import console
    from arctrack.errors import in_file
    from arctrack.output import write_keeping

    stated = read_setup(setup)
    check_can_be_written(out, stated.path)
    try:
        text = WRITERS[program.value](stated.setup.camera)
    except ValueError as error:
        raise in_file(stated.path, str(error)) from None
    former = write_keeping(out, text)
    console.say(
        f"{out}: the lens for {program.value}{'' if former is None else f'; the one before is {former.name}'}"
    )
