"""`arctrack calibrate reflectance`: a base metal's reflectance from goniometer readings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.inputs import look_at_file
from arctrack.errors import ArctrackError, in_file

if TYPE_CHECKING:
    from arctrack.calibrate.reflectance.goniometer import GoniometerFile
    from calibration.goniometer import GreyResponse
    from calibration.reflectance import Reflectance


def reflectance(
    data: Annotated[Path, typer.Argument(help="CSV: theta_i_deg, theta_r_deg, phi_r_deg, gray_level.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for material.toml, residuals.csv and the residual plot.")
    ] = None,
    gamma: Annotated[float, typer.Option(help="The sensor's gamma, Eq. 20.")] = 1.0,
    black: Annotated[float, typer.Option(help="Grey level without light.")] = 0.0,
    saturation: Annotated[float, typer.Option(help="Grey level from which on a pixel is saturated.")] = 255.0,
    white: Annotated[
        Path | None, typer.Option(help="The same for a white standard: makes the kappas absolute, 1/sr.")
    ] = None,
    albedo: Annotated[
        float | None, typer.Option(help="With --white: the standard's diffuse reflectance; default 0.99.")
    ] = None,
    total: Annotated[
        float | None,
        typer.Option(help="Without --white: what kappa_diff + kappa_spec is taken to be; default 1."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="The material's name; default: the file's.")] = None,
) -> None:
    """Fit kappa_diff, kappa_spec and c2 of a base metal to goniometer readings.

    Grey levels of equal angles are averaged, as in the paper (20 each, 0.2 s apart). Without a white
    standard their scale is unknown: only kappa_spec / kappa_diff and c2 are measured, and --total sets the
    sum (Table 1: 0.347 for mild steel, 0.648 for the Zn-coated panel).
    """
    look_at_file(data)
    if white is not None:
        look_at_file(white)
    from arctrack.calibrate.reflectance.goniometer import read_goniometer
    from arctrack.cli import console
    from arctrack.cli.reflectance_text import print_result, warnings
    from calibration.goniometer import GreyResponse

    try:
        response = GreyResponse(gamma, black, saturation)
    except ValueError as error:
        raise ArctrackError(str(error)) from None
    if white is None and albedo is not None:
        raise ArctrackError(
            "--albedo: has no effect without --white; give the standard's readings or leave it"
        )
    if white is not None and total is not None:
        raise ArctrackError("--total: has no effect with --white, which settles the scale; leave one of them")
    if albedo is not None and not 0.0 < albedo <= 1.0:
        raise ArctrackError(f"--albedo {albedo:g}: a white standard's lies above 0 and is 1 at most")
    if total is not None and not 0.0 < total < math.inf:
        raise ArctrackError(f"--total {total:g}: kappa_diff + kappa_spec must be > 0 and finite")
    sample = read_goniometer(data, response)
    standard = None if white is None else read_goniometer(white, response)
    result = _identify(
        sample,
        response,
        standard,
        0.99 if albedo is None else albedo,
        1.0 if total is None else total,
        name or data.stem,
    )
    console.warn(warnings(result, sample, standard))
    print_result(console.tables(), result, sample)
    if out is not None:
        _write(result, sample, standard, response, out)
        console.say(f"results in {out}")


def _identify(
    sample: GoniometerFile,
    response: GreyResponse,
    standard: GoniometerFile | None,
    albedo: float,
    total: float,
    name: str,
) -> Reflectance:
    from calibration.reflectance import identify_reflectance
    from calibration.reflectance_limits import refuse_if_dark
    from calibration.reflectance_model import White

    if standard is not None and standard.source_columns != sample.source_columns:
        stated = [", ".join(file.source_columns) or "neither" for file in (standard, sample)]
        raise in_file(
            standard.path, f"states of distance_mm and intensity: {stated[0]}, but {sample.path}: {stated[1]}"
        )
    if standard is not None:
        try:
            refuse_if_dark(standard.readings, response)
        except ValueError as error:
            raise in_file(standard.path, str(error)) from None
    try:
        white = None if standard is None else White(standard.readings, albedo)
        return identify_reflectance(sample.readings, response, white=white, total=total, name=name)
    except ValueError as error:
        raise in_file(sample.path, str(error)) from None


def _write(
    result: Reflectance,
    sample: GoniometerFile,
    standard: GoniometerFile | None,
    response: GreyResponse,
    out: Path,
) -> None:
    from arctrack.calibrate.reflectance.picture import draw
    from arctrack.calibrate.reflectance.record import PICTURE, write_results

    write_results(result, sample, standard, out)
    try:
        draw(result, sample.readings, response).savefig(out / PICTURE)
    except OSError as error:
        raise in_file(out / PICTURE, f"cannot be written: {error.strerror}") from None
