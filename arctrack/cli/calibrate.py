"""`arctrack calibrate`: parameters of the model from measurements."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from arctrack.cli.calibrate_filter import filter_curve
from arctrack.cli.calibrate_hand_eye import hand_eye
from arctrack.errors import ArctrackError, in_file

if TYPE_CHECKING:
    from arctrack.goniometer_file import GoniometerFile
    from calibration.goniometer import Response
    from calibration.reflectance import Reflectance

calibrate = typer.Typer(
    name="calibrate", help="Find parameters of the model from measurements.", no_args_is_help=True
)

EXAMPLE = "Example: arctrack calibrate reflectance examples/goniometer_mild_steel.csv --out /tmp/steel"


calibrate.command(
    "filter",
    epilog="Example: arctrack calibrate filter examples/filter_690_10.csv --setup examples/v_groove "
    "--out /tmp/filtered.toml",
)(filter_curve)
calibrate.command(
    "hand-eye", epilog="Example: arctrack calibrate hand-eye examples/v_groove --out /tmp/found.toml"
)(hand_eye)


@calibrate.callback(epilog=EXAMPLE)
def _calibrate() -> None:
    """Find parameters of the model from measurements."""


@calibrate.command(epilog=EXAMPLE)
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
    albedo: Annotated[float, typer.Option(help="With --white: the standard's diffuse reflectance.")] = 0.99,
    total: Annotated[
        float, typer.Option(help="Without --white: what kappa_diff + kappa_spec is taken to be.")
    ] = 1.0,
    name: Annotated[str | None, typer.Option(help="The material's name; default: the file's.")] = None,
) -> None:
    """Fit kappa_diff, kappa_spec and c2 of a base metal to goniometer readings.

    Grey levels of equal angles are averaged, as in the paper (20 each, 0.2 s apart). Without a white
    standard their scale is unknown: only kappa_spec / kappa_diff and c2 are measured, and --total sets the
    sum (Table 1: 0.347 for mild steel, 0.648 for the Zn-coated panel).
    """
    from arctrack.cli import console
    from arctrack.cli.reflectance_text import print_result, warnings
    from arctrack.goniometer_file import read_goniometer
    from calibration.goniometer import Response

    try:
        response = Response(gamma, black, saturation)
    except ValueError as error:
        raise ArctrackError(str(error)) from None
    sample = read_goniometer(data, response)
    standard = None if white is None else read_goniometer(white, response)
    result = _identify(sample, response, standard, albedo, total, name or data.stem)
    console.warn(warnings(result, sample, standard))
    print_result(console.tables(), result, sample)
    if out is not None:
        _write(result, sample, response, out)
        typer.echo(f"results in {out}")


def _identify(
    sample: GoniometerFile,
    response: Response,
    standard: GoniometerFile | None,
    albedo: float,
    total: float,
    name: str,
) -> Reflectance:
    from calibration.reflectance import identify_reflectance
    from calibration.reflectance_model import White

    if standard is not None and standard.source_columns != sample.source_columns:
        stated = [", ".join(file.source_columns) or "neither" for file in (standard, sample)]
        raise in_file(
            standard.path, f"states of distance_mm and intensity: {stated[0]}, but {sample.path}: {stated[1]}"
        )
    try:
        white = None if standard is None else White(standard.readings, albedo)
        return identify_reflectance(sample.readings, response, white=white, total=total, name=name)
    except ValueError as error:
        raise in_file(sample.path, str(error)) from None


def _write(result: Reflectance, sample: GoniometerFile, response: Response, out: Path) -> None:
    from arctrack.reflectance_files import PICTURE, write_results
    from arctrack.report.reflectance import draw

    write_results(result, sample, out)
    try:
        draw(result, sample.readings, response).savefig(out / PICTURE)
    except OSError as error:
        raise in_file(out / PICTURE, f"cannot be written: {error.strerror}") from None
