"""`arctrack calibrate import`, `export` and `filter`: a lens from and for other programs, a filter curve."""

import math
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
from arctrack.errors import ArctrackError, in_file
from arctrack.output import real, write_whole


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
    from arctrack.calibrate.exchange.lens_file import import_notes, imported_camera
    from arctrack.calibrate.exchange.read_lens import read_lens
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


def filter_curve(
    data: Annotated[Path, typer.Argument(help="CSV: wavelength_nm and transmission or optical_density.")],
    setup: Annotated[Path, typer.Option(help="A recording.toml, or a recording, that it belongs to.")],
    out: Annotated[Path, typer.Option(help="Where to write recording.toml with the curve in \\[filter].")],
    effective_index: Annotated[
        float | None, typer.Option(help="The maker's n_eff for light off the axis; default: the setup's.")
    ] = None,
) -> None:
    """Put a filter's measured curve into a setup and print its transmission over the field.

    It prints centre and width, the transmission of the laser's line and of the arc's continuum at the image's
    corner over that on the axis, and the argon lines' brightness behind it over that of the continuum.
    """
    import numpy as np

    look_at_file(data)
    look_at_setup(setup)
    from arctrack.calibrate.filter_curve import read_filter_curve
    from arctrack.cli import console
    from arctrack.recording import with_filter_curve
    from arctrack.recording.setup_file import parse_setup
    from noise_model.instrument.camera import Rays
    from noise_model.instrument.spectrum import (
        ArcSpectrum,
        laser_transmission,
        line_to_continuum,
        passed_continuum,
    )

    read = read_setup(setup)
    stated = read.setup
    check_can_be_written(out, read.path, data)
    if effective_index is None and stated.filter is None:
        raise in_file(read.path, "[filter] is missing: give --effective-index, the maker's n_eff")
    index = stated.stated_filter.effective_index if effective_index is None else effective_index
    if not 1.0 <= index < math.inf:
        raise ArctrackError(f"--effective-index {index:g}: must be a finite number, 1 or more")
    try:
        curve = read_filter_curve(data, index)
        xy = Rays.of(stated.camera).xy.reshape(-1, 2)
        corner = float(np.arctan(np.hypot(xy[:, 0], xy[:, 1]).max()))
        angles = np.array([0.0, corner])
        laser = laser_transmission(curve, stated.laser.wavelength_nm, angles)
    except ValueError as error:
        raise in_file(data, str(error)) from None
    spectrum = ArcSpectrum()
    continuum = passed_continuum(curve, spectrum, angles)
    lines = line_to_continuum(curve, spectrum, angles)
    text = with_filter_curve(read.path, curve)
    parse_setup(text, out)
    write_whole(out, text)
    for text in (
        f"centre {curve.center_nm:.2f} nm, {curve.fwhm_nm:.2f} nm wide at half of its peak",
        f"at the image's corner, {np.degrees(corner):.1f} deg off the axis, over what passes on it: "
        f"laser {laser[1]:.3f}, the arc's continuum {continuum[1] / continuum[0]:.3f}",
        f"argon lines over continuum, if Ar I 696.54 is {spectrum.line_width_nm:g} nm wide: "
        f"{lines[0]:.2f} on the axis, {lines[1]:.2f} at the corner",
        f"{out}: the setup with the curve",
    ):
        console.say(text)
