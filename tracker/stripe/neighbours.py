"""Common errors of neighbouring scan lines: two are read as one, and unexpected light moves them in common.

Far from corners and steps a stripe's centre runs straight, and two neighbouring lines tell no more than their
mean does. The mean of their pixels is fitted as one line. Its photons' noise is a half of either line's, its
centre the mean of both centres.

What lines scatter by beyond their photons, neighbours share. With C(k) the covariance of two lines k apart,
the mean of two has of a line's variance C(0) the share

    (C(0) + C(1)) / (2 C(0)),

a half where lines know nothing of each other, all of it where they are equal. Two lines' own noise is that of
their mean twice: so a pair's fit says what either line would say alone, and what is learned of lines is
learned of pairs too.

Where the light beneath the stripe is not as expected, neighbours are off in common. A scan line's fit has a
level and a slope for what the background may be wrong by, and a width for the stripe.
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

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import median_of
from tracker.stripe.line_fit.block import CORRELATION_PX
from tracker.stripe.line_fit.lines import N_FITTED, LineFits
from tracker.stripe.line_fit.residuals import N_BINS

CLEAR_SIGMAS = 3.0
"""Distance from a possible corner, in stripe sigmas, from which no line holds light of two faces."""

AGREES_LINES = 3
"""Over so many lines to either side the likeliest path follows the expected section, but for one offset."""

MAX_STEP_WIDTHS = 0.25
"""Two lines whose stripes lie farther apart than this share of their width make a wider bell."""

ALONE, EVERY = 6, 48
"""Lines read alone, of every so many that pairs might hold: they determine the neighbours' correlation."""

NOWHERE = 1 << 30
"""The line of a corner that there is not."""


@kernel
def _agrees(choice: Int64, first: int, last: int) -> bool:
    """Return True if the likeliest path follows the expected stripe over some lines, and leaves out none."""
    lowest, highest = choice[first], choice[first]
    for s in range(first, last + 1):
        lowest, highest = min(lowest, choice[s]), max(highest, choice[s])
    agrees: bool = lowest >= 0 and highest - lowest <= 1
    return agrees


@kernel
def _next_corner(face: Int64, first: int) -> int:
    """Return the first line from `first` on that is the last one on its face, NOWHERE for none."""
    for s in range(first, face.shape[0] - 1):
        if face[s] != face[s + 1]:
            return s
    return NOWHERE


@kernel
def mark_pairs(
    choice: Int64,
    face: Int64,
    expected_px: Float64,
    width_px: Float64,
    reach_px: float,
    n_lines: Float64,
    is_smooth: Bool,
) -> None:
    """Write with how many lines each (n,) is read: 2 for an even line and the next as one, else 1.

    That is where the surface `is_smooth` (n,), but for a few. `choice` (n,) is the offset of the likeliest
    path from the expected stripe, -1 for no stripe; `face`, `expected_px` and `width_px` (n,) are the face
    that this lies on, its place and 1 sigma. Its corners may lie `reach_px` off their places.
    """
    n, widest = choice.shape[0], 0.0
    for s in range(n):
        widest = max(widest, width_px[s])
        n_lines[s], is_smooth[s] = 1, False
    clear = math.ceil(reach_px + CLEAR_SIGMAS * widest)
    before, behind = -NOWHERE, _next_corner(face, 0)
    for s in range(0, n - 1, 2):
        while behind < s:
            before, behind = behind, _next_corner(face, behind + 1)
        first, last = s - AGREES_LINES, s + 1 + AGREES_LINES
        is_inside = first >= 0 and last < n and s - before > clear and behind - s > clear
        is_steep = abs(expected_px[s + 1] - expected_px[s]) > MAX_STEP_WIDTHS * width_px[s]
        if is_inside and not is_steep and _agrees(choice, first, last):
            is_smooth[s] = is_smooth[s + 1] = True
            if s % EVERY >= ALONE:
                n_lines[s] = n_lines[s + 1] = 2


@kernel
def tell_both(expected_px: Float64, n_lines: Float64, speckle_share: float, lines: LineFits) -> None:
    """Write the fits of either line of pairs, whose own stand in their first lines.

    Both lie where the expected stripe's slope has them about the one centre. A line alone would have its
    1 sigma times the root of 2, and the speckle of a pixel's light over the `speckle_share`.
    """
    for s in range(0, expected_px.shape[0] - 1, 2):
        if n_lines[s] < 2:
            continue
        half_px = 0.5 * (expected_px[s + 1] - expected_px[s])
        for fits in (lines.tried, lines.fits):
            fits[s, 1] *= math.sqrt(2.0)
            for k in range(N_FITTED):
                fits[s + 1, k] = fits[s, k]
            fits[s, 0] -= half_px
            fits[s + 1, 0] += half_px
        lines.core[s] /= speckle_share
        lines.core[s + 1], lines.saturated[s + 1] = lines.core[s], lines.saturated[s]
        for k in range(N_BINS):
            lines.odd[s + 1, k] = lines.odd[s, k]


@kernel
def usual_of(values: Float64, n_lines: Float64, together: int, room: Float32) -> tuple[int, float]:
    """Return the number of known values (n,) where so many lines were read `together`, and their median.

    That is NaN where none is. `room` is scratch of `median.median_of`.
    """
    count = 0
    for s in range(values.shape[0]):
        if n_lines[s] == together and math.isfinite(values[s]):
            room[count] = values[s]
            count += 1
    return count, median_of(room, count)


MOVED = 5.0
"""Shift of a centre, in widths, over the odd residual relative to the amplitude."""

MIN_LINES = 6
"""A mean of fewer lines than this shows nothing above noise."""

CHANCE = 3.3
"""A mean of N_BINS squares of noise exceeds its expectation by this factor once in 100 (chi2 of 4)."""


@kernel(allocates=True)
def mean_square_near(odd_e: Float64, half: int, as_one: Float64, near_e2: Float64) -> None:
    """Write the mean square (n,), e-^2, of the odd residuals' means over lines up to `half` away.

    Less what the lines' own scatter gives it by chance, 0 where that explains it or too few lines are known.
    About each line `as_one` (n,) scatter as one.
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
                noise = max(squares[k] / n_lines[k] - mean * mean, 0.0) / (n_lines[k] - 1.0) * as_one[i]
                near += (mean * mean - CHANCE * noise) / n_bins
        near_e2[i] = max(near, 0.0)


@kernel
def write_centres_as_one(
    sigma_px: Float64, beside_px: Float64, n_lines: Float64, values: Float32, as_one: Float64
) -> None:
    """Write the usual number of neighbouring centres (n,) that scatter as one, of lines alone or of pairs.

    `sigma_px` is the centres' 1 sigma, `beside_px` that with which a line counts among neighbours.
    """
    for s in range(n_lines.shape[0]):
        as_one[s] = (beside_px[s] / sigma_px[s]) ** 2 / n_lines[s]
    for together in range(1, 3):
        count, usual = usual_of(as_one, n_lines, together, values)
        for s in range(n_lines.shape[0]):
            if n_lines[s] == together:
                as_one[s] = usual if count > 0 else 1.0


@kernel(allocates=True)
def misfit_sigma_px(odd_e: Float64, fits: Float64, as_one: Float64, misfit_px: Float64) -> None:
    """Write the common-mode error of each line's centre with its neighbours' (n,), px.

    `odd_e` (n, N_BINS) are the lines' odd residuals, `fits` (n, 7) their fits; about each
    `as_one` (n,) scatter as one. Of two lines that were read as one the second has no residuals.
    """
    mean_square_near(odd_e, round(0.5 * CORRELATION_PX), as_one, misfit_px)
    for s in range(misfit_px.shape[0]):
        misfit_px[s] = MOVED * fits[s, 3] * math.sqrt(misfit_px[s]) / fits[s, 2]
