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

from noise_model.arrays import Float32, Float64
from noise_model.kernel import kernel
from tracker.stripe.line_fit.block import CORRELATION_PX
from tracker.stripe.pairs import usual_of

MOVED = 5.0
"""By how much more than the odd residual over the amplitude a centre moves, in widths."""

MIN_LINES = 6
"""A mean of fewer lines than this tells nothing from noise."""

CHANCE = 3.3
"""A mean of N_BINS squares of noise exceeds its expectation by this factor once in 100 (chi2 of 4)."""


@kernel(allocates=True)
def mean_square_near(odd_e: Float64, half: int, alike: Float64, near_e2: Float64) -> None:
    """Write the mean square (n,), e-^2, of the odd residuals' means over lines up to `half` away.

    Less what the lines' own scatter gives it by chance, 0 where that explains it or too few lines are known.
    About each line so many, `alike` (n,), scatter as one.
    """
    n, n_bins = odd_e.shape
    total, squares, n_lines = np.empty(n_bins), np.empty(n_bins), np.empty(n_bins)
    for k in range(n_bins):
        total[k], squares[k], n_lines[k] = 0.0, 0.0, 0.0
    for i in range(-half, n):
        ahead, behind = i + half, i - half - 1
        for k in range(n_bins):
            if ahead < n and not math.isnan(odd_e[ahead, k]):
                total[k] += odd_e[ahead, k]
                squares[k] += odd_e[ahead, k] ** 2
                n_lines[k] += 1.0
            if behind >= 0 and not math.isnan(odd_e[behind, k]):
                total[k] -= odd_e[behind, k]
                squares[k] -= odd_e[behind, k] ** 2
                n_lines[k] -= 1.0
        if i < 0:
            continue
        near = 0.0
        for k in range(n_bins):
            if n_lines[k] >= MIN_LINES:
                mean = total[k] / n_lines[k]
                noise = max(squares[k] / n_lines[k] - mean * mean, 0.0) / (n_lines[k] - 1.0) * alike[i]
                near += (mean * mean - CHANCE * noise) / n_bins
        near_e2[i] = max(near, 0.0)


@kernel
def count_alike(
    sigma_px: Float64, beside_px: Float64, n_lines: Float64, values: Float32, alike: Float64
) -> None:
    """Write how many neighbouring centres (n,) scatter as one, the usual number of lines alone or of pairs.

    `sigma_px` is the centres' 1 sigma, `beside_px` that with which a line counts among neighbours.
    """
    for s in range(n_lines.shape[0]):
        alike[s] = (beside_px[s] / sigma_px[s]) ** 2 / n_lines[s]
    for together in range(1, 3):
        count, usual = usual_of(alike, n_lines, together, values)
        for s in range(n_lines.shape[0]):
            if n_lines[s] == together:
                alike[s] = usual if count > 0 else 1.0


@kernel(allocates=True)
def misfit_sigma_px(odd_e: Float64, fits: Float64, alike: Float64, misfit_px: Float64) -> None:
    """Write by how much each line's centre may be off alike with its neighbours' (n,), px.

    `odd_e` (n, N_BINS) are the lines' odd residuals, `fits` (n, 7) their fits; about each so many,
    `alike` (n,), scatter as one. Of two lines that were read as one the second has no residuals.
    """
    mean_square_near(odd_e, round(0.5 * CORRELATION_PX), alike, misfit_px)
    for s in range(misfit_px.shape[0]):
        misfit_px[s] = MOVED * fits[s, 3] * math.sqrt(misfit_px[s]) / fits[s, 2]
