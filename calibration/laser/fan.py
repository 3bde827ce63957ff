"""The fan: where its light ends on the boards, and so its angle and the point that it comes from.

The ends on one side lie on one ray from the laser's origin. In the sheet, with a along the model's axis and
s across it, either side is a line s = c + k a: they meet in the origin, and (atan k_2 - atan k_1) / 2 is the
half angle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from calibration.laser.cross_sections import CrossSections
from noise_model.compiled.arrays import Float64
from noise_model.fit import student_t
from noise_model.robust import sigma_of

MAX_NOISE = 0.2
"""Largest noise of a scan line's light, over the stripe's: more is of dark squares."""

LEVEL_LINES = 15
"""Number of lines whose median is the light before an end."""

DARK_LINES, MAX_DARK = 5, 0.25
"""Number of lines next to an end that show less light, and that light's share of what is before it."""

MAX_GAP = 3
"""Largest number of further lines between the last lit one and the last of these."""

MIN_ENDS = 2
"""Ends on one side: two make a line."""

MAX_REL_SIGMA = 0.1
"""1 sigma of the difference of the sides' slopes over it: beyond it the origin is as good as unknown."""

FAR_SIGMAS = 7.0
"""Distance of an end from its side's line, sigmas, at which it is something else: few ends determine the
sigma badly.
"""

QUANTIZED = 1.0 / math.sqrt(12.0)
"""1 sigma of a place that is known to a scan line."""


class Missing(StrEnum):
    """Reason for which an end of the stripe is not seen."""

    BOARD = "beyond the board's edge"
    SQUARE = "in a dark square"


@dataclass(frozen=True)
class Fan:
    """The fan within the sheet.

    `apex` (2,) is where the sides meet, along and across the axis, from the stated origin, mm. `turn_deg` is
    the rotation of their bisector from the model's axis towards its side direction. `covariance` (4, 4) is of
    apex (mm), half angle and turn (deg), with few ends allowed for; `residual_mm` is the ends' RMS distance
    from the sides.
    """

    apex: Float64
    half_angle_deg: float
    turn_deg: float
    covariance: Float64
    residual_mm: float

    @property
    def sigma(self) -> Float64:
        """1 sigma of apex, half angle and turn (4,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def ends_of(sections: CrossSections) -> tuple[float | Missing, float | Missing]:
    """Return at which scan lines a stripe begins and ends, or why that is not seen."""
    down, up = (_end(sections, sign) for sign in (-1, 1))
    return down, up


def _end(sections: CrossSections, sign: int) -> float | Missing:
    """Return the end towards lower (-1) or higher (+1) scan lines: where half the light is lost."""
    lit = np.isfinite(sections.width_px) & np.isfinite(sections.amount_sigma)
    if lit.sum() < LEVEL_LINES:
        return Missing.BOARD
    middle = float(np.median(sections.scan[lit]))
    level = float(np.median(sections.amount[lit]))
    outward = sign * (sections.scan - middle) >= 0.0
    tells = outward & (sections.amount_sigma < MAX_NOISE * level)
    scan, amount = sections.scan[tells][::sign], sections.amount[tells][::sign]
    n = _last_lit(amount, level)
    level = float(np.median(amount[max(0, n - LEVEL_LINES) : n])) if n else level
    n = _last_lit(amount, level)
    if n == 0 or n > len(amount) - DARK_LINES:
        last = int(sections.scan[outward][::sign][-1])
        return Missing.SQUARE if len(scan) and abs(int(scan[-1]) - last) > MAX_GAP else Missing.BOARD
    if abs(int(scan[n + DARK_LINES - 1]) - int(scan[n - 1])) > DARK_LINES + MAX_GAP:
        return Missing.SQUARE
    if float(np.mean(amount[n : n + DARK_LINES])) > MAX_DARK * level:
        return Missing.BOARD
    return 0.5 * float(scan[n - 1] + scan[n])


def _last_lit(amount: Float64, level: float) -> int:
    """Return the number of lit lines: the best fit of a step from `level` to 0 to the light (n,)."""
    gain = (amount - level) ** 2 - amount**2
    return int(np.argmin(np.concatenate([[0.0], np.cumsum(gain)])))


def fit_fan(sides: Sequence[Float64], quantized_mm: float) -> Fan | str:
    """Fit the fan's sides to the ends (n, 2) on either side, along and across the axis, mm.

    `quantized_mm` is the distance between scan lines on the boards. Returns what is missing, in words, where
    the ends do not determine it.
    """
    off = [_off_common_line(side, quantized_mm) for side in sides]
    together = np.concatenate(off)
    # What a line of n ends leaves of their scatter, on both sides together.
    share = max(1.0 - 4.0 / max(len(together), 1), 0.25)
    scale = sigma_of(together) / share if len(together) else 0.0
    max_off = FAR_SIGMAS * max(scale, QUANTIZED * quantized_mm)
    sides = [side[each <= max_off] for side, each in zip(sides, off, strict=True)]
    few = [len(side) for side in sides]
    if min(few) < MIN_ENDS or sum(few) < 2 * MIN_ENDS + 1:
        return (
            f"{few[0]} and {few[1]} ends of the stripe are seen on its two sides, "
            f"{MIN_ENDS} and {MIN_ENDS + 1} are the least: add pairs in which both ends lie on the "
            "board, in light squares"
        )
    freedom = sum(few) - 4
    centre = float(np.mean(np.concatenate([side[:, 0] for side in sides])))
    fits = [_line(side[:, 0] - centre, side[:, 1]) for side in sides]
    squares = sum(fit[2] for fit in fits)
    variance = max(squares / freedom, (QUANTIZED * quantized_mm) ** 2)
    # Few ends say little of their scatter: Student's t is wider.
    variance *= (student_t(0.95, freedom) / student_t(0.95, math.inf)) ** 2
    (c1, k1), (c2, k2) = (fit[0] for fit in fits)
    P = np.zeros((4, 4))
    P[:2, :2], P[2:, 2:] = variance * fits[0][1], variance * fits[1][1]
    opening = k2 - k1
    if not abs(opening) * MAX_REL_SIGMA > math.sqrt(P[1, 1] + P[3, 3]):
        return (
            "the stripes' ends are at too equal depths to tell where the fan's sides meet: add pairs with "
            "the board nearer to the laser and farther away"
        )
    a = -(c2 - c1) / opening
    by_a = np.array([1.0, a, -1.0, -a]) / opening
    by_s = np.array([1.0, a, 0.0, 0.0]) + k1 * by_a
    low, high = 1.0 / (1.0 + k1**2), 1.0 / (1.0 + k2**2)
    by_half = np.degrees(0.5 * np.sign(opening) * np.array([0.0, -low, 0.0, high]))
    by_turn = np.degrees(0.5 * np.array([0.0, low, 0.0, high]))
    J = np.stack([by_a, by_s, by_half, by_turn])
    angles = np.degrees(np.arctan([k1, k2]))
    return Fan(
        np.array([centre + a, c1 + k1 * a]),
        0.5 * abs(float(angles[1] - angles[0])),
        0.5 * float(angles.sum()),
        J @ P @ J.T,
        math.sqrt(squares / sum(few)),
    )


def _off_common_line(side: Float64, quantized_mm: float) -> Float64:
    """Return the distances (n,) of ends (n, 2) from their Theil-Sen line."""
    a, s = side.T
    first, second = np.triu_indices(len(a), 1)
    apart = np.abs(a[second] - a[first]) > quantized_mm
    if len(a) <= MIN_ENDS + 1 or not apart.any():
        return np.zeros(len(a))
    slope = float(np.median((s[second] - s[first])[apart] / (a[second] - a[first])[apart]))
    off = s - slope * a
    return np.asarray(np.abs(off - np.median(off)))


def _line(a: Float64, s: Float64) -> tuple[Float64, Float64, float]:
    """Return c and k of s = c + k a, their covariance for a variance of 1, and the sum of squares."""
    A = np.column_stack([np.ones(len(a)), a])
    small = np.linalg.pinv(A.T @ A)
    line = small @ A.T @ s
    return line, small, float(np.sum((A @ line - s) ** 2))
