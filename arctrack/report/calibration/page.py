"""calibrate_*.html: one calibration on one self-contained page; each kind brings its rows and pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from arctrack.report.template import environment

TEMPLATE = "calibration.html.j2"

HALF_95 = 1.96
"""Half of a 95 % interval of a normal law, in sigmas."""


@dataclass(frozen=True)
class Row:
    """A value as the page shows it: what it is, its key in the setup, value, 1 sigma, 95 % interval, unit."""

    what: str
    key: str
    value: str
    sigma: str
    interval: str
    unit: str


@dataclass(frozen=True)
class Picture:
    """A picture, what it shows in one line, and a note on how to read it."""

    uri: str
    caption: str
    note: str = ""


@dataclass(frozen=True)
class CalibrationPage:
    """What a calibration's page holds.

    `maps` are pictures whose pixels stay sharp, side by side; `mark` is the colour of the verdict: no_gap,
    ambiguous or unknown; `left_out` names what was not used, and why;
    `heads` are those of the columns of numbers.
    """

    title: str
    label: str
    headline: str
    sentences: tuple[str, ...]
    rows: tuple[Row, ...]
    pictures: tuple[Picture, ...]
    maps: tuple[Picture, ...]
    notes: tuple[str, ...]
    mark: str
    left_out: tuple[str, ...] = ()
    heads: tuple[str, str, str] = ("value", "1 σ", "95 %")


def with_sigma(value: float, sigma: float) -> tuple[str, str]:
    """Return a value and its 1 sigma with as many decimals as two digits of the sigma have."""
    if not 0.0 < sigma < math.inf:
        return f"{value:.6g}", ""
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"


def render(page: CalibrationPage, stages: Sequence[CalibrationPage] = ()) -> str:
    """Return the page's HTML, with those of other calibrations below; it needs no other file, no network."""
    return environment().get_template(TEMPLATE).render(page=page, stages=stages)
