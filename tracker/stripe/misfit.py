"""By how much neighbouring centres are off alike where the light beneath the stripe is not as expected.

A scan line's fit has a level and a slope for what the background may be wrong by, and a width for the stripe.
What bends beneath the stripe is left over in part, and in part it moves the centre. Both parts go together:
least squares over four widths of a bell's amplitude, centre, width, level and slope, on a Gaussian field as
background, move the centre by

    1 sigma = 5 w r / A,    w the bell's width, A its amplitude,

r the root mean square of the odd part of what is left over, averaged in quarters of the window. The factor is
3.7 to 6.2 for fields with Matern's covariance of order 1/2, 3/2, 5/2 and infinity (Rasmussen and Williams
2006, Gaussian Processes for Machine Learning, 4.2), of lengths of 10 and 30 px, beneath bells of 4 to 10 px;
a step's is 6.3. The even part moves no centre. The mean over neighbouring lines tells r from their noise.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Bool, Float32, Float64, Int64
from noise_model.kernel import kernel
from tracker.stripe.fit import CORRELATION_PX, WINDOW_SIGMAS
from tracker.stripe.viterbi import bell

N_BINS = 4
"""Into so many parts of a side's window a line's odd residual is averaged."""

MOVED = 5.0
"""By how much more than the odd residual over the amplitude a centre moves, in widths."""

MIN_LINES = 6
"""A mean of fewer lines than this tells nothing from noise."""

CHANCE = 3.3
"""A mean of N_BINS squares of noise exceeds its expectation by this factor once in 100 (chi2 of 4)."""


@kernel(fastmath={"contract"})
def _left_over(
    charge_e: Float32, background_e: Float32, censored: Bool, start: float, fit: Float64, left_e: Float32
) -> None:
    """Write what a fit leaves of pixels (n,), e-, the first of which lies `start` from its centre, px.

    0 of censored ones.
    """
    amplitude, level, slope = np.float32(fit[2]), np.float32(fit[5]), np.float32(fit[6])
    zero, inverse, before = np.float32(0.0), np.float32(1.0 / fit[3]), np.float32(start)
    for i in range(charge_e.shape[0]):
        away = np.float32(i) + before
        mean = background_e[i] + amplitude * bell(away * inverse) + level + slope * away
        left_e[i] = zero if censored[i] else charge_e[i] - mean


@kernel
def _mean(left_e: Float32, censored: Bool) -> float:
    """Return the mean of the pixels (n,) that are not censored, NaN of none."""
    total, count = np.float32(0.0), 0
    for i in range(left_e.shape[0]):
        total += left_e[i]
        count += not censored[i]
    return float(total) / count if count > 0 else math.nan


@kernel(allocates=True)
def odd_residuals(
    charge_e: Float32, background_e: Float32, censored: Bool, fits: Float64, lows: Int64, cell: int
) -> Float64:
    """Return the odd residual (n, N_BINS), e-, of each line's fit, NaN of lines that are left out.

    The bands (n, depth) and `fits` (n, 7) are as `fit_lines` has them. A bin's value is half the difference
    of the means at t and -t, t the place from the centre over the width.
    """
    n, depth = charge_e.shape
    odd = np.full((n, N_BINS), math.nan)
    scratch = np.empty(depth, dtype=np.float32)
    for s in range(n):
        if math.isnan(fits[s, 0]):
            continue
        centre, part = fits[s, 0] - lows[s // cell], WINDOW_SIGMAS / N_BINS * fits[s, 3]
        if centre - N_BINS * part < 0.0 or centre + N_BINS * part > depth - 1:
            continue
        first, end = math.ceil(centre - N_BINS * part), math.floor(centre + N_BINS * part) + 1
        left_e, hidden = scratch[: end - first], censored[s, first:end]
        _left_over(
            charge_e[s, first:end], background_e[s, first:end], hidden, first - centre, fits[s], left_e
        )
        middle = centre - first
        for k in range(N_BINS):
            near, far = k * part, (k + 1) * part
            after = slice(math.ceil(middle + near), math.ceil(middle + far))
            before = slice(max(math.floor(middle - far) + 1, 0), math.floor(middle - near) + 1)
            odd[s, k] = 0.5 * (_mean(left_e[after], hidden[after]) - _mean(left_e[before], hidden[before]))
    return odd


@kernel(allocates=True)
def mean_square_near(odd_e: Float64, half: int, alike: float) -> Float64:
    """Return the mean square (n,), e-^2, of the odd residuals' means over lines up to `half` away.

    Less what the lines' own scatter gives it by chance, 0 where that explains it or too few lines are known.
    So many lines, `alike`, scatter as one.
    """
    n, n_bins = odd_e.shape
    total, squares, count = np.zeros(n_bins), np.zeros(n_bins), np.zeros(n_bins)
    near = np.zeros(n)
    for i in range(-half, n):
        ahead, behind = i + half, i - half - 1
        for k in range(n_bins):
            if ahead < n and not math.isnan(odd_e[ahead, k]):
                total[k] += odd_e[ahead, k]
                squares[k] += odd_e[ahead, k] ** 2
                count[k] += 1.0
            if behind >= 0 and not math.isnan(odd_e[behind, k]):
                total[k] -= odd_e[behind, k]
                squares[k] -= odd_e[behind, k] ** 2
                count[k] -= 1.0
        if i < 0:
            continue
        for k in range(n_bins):
            if count[k] >= MIN_LINES:
                mean = total[k] / count[k]
                noise = max(squares[k] / count[k] - mean * mean, 0.0) / (count[k] - 1.0) * alike
                near[i] += (mean * mean - CHANCE * noise) / n_bins
        near[i] = max(near[i], 0.0)
    return near


def misfit_sigma_px(odd_e: Float64, fits: Float64, alike: float) -> Float64:
    """Return by how much each line's centre may be off alike with its neighbours' (n,), px.

    `odd_e` (n, N_BINS) are the lines' odd residuals, `fits` (n, 7) their fits; so many lines, `alike`,
    scatter as one.
    """
    r = np.sqrt(mean_square_near(odd_e, round(0.5 * CORRELATION_PX), alike))
    return np.asarray(MOVED * fits[:, 3] * r / fits[:, 2])
