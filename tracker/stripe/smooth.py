"""Neighbours along the stripe: a better centre where the surface runs straight, never one across a corner.

The columns' centres are independent, each with its own sigma, and the trace is piecewise straight. A
straight line through a window of columns is their most likely value. Whether one may be drawn is asked of
the window: the lines through its two halves must be one line, by the chi2 that drawing one costs, and so
must those through the halves of its halves and of its middle, down to a few columns (the intersection of
confidence intervals over nested windows: Goldenshluger and Nemirovski 1997, Math. Methods Statist. 6, 135;
Katkovnik 1999, IEEE Trans. Signal Process. 47, 2567). A bend that a window's chi2 barely hides moves its
line by several of the line's own sigmas and that of half of it by about one, so half of the window is drawn
through; a column lies at least a quarter of the window off its ends, so next to a corner it keeps its own
centre. Where a line lies is independent of the chi2 about it, so the choice does not bias the sigma.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.compiled.kernel import kernel
from tracker.state import Stripe

LENGTHS = (4, 8, 16, 32, 64)
"""Columns of the windows that are asked whether they are straight."""

MIN_DRAWN = 32
"""A line is drawn in windows from this length on: shorter ones hardly show a corner."""

PIECE_CHI2 = 16.0
"""Limits that chance exceeds once in 3000: chi2 of the least window about its line, and of one line
instead of two. Either has two degrees of freedom."""

AGREE_SIGMAS = 3.0
"""Largest difference of the two sides' predictions of the column between them."""

OUTLIER_SIGMAS, OUTLIER_PX = 5.0, 0.7
"""A column so far off what either side says, and off both together, is none of the stripe. A corner that the
lens rounds lies up to half a pixel off both."""

MIN_SURE_PX = 0.67
"""A centre less sure than this is none: one in 400 of them would be more than two pixels off."""

OUTLIER_REACH = 6
"""Number of columns on either side that show whether one is an outlier."""

MAX_MISSING = 1
"""More columns that are missing of the least window break it."""

PRESENT = 6
"""Index of the running sums' number of columns."""


class _WindowLine(NamedTuple):
    """A line through a window: value and variance at a column, chi2; NaN of fewer than two columns."""

    value: float
    variance: float
    chi2: float


@kernel
def _line(sums: Float64, low: int, high: int, scan: float) -> _WindowLine:
    """Return the line through columns low to high - 1, from running sums (n + 1, 7), read at a column."""
    w = sums[high, 0] - sums[low, 0]
    if not w > 0.0:
        return _WindowLine(math.nan, math.nan, math.nan)
    x = (sums[high, 1] - sums[low, 1]) / w
    y = (sums[high, 3] - sums[low, 3]) / w
    xx = sums[high, 2] - sums[low, 2] - w * x * x
    # One column's spread, but for rounding.
    if not xx > 1e-6 * w:
        return _WindowLine(math.nan, math.nan, math.nan)
    xy = sums[high, 4] - sums[low, 4] - w * x * y
    yy = sums[high, 5] - sums[low, 5] - w * y * y
    slope = xy / xx
    return _WindowLine(y + slope * (scan - x), 1.0 / w + (scan - x) ** 2 / xx, max(yy - slope * xy, 0.0))


@kernel
def _running_sums(position: Float64, sigma: Float64, reference: float, sums: Float64) -> None:
    """Write the sums (n + 1, 7) of w = 1 / sigma^2, wx, wxx, wy, wxy, wyy and 1 over the columns before."""
    sums[0, :] = 0.0
    for i in range(position.shape[0]):
        for k in range(sums.shape[1]):
            sums[i + 1, k] = sums[i, k]
        if math.isfinite(position[i]) and sigma[i] > 0.0:
            w, x, y = 1.0 / sigma[i] ** 2, float(i), position[i] - reference
            sums[i + 1, 0] += w
            sums[i + 1, 1] += w * x
            sums[i + 1, 2] += w * x * x
            sums[i + 1, 3] += w * y
            sums[i + 1, 4] += w * x * y
            sums[i + 1, 5] += w * y * y
            sums[i + 1, PRESENT] += 1.0


@kernel
def _is_far(y: float, variance: float, line: _WindowLine, sigmas: float) -> bool:
    """Return True if a value is far off a line that knows nothing of it; never where there is no line."""
    off = abs(y - line.value)
    return off > OUTLIER_PX and off > sigmas * math.sqrt(variance + line.variance)


@kernel
def _is_outlier(sums: Float64, i: int, y: float, variance: float) -> bool:
    """Return whether a column is off what its neighbours on either side say, and both where they agree.

    A side with fewer than two columns says nothing; where neither says anything a column is none.
    """
    n = sums.shape[0] - 1
    left = _line(sums, max(i - OUTLIER_REACH, 0), i, float(i))
    right = _line(sums, i + 1, min(i + 1 + OUTLIER_REACH, n), float(i))
    if _agrees(left.value, left.variance, right):
        return (
            _is_far(y, variance, _joined(left, right), OUTLIER_SIGMAS)
            and _is_far(y, variance, left, AGREE_SIGMAS)
            and _is_far(y, variance, right, AGREE_SIGMAS)
        )
    has_left, has_right = not math.isnan(left.value), not math.isnan(right.value)
    if not (has_left or has_right):
        return False
    off_left = not has_left or _is_far(y, variance, left, OUTLIER_SIGMAS)
    return off_left and (not has_right or _is_far(y, variance, right, OUTLIER_SIGMAS))


@kernel
def _agrees(value: float, variance: float, line: _WindowLine) -> bool:
    """Return True if a value and a line that knows nothing of it agree; never where there is no line."""
    return abs(value - line.value) <= AGREE_SIGMAS * math.sqrt(variance + line.variance)


@kernel
def _joined(a: _WindowLine, b: _WindowLine) -> _WindowLine:
    """Return the mean of two values that know nothing of each other, by their variances."""
    total = a.variance + b.variance
    return _WindowLine(
        (a.value * b.variance + b.value * a.variance) / total, a.variance * b.variance / total, 0.0
    )


@kernel
def _find_straight(sums: Float64, chi2: Float64, is_straight: Bool) -> None:
    """Write chi2 (lengths, n) of the windows that begin at each column and whether they are straight."""
    n = sums.shape[0] - 1
    for k, length in enumerate(LENGTHS):
        half = length // 2
        for low in range(n):
            is_straight[k, low] = False
            if low + length > n:
                continue
            chi2[k, low] = _line(sums, low, low + length, 0.0).chi2
            if k == 0:
                missing = length - (sums[low + length, PRESENT] - sums[low, PRESENT])
                is_straight[k, low] = missing <= MAX_MISSING and chi2[k, low] <= PIECE_CHI2
            elif (
                is_straight[k - 1, low]
                and is_straight[k - 1, low + half]
                and is_straight[k - 1, low + half // 2]
            ):
                bent = chi2[k - 1, low] + chi2[k - 1, low + half]
                is_straight[k, low] = chi2[k, low] - bent <= PIECE_CHI2


@kernel
def _best(sums: Float64, is_straight: Bool, i: int, own: _WindowLine) -> _WindowLine:
    """Return the line through the longest straight window about a column, its own centre where there is none.

    The column is in the middle of the window, else a quarter off either end, and likewise in what is drawn.
    """
    n = sums.shape[0] - 1
    best = own
    for k in range(len(LENGTHS) - 1, -1, -1):
        length = LENGTHS[k]
        if length < MIN_DRAWN:
            break
        for quarters in (2, 1, 3):
            low = i - quarters * length // 4
            if low < 0 or low >= n or not is_straight[k, low]:
                continue
            first = i - quarters * length // 8
            line = _line(sums, first, first + length // 2 + 1, float(i))
            if line.variance < best.variance:
                best = line
            if quarters == 2:
                return best
        if best.variance < own.variance:
            return best
    return best


class SmoothRoom(NamedTuple):
    """Room for the running sums (n + 1, 7), and by window chi2 (lengths, n) and whether it is straight."""

    sums: Float64
    chi2: Float64
    is_straight: Bool

    @classmethod
    def empty(cls, n: int) -> SmoothRoom:
        """Make room for n columns."""
        windows = len(LENGTHS), n
        return cls(np.empty((n + 1, PRESENT + 1)), np.empty(windows), np.empty(windows, np.bool_))


class SmoothedStripe(NamedTuple):
    """A stripe's centres (n,) as the neighbours along it smooth them, px, and their 1 sigma (n,), px.

    NaN where there is no stripe, at outliers, and where a centre stays unsure.
    """

    position_px: Float64
    sigma_px: Float64


def smoothed(stripe: Stripe) -> SmoothedStripe:
    """Return a stripe's centres, smoothed with their neighbours."""
    n = len(stripe.position_px)
    smooth = SmoothedStripe(np.empty(n), np.empty(n))
    smooth_stripe(stripe.position_px, stripe.sigma_px, stripe.beside_px, SmoothRoom.empty(n), *smooth)
    return smooth


@kernel
def smooth_stripe(
    position_px: Float64,
    sigma_px: Float64,
    together_px: Float64,
    room: SmoothRoom,
    smooth: Float64,
    sigma: Float64,
) -> None:
    """Write the centres (n,) that the neighbours along the stripe agree on, px, and their 1 sigma (n,).

    `position_px`, `sigma_px` (n,) are the columns' own, NaN where there is no stripe. There, at an outlier,
    and where the centre stays less sure than MIN_SURE_PX, what is written is NaN too. `together_px` (n,)
    is a column's 1 sigma among others: `sigma_px` for independent ones, more where they are correlated.
    """
    n = position_px.shape[0]
    sums, chi2, is_straight = room
    reference = 0.0
    for i in range(n):
        smooth[i], sigma[i] = position_px[i], sigma_px[i]
        if math.isfinite(smooth[i]):
            reference = smooth[i]
        else:
            sigma[i] = np.nan
    _running_sums(position_px, together_px, reference, sums)
    for i in range(n):
        if math.isfinite(smooth[i]) and _is_outlier(sums, i, smooth[i] - reference, sigma[i] ** 2):
            smooth[i], sigma[i] = np.nan, np.nan
    _running_sums(smooth, together_px, reference, sums)
    _find_straight(sums, chi2, is_straight)
    for i in range(n):
        if math.isfinite(smooth[i]):
            best = _best(sums, is_straight, i, _WindowLine(smooth[i] - reference, sigma[i] ** 2, 0.0))
            smooth[i], sigma[i] = best.value + reference, math.sqrt(best.variance)
            if sigma[i] > MIN_SURE_PX:
                smooth[i], sigma[i] = np.nan, np.nan
