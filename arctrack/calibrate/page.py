"""calibrate_*.html: one calibration on one self-contained page; each kind brings its rows and pictures."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from arctrack.report.template import environment

EXACT_LENS = (
    "The setup has no covariance of the lens: it counts as exact, and the sigmas are too small. "
    "`arctrack calibrate camera` writes it."
)
"""A note on a setup that does not say how well its lens is known."""

HALF_95 = 1.96
"""Half of a 95 % interval of a normal law, in sigmas."""


@dataclass(frozen=True)
class ValueRow:
    """A value as the page shows it: what it is, its key in the setup, value, 1 sigma, 95 % interval, unit."""

    what: str
    key: str
    value: str
    sigma: str
    interval: str
    unit: str


@dataclass(frozen=True)
class PagePicture:
    """A picture, what it shows in one line, and a note on how to read it."""

    uri: str
    caption: str
    note: str = ""


@dataclass(frozen=True)
class CalibrationPage:
    """Content of a calibration's page.

    `maps` are pictures whose pixels stay sharp, side by side; `mark` is the colour of the verdict: no_gap,
    ambiguous or unknown; `left_out` names what was not used, and why;
    `heads` are those of the columns of numbers.
    """

    title: str
    label: str
    headline: str
    sentences: tuple[str, ...]
    mark: str
    rows: tuple[ValueRow, ...] = ()
    pictures: tuple[PagePicture, ...] = ()
    maps: tuple[PagePicture, ...] = ()
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    heads: tuple[str, str, str] = ("value", "1 σ", "95 %")


def with_sigma(value: float, sigma: float) -> tuple[str, str]:
    """Return a value and its 1 sigma with as many decimals as two digits of the sigma have."""
    if not 0.0 < sigma < math.inf:
        return f"{value:.6g}", ""
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"


def row_of(
    what: str,
    key: str,
    value: float,
    sigma: float,
    unit: str,
    *,
    ends: tuple[float, float] | None = None,
    shown: Callable[[float, float], tuple[str, str]] = with_sigma,
) -> ValueRow:
    """Return a value's row; `key` is the value's in the setup.

    `ends` is the 95 % interval, by default that of a normal distribution. `shown` formats a value and its 1
    sigma.
    """
    low, high = ends or (value - HALF_95 * sigma, value + HALF_95 * sigma)
    first, last = (shown(float(end), float(sigma))[0] for end in (low, high))
    return ValueRow(what, key, *shown(float(value), float(sigma)), f"{first} to {last}", unit)


def with_reasons(left_out: Mapping[str, str]) -> tuple[str, ...]:
    """Return the inputs left out, each with the reason."""
    return tuple(f"{name}: {reason}" for name, reason in left_out.items())


def render(page: CalibrationPage, stages: Sequence[CalibrationPage] = ()) -> str:
    """Return the page's HTML, with those of other calibrations below; it needs no other file, no network."""
    return environment().get_template("calibration.html.j2").render(page=page, stages=stages)
