"""Scatter of a stripe's lines beyond their photons', as neighbours in one frame show it.

Speckle and the metal's texture move a stripe's centres by more than photons do, neighbours in common, and
stand still with the surface. Let u_i be a centre off its expected place. Where the surface runs straight, the
second difference of lines L apart

    d_i = (u_{i-L} - 2 u_i + u_{i+L}) / sqrt(6)

has a line's own variance, sigma_i^2 + tau^2, once L is beyond the correlated lines; offset and slope
drop out. Of means over m lines it has that of the mean: m times that says with which variance a line counts
among its neighbours. The median of d^2 over that of chi^2 with one degree of freedom, 0.455, is the variance
whatever corners and spatter do (Allan 1966, Proc. IEEE 54, 221, for means of growing length; Rousseeuw and
Croux 1993, JASA 88, 1273, for the median).

Grains of a texture reach farther than centres can be compared, for a joint's corners are near. They show in
the stripe's brightness. A bell of 1 sigma w on metal whose ln(reflectance) rises by b across it is the same
bell b w^2 farther. On an isotropic texture of covariance C(r) the slopes b of lines r apart have the
covariance -C'(r) / r. Beyond L lines that adds to a line's variance among neighbours

    2 w^4 integral of -C'(r) / r dr = w^4 (C(L) - C(2 L)) / (L ln 2)

with C linear in ln r from L to 2 L, and constant beyond. The brightness' second differences have the variance
V(L) = C(0) - 4/3 C(L) + 1/3 C(2 L), so that C(L) - C(2 L) = 3/4 (V(2 L) - V(L)). The image's scale along the
stripe is taken to be that across it.
"""

from __future__ import annotations

import math

from noise_model.compiled.arrays import Bool, Float32, Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import close_up, finite_median, keep_finite, median_of
from tracker.stripe.line_fit.block import WINDOW_SIGMAS
from tracker.stripe.neighbours import usual_of
from tracker.stripe.scatter import (
    BRIGHTNESS,
    BRIGHTNESS_LAGS,
    BY_LAG,
    BY_LENGTH,
    FAR_LAG,
    LAGS,
    LENGTHS,
    LN_WIDTH,
    SPECKLE,
    WIDTH_VARIANCE,
    brightness_share,
    centre_share,
    line_variance_px2,
)

USUAL_PX = 5.0
"""1 sigma of a stripe, px, up to which lines as far apart as the longest lag scatter by themselves."""

MEDIAN_CHI2 = 0.454936
"""The median of chi^2 with one degree of freedom."""

MIN_SEEN_SHARE = 0.75
"""A mean of fewer of its lines is none."""

MIN_DIFFERENCES = 8
"""Fewer lines tell nothing."""

MIN_PER_LAG, MIN_MEANS, MIN_MEANS_SEARCHING = 32, 36, 72
"""Least number of differences, for each line of a lag and of means.

A joint off its expected place has four corners, each of which spoils two of the first and three of the
second. A third of spoilt differences triples the variance that their median says. While the joint
is still searched that would hide it: a sixth costs a half.
"""

MIN_PER_FAR_LAG = 24
"""Least number of differences of brightness, for each line of the farthest lag.

A joint's four corners spoil two for each, a third of them at most.
"""


OFF, VARIANCE, ALONE, SHARE, MEANS, MEAN_VARIANCE = range(6)
N_SCRATCH = 6
"""The rows of scratch (N_SCRATCH, n_scan), of lines and of their means."""


@kernel
def own_sigma(fits: Float64, expected_px: Float64, n_lines: Float64, room: Float32, own_px: Float64) -> None:
    """Write the lines' 1 sigma (n,), px, by their photons, more where a line fits worse than most do.

    `fits` (n, 7) are `LineFits`', `expected_px` (n,) the widths whose windows they read, `n_lines` (n,) with
    how many each was read. What all lines' chi2 shows beyond 1 is the same for all, a profile that is no bell
    or speckle: the scatter shows what it does to the centres. A pair's chi2 shows more of it than a line's.
    """
    for s in range(own_px.shape[0]):
        own_px[s] = math.nan
        if math.isfinite(fits[s, 4]):
            own_px[s] = max(fits[s, 4] - math.sqrt(1.0 / (WINDOW_SIGMAS * expected_px[s])), 1.0)
    for together in range(1, 3):
        _, usual = usual_of(own_px, n_lines, together, room)
        for s in range(own_px.shape[0]):
            if n_lines[s] == together:
                own_px[s] = fits[s, 1] * math.sqrt(max(1.0 / usual, 1.0 / own_px[s]))


@kernel
def frame_scatter(
    fits: Float64,
    expected_px: Float64,
    width_px: Float64,
    sigma_px: Float64,
    core: Float32,
    n_lines: Float64,
    is_smooth: Bool,
    learned: Float64,
    is_searching: bool,
    values: Float32,
    scratch: Float64,
    seen: Float64,
) -> None:
    """Write the scatter of one frame.

    `fits` (n, 7) are `LineFits`', NaN where there is no stripe, `expected_px` the places and `width_px`
    the widths that the setup gives, `sigma_px` (n,) the lines' own 1 sigma; `core` (n,) is
    `residuals.core_square`; `n_lines` (n,) are with how many each was read, and what is `learned` says how
    much less pairs scatter. `is_searching` says whether the joint may be far off its expected place.
    """
    n, off, share = fits.shape[0], scratch[OFF], scratch[SHARE]
    for s in range(n):
        off[s] = fits[s, 3]
    known_px = finite_median(off, values)
    times = 1 if math.isnan(known_px) else max(round(known_px / USUAL_PX), 1)
    min_means = MIN_MEANS_SEARCHING if is_searching else MIN_MEANS
    differences(
        fits=fits,
        expected_px=expected_px,
        sigma_px=sigma_px,
        n_lines=n_lines,
        is_smooth=is_smooth,
        learned=learned,
        times=times,
        min_means=min_means,
        values=values,
        scratch=scratch,
        seen=seen,
    )
    count = 0
    for s in range(n):
        off[s] = math.log(fits[s, 3] / width_px[s])
        count += math.isfinite(off[s])
    middle, variance = math.nan, math.nan
    if count >= MIN_DIFFERENCES:
        middle = finite_median(off, values)
        for s in range(n):
            off[s] = (off[s] - middle) ** 2 / share[s]
        variance = finite_median(off, values) / MEDIAN_CHI2
    seen[LN_WIDTH], seen[WIDTH_VARIANCE] = middle, variance
    count = keep_finite(core, values)
    seen[SPECKLE] = median_of(values, count) if count >= MIN_DIFFERENCES else math.nan


@kernel
def _variance_of(values: Float64, share: Float64, n: int, lag: int, min_count: int, room: Float32) -> float:
    """Return the variance of the first n values by second differences: the median of d^2 / 6 over 0.455.

    Each value has a `share` (n,) of that variance. NaN where fewer than so many differences are known.
    """
    for i in range(lag, n - lag):
        d = values[i - lag] - 2.0 * values[i] + values[i + lag]
        room[i - lag] = d * d / (share[i - lag] + 4.0 * share[i] + share[i + lag])
    count = close_up(room, max(n - 2 * lag, 0))
    return median_of(room, count) / MEDIAN_CHI2 if count >= min_count else math.nan


@kernel
def _own_variance_of(variances: Float64, n: int, lag: int, room: Float32) -> float:
    """Return the median variance that second differences have of n variances alone, NaN for none known."""
    for i in range(lag, n - lag):
        room[i - lag] = (variances[i - lag] + 4.0 * variances[i] + variances[i + lag]) / 6.0
    return median_of(room, close_up(room, max(n - 2 * lag, 0)))


@kernel
def differences(
    fits: Float64,
    expected_px: Float64,
    sigma_px: Float64,
    n_lines: Float64,
    is_smooth: Bool,
    learned: Float64,
    times: int,
    min_means: int,
    values: Float32,
    scratch: Float64,
    seen: Float64,
) -> None:
    """Write the variances by second differences, by lag and of means, less the lines' own, px^2.

    LAGS and LENGTHS count so many `times`. Fewer than `min_means` differences of means tell nothing. Into
    `seen` goes the square of the amplitudes' contrast, by its own lags, of which the last asks for
    more differences. Pairs have the share of a line's variance that is `learned`: with it they tell that of
    lines FAR_LAG apart and more. Means over an even number of lines are the same of pairs.
    """
    n, off, alone, share = fits.shape[0], scratch[OFF], scratch[ALONE], scratch[SHARE]
    own_px2, means, mean_variance = scratch[VARIANCE], scratch[MEANS], scratch[MEAN_VARIANCE]
    of_two = brightness_share(learned)
    for i in range(n):
        off[i] = fits[i, 2]
        alone[i] = fits[i, 2] if n_lines[i] == 1 and is_smooth[i] else math.nan
        share[i] = 1.0 if n_lines[i] == 1 else of_two
    typical_e = finite_median(off, values)
    for k in range(len(BRIGHTNESS_LAGS)):
        lag = BRIGHTNESS_LAGS[k]
        min_count = MIN_PER_FAR_LAG * lag if k == len(BRIGHTNESS_LAGS) - 1 else MIN_DIFFERENCES
        read = off if lag >= FAR_LAG else alone
        seen[BRIGHTNESS + k] = _variance_of(read, share, n, lag, min_count, values) / typical_e**2
    line, of_two = line_variance_px2(learned), centre_share(learned) * line_variance_px2(learned)
    for i in range(n):
        off[i] = fits[i, 0] - expected_px[i]
        own_px2[i] = sigma_px[i] ** 2
        alone[i] = off[i] if n_lines[i] == 1 and is_smooth[i] else math.nan
        if n_lines[i] > 1:
            share[i] = (0.5 * own_px2[i] + of_two) / (own_px2[i] + line)
    for k in range(len(LAGS)):
        is_far = LAGS[k] >= FAR_LAG
        lag = times * LAGS[k] if is_far else LAGS[k]
        read = off if is_far else alone
        min_count = MIN_PER_LAG * lag if is_far else MIN_DIFFERENCES
        variance = _variance_of(read, share, n, lag, min_count, values)
        seen[BY_LAG + k] = variance - _own_variance_of(own_px2, n, lag, values)
    for k in range(len(LENGTHS)):
        length = times * LENGTHS[k]
        for b in range(n // length):
            added, variance, known = 0.0, 0.0, 0
            for i in range(b * length, (b + 1) * length):
                if math.isfinite(off[i]):
                    added += off[i]
                    variance += own_px2[i]
                    known += 1
            is_mean = known >= MIN_SEEN_SHARE * length
            means[b] = added / known if is_mean else math.nan
            mean_variance[b] = variance / known if is_mean else math.nan
            alone[b] = 1.0
        variance = _variance_of(means, alone, n // length, 1, min_means, values)
        own = _own_variance_of(mean_variance, n // length, 1, values)
        seen[BY_LENGTH + k] = length * variance - own
