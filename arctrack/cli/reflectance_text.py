"""A reflectance in words: values with their intervals, what they rest on, what to beware of."""

import math
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from arctrack.calibrate.reflectance.goniometer import GoniometerFile
from arctrack.calibrate.reflectance.record import material_toml, scale_sentence
from arctrack.printable import printable
from calibration.reflectance import Reflectance, StandardResiduals
from calibration.reflectance_model import NAMES


def print_result(console: Console, result: Reflectance, sample: GoniometerFile) -> None:
    """Print the table, how well the readings agree with it, and the [material] table to paste."""
    console.print(_table(result))
    for label, text in _lines(result, sample):
        console.print(f"[bold]{label:<12}[/bold]", end="")
        console.print(printable(text), markup=False, soft_wrap=True)
    console.print()
    console.print(material_toml(result), markup=False, soft_wrap=True, end="")


def warnings(result: Reflectance, sample: GoniometerFile, standard: GoniometerFile | None) -> Iterator[str]:
    """Yield what the user should know before trusting the intervals."""
    for file in (sample, standard):
        if file is not None and file.unknown_columns:
            yield f"{file.path}: unknown columns {', '.join(file.unknown_columns)} have no effect"
        if file is not None and file.zero_lines:
            others = f", at {len(file.zero_lines)} settings in all" if len(file.zero_lines) > 1 else ""
            yield (
                f"{file.path}, line {file.zero_lines[0]}: gray_level = 0{others}: noise below 0 is cut off "
                "there, so that the mean is too high; raise the sensor's black level and read again"
            )
    if result.scatter.within_freedom == 0:
        reason = "no setting was read twice"
        if sample.readings.repeats.max() > 1:
            reason = "all readings of a setting are identical and tell nothing of the noise"
        yield (
            f"{sample.path}: {reason}, so that the residuals alone tell the noise; "
            "the intervals then hold the truth some 93 % to 95 % of the time"
        )
    yield from _about_the_fit(sample, result)
    if standard is not None and result.white is not None:
        yield from _about_the_fit(standard, result.white)


def _about_the_fit(file: GoniometerFile, agreement: Reflectance | StandardResiduals) -> Iterator[str]:
    """Yield what in a file does not agree with the fit."""
    scatter = agreement.scatter
    if scatter.is_unlikely:
        rounding = " (rounding to whole grey levels is allowed for)" if file.readings.is_whole else ""
        yield (
            f"{file.path}: settings scatter {scatter.ratio:.1f} times as much about the fit as their "
            f"repeats allow{rounding}: angles, light or surface change between them, or gamma, black or "
            "the lobe's form is another; the intervals count this as if it were random"
        )
    # A studentised residual beyond this is named.
    for i in np.flatnonzero(np.abs(agreement.studentised) > 4.0):
        off = agreement.studentised[i]
        yield f"{file.path}, line {file.lines[i]}: {off:+.1f} standard errors off the fit"


def _table(result: Reflectance) -> Table:
    table = Table(title=escape(printable(result.material.name)), title_justify="left", title_style="bold")
    for heading in ("", "value", "1 sigma", "95 %", "unit", *(f"r {name}" for name in NAMES[:2])):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    units = [*("1/sr" if result.absolute else "relative",) * 2, "1/rad²"]
    for i, name in enumerate(NAMES):
        low, high = result.intervals[i]
        table.add_row(
            name,
            f"{result.values[i]:.4g}",
            f"{result.sigmas[i]:.2g}",
            f"{low:.4g} to {high:.4g}",
            units[i],
            *(f"{result.correlation[i, j]:+.2f}" if j < i else "" for j in range(2)),
        )
    return table


def _lines(result: Reflectance, sample: GoniometerFile) -> list[tuple[str, str]]:
    readings = sample.readings
    min_repeats, max_repeats = int(readings.repeats.min()), int(readings.repeats.max())
    each = f"{max_repeats}" if min_repeats == max_repeats else f"{min_repeats} to {max_repeats}"
    apart = "" if math.isnan(sample.interval_s) else f", {sample.interval_s:g} s apart"
    noise, scatter = result.noise, result.scatter
    fit = "no repeats to compare the scatter with"
    if not math.isnan(scatter.ratio):
        fit = (
            f"settings scatter {scatter.ratio:.2f} times as much as repeats allow, p = {scatter.p_value:.2g}"
        )
    if result.white is not None and not math.isnan(result.white.scatter.ratio):
        fit += f" (the white standard's {result.white.scatter.ratio:.2f} times)"
    return [
        (
            "readings",
            f"{int(readings.repeats.sum())} at {len(readings.settings)} settings, {each} each{apart}",
        ),
        (
            "noise",
            f"{noise.additive_dn:.2g} DN and {100 * noise.relative:.2g} % of the signal a reading; "
            f"settings differ by {100 * result.between:.2g} % besides",
        ),
        ("fit", f"{fit}; Student's t of {result.fit.t_freedom:.0f} degrees of freedom"),
        ("scale", scale_sentence(result)),
    ]
