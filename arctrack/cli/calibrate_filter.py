"""`arctrack calibrate filter`: a filter's measured curve into a setup."""

import math
from pathlib import Path
from typing import Annotated

import typer

from arctrack.cli.inputs import check_can_be_written, look_at_file, look_at_setup, read_setup
from arctrack.errors import ArctrackError, in_file
from arctrack.output import write_whole


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
