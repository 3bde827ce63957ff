"""What a stripe's lines scatter by beyond their photons, learned from how they lie beside each other.

Speckle and the metal's texture move a stripe's centres by more than photons do, neighbours alike, and stand
still with the surface. Let u_i be a centre off its expected place. Where the surface runs straight, the
second difference of lines L apart

    d_i = (u_{i-L} - 2 u_i + u_{i+L}) / sqrt(6)

has a line's own variance, sigma_i^2 + tau^2, once L is beyond the lines that scatter alike; offset and slope
drop out. Of means over m lines it has that of the mean: m times that says with which variance a line counts
among its neighbours. The median of d^2 over that of chi^2 with one degree of freedom, 0.455, is the variance
whatever corners and spatter do (Allan 1966, Proc. IEEE 54, 221, for means of growing length; Rousseeuw and
Croux 1993, JASA 88, 1273, for the median). What all frames so far say is averaged before it is used: no
setup states it.

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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float32, Float64, Int64
from noise_model.kernel import kernel
from noise_model.median import median
from tracker.stripe.fit import WINDOW_SIGMAS

LAGS = np.array([1, 2, 4, 8])
"""How many lines apart centres are compared: speckle's grains reach over a few.

These and LENGTHS are those of a stripe of USUAL_PX at most: a wider one's lines are alike over more.
"""

USUAL_PX = 5.0
"""1 sigma of a stripe, px, up to which lines as far apart as the longest lag scatter by themselves."""

BRIGHTNESS_LAGS = np.append(LAGS, 2 * LAGS[-1])
"""How many lines apart their brightness is compared."""

LENGTHS = np.array([2, 4, 8, 16])
"""Over how many lines centres are averaged."""

MEDIAN_CHI2 = 0.454936
"""The median of chi^2 with one degree of freedom."""

MIN_SEEN_SHARE = 0.75
"""A mean of fewer of its lines is none."""

MIN_DIFFERENCES = 8
"""Fewer lines tell nothing."""

MIN_PER_LAG, MIN_MEANS, MIN_MEANS_SEARCHING = 32, 36, 72
"""So many differences tell something, for each line of a lag and of means.

A joint off its expected place has four corners, each of which spoils two of the first and three of the
second. A third of spoilt differences triples the variance that their median says. While the joint
is still searched that would hide it: a sixth costs a half.
"""

MIN_PER_FAR_LAG = 24
"""So many differences of brightness tell something, for each line of the farthest lag.

A joint's four corners spoil two for each, a third of them at most.
"""

CORE_SIGMAS = 1.5
"""So near to a bell's middle its light is compared with a line's pixels."""

WIDTH_SIGMAS, MIN_WIDTH_LIMIT_LN, MAX_WIDTH_LIMIT_LN = 4.0, 0.35, 0.9
"""How far a line's ln(width) may lie off the stripe's: in sigmas of the lines' scatter, at least, at most.

Two faces make a line wider by a third; what is wider by more than the last is no stripe.
"""

WEIGHED_SHARE = 0.5
"""The share of the speckle's contrast that weighs pixels.

All of it would weigh a bell's flanks most, and no stripe's flanks are a bell's. On real metal centres scatter
least from 0.25 to 0.5, and by a quarter more at 1.
"""

MAX_LN_WIDTH = 0.45
"""A stripe that is wider or narrower than the setup says by more is another light."""

MAX_ALIKE = 0.9
"""Neighbouring lines' brightness is alike by no more: the rest is what the optics leave."""

REMEMBERED = 10
"""About so many frames are averaged: the metal changes along the seam."""


class FrameScatter(NamedTuple):
    """What one frame shows beyond photons' noise; NaN where it shows nothing.

    `by_lag` and `by_length`, px^2: the centres' variance beyond the lines' own. `brightness`, by its lags:
    the square of the amplitudes' contrast; `speckle`: that of a pixel's light about the fitted bell.
    `ln_width` and `width_variance`: the median of ln(width / expected width) and its robust variance.
    """

    by_lag: Float64
    by_length: Float64
    brightness: Float64
    speckle: Float64
    ln_width: Float64
    width_variance: Float64


_NOTHING = FrameScatter(
    np.full(len(LAGS), math.nan),
    np.full(len(LENGTHS), math.nan),
    np.full(len(BRIGHTNESS_LAGS), math.nan),
    *(np.array(math.nan) for _ in range(3)),
)


@dataclass(frozen=True, eq=False)
class Scatter:
    """What the frames so far show of the scatter: the average of what `frames` of them show.

    Negative variances are chance.
    """

    average: FrameScatter = _NOTHING
    frames: int = 0

    @property
    def line_variance_px2(self) -> float:
        """By how much a line's centre scatters beyond its own variance."""
        return _plateau(self.average.by_lag)

    @property
    def mean_variance_px2(self) -> float:
        """The variance beyond its own with which a line counts among neighbours."""
        return max(self.line_variance_px2, _plateau(self.average.by_length))

    @property
    def brightness_contrast(self) -> float:
        """By how much the stripe's brightness scatters from line to line, relative."""
        return math.sqrt(self._brightness_plateau)

    @property
    def brightness_alike(self) -> float:
        """The correlation of two neighbouring lines' brightness, where two k apart have its k-th power.

        Second differences over L lines have the variance (1 - r) (3 - r) / 3, r = rho^L, over that of lines
        far apart. A grain is rounder than that law: L = 2 tells its width best.
        """
        near = float(self.average.brightness[BRIGHTNESS_LAGS == 2][0])
        if not self._brightness_plateau > 0.0 or math.isnan(near):
            return 0.0
        of_two = 2.0 - math.sqrt(1.0 + 3.0 * near / self._brightness_plateau)
        return min(math.sqrt(max(of_two, 0.0)), MAX_ALIKE)

    @property
    def _brightness_plateau(self) -> float:
        of_grains = self.average.brightness[: len(LAGS)]
        known = of_grains[np.isfinite(of_grains)]
        return float(known.max()) if len(known) else 0.0

    @property
    def _texture(self) -> float:
        """What a texture adds to a line's variance among neighbours, over the fourth power of its sigma."""
        near, far = self.average.brightness[-2:].tolist()
        return max(0.75 * (far - near) / (float(LAGS[-1]) * math.log(2.0)), 0.0) if far > near else 0.0

    @property
    def speckle_contrast(self) -> float:
        """By how much a pixel's share of the stripe's light scatters, relative."""
        return _root(self.average.speckle)

    @property
    def weighing_contrast(self) -> float:
        """The contrast with which a fit weighs a line's pixels."""
        return WEIGHED_SHARE * self.speckle_contrast

    @property
    def width_factor(self) -> float:
        """How much wider the stripe is than the setup says."""
        return math.exp(float(self.average.ln_width)) if self._is_as_stated else 1.0

    @property
    def _is_as_stated(self) -> bool:
        """Whether the lines' width is one that the stated stripe may have."""
        return abs(float(self.average.ln_width)) <= MAX_LN_WIDTH

    @property
    def width_limit_ln(self) -> float:
        """How far a line's ln(width) may lie off the stripe's: farther off it is two faces, or no stripe."""
        if not self._is_as_stated:
            return MIN_WIDTH_LIMIT_LN
        spread = WIDTH_SIGMAS * _root(self.average.width_variance)
        return min(max(spread, MIN_WIDTH_LIMIT_LN), MAX_WIDTH_LIMIT_LN)

    def with_frame(self, seen: FrameScatter) -> Scatter:
        """Return the scatter with one more frame."""
        weight = 1.0 / min(self.frames + 1, REMEMBERED)
        mixed = (_averaged(before, now, weight) for before, now in zip(self.average, seen, strict=True))
        return Scatter(FrameScatter(*mixed), self.frames + 1)

    def widened(self, sigma_px: Float64, sheet_px: float) -> tuple[Float64, Float64]:
        """Return the lines' 1 sigma (n,) with the scatter, and that which counts among neighbours.

        `sheet_px` is the sheet's 1 sigma in the image, without what the lens spreads.
        """
        own = sigma_px**2
        # Of a texture finer than itself a sheet sees the mean.
        texture_px2 = self._texture * sheet_px**4 if sheet_px <= LAGS[-1] else 0.0
        together = own + self.mean_variance_px2 + texture_px2
        return np.sqrt(own + self.line_variance_px2), np.sqrt(together)


NO_SCATTER = Scatter()


def own_sigma(fits: Float64, expected_px: Float64) -> Float64:
    """Return the lines' 1 sigma (n,), px, by their photons, more where a line fits worse than most do.

    `fits` (n, 7) are `fit_lines`', `expected_px` (n,) the widths whose windows they read. What all lines'
    chi2 shows beyond 1 is the same for all, a profile that is no bell or speckle: the scatter tells what it
    does to the centres.
    """
    excess = np.maximum(fits[:, 4] - np.sqrt(1.0 / (WINDOW_SIGMAS * expected_px)), 1.0)
    known = excess[np.isfinite(excess)]
    usual = median(known) if len(known) else 1.0
    return np.asarray(fits[:, 1] * np.sqrt(np.maximum(1.0 / usual, 1.0 / excess)))


def _root(variance: Float64) -> float:
    """Return a variance's root; 0 for one that is not known, or below 0 by chance."""
    return math.sqrt(variance) if variance > 0.0 else 0.0


def _plateau(variances: Float64) -> float:
    """Return the larger of the last two that are known, the farthest lags or the longest means; 0 for none.

    Lines that lie near each other scatter alike: the variance grows with their distance up to its plateau.
    """
    known = variances[np.isfinite(variances)]
    return max(float(known[-2:].max()), 0.0) if len(known) else 0.0


def _averaged(before: Float64, seen: Float64, weight: float) -> Float64:
    """Return running averages (n,): what a frame does not tell stays, what is told first is taken whole."""
    mixed = np.where(np.isnan(before), seen, before + weight * (seen - before))
    return np.asarray(np.where(np.isnan(seen), before, mixed))


def frame_scatter(
    fits: Float64,
    expected_px: Float64,
    width_px: Float64,
    sigma_px: Float64,
    speckle: float,
    is_searching: bool,
) -> FrameScatter:
    """Return what one frame shows of its scatter.

    `fits` (n, 7) are `fit_lines`', NaN where there is no stripe, `expected_px` the places and `width_px` the
    widths that the setup gives, `sigma_px` (n,) the lines' own 1 sigma; `speckle` is the square of the
    pixels' contrast, as `speckle_squared` has it; `is_searching` says whether the joint may be far off its
    expected place.
    """
    by_lag, by_length = np.empty(len(LAGS)), np.empty(len(LENGTHS))
    brightness = np.empty(len(BRIGHTNESS_LAGS))
    min_means = MIN_MEANS_SEARCHING if is_searching else MIN_MEANS
    known_px = fits[np.isfinite(fits[:, 3]), 3]
    times = max(round(median(known_px) / USUAL_PX), 1) if len(known_px) else 1
    differences(
        fits[:, 0],
        expected_px,
        sigma_px,
        fits[:, 2],
        times * LAGS,
        times * LENGTHS,
        BRIGHTNESS_LAGS,
        min_means,
        by_lag,
        by_length,
        brightness,
    )
    ln_width = np.log(fits[:, 3] / width_px)
    known = ln_width[np.isfinite(ln_width)]
    middle, variance = math.nan, math.nan
    if len(known) >= MIN_DIFFERENCES:
        middle = median(known)
        variance = median((known - middle) ** 2) / MEDIAN_CHI2
    return FrameScatter(
        by_lag, by_length, brightness, *(np.array(value) for value in (speckle, middle, variance))
    )


@kernel(allocates=True)
def speckle_squared(
    charge_e: Float32,
    background_e: Float32,
    censored: Bool,
    fits: Float64,
    lows: Int64,
    cell: int,
    shot: float,
    dark_variance_e2: float,
) -> float:
    """Return the square of the contrast with which pixels scatter about a stripe's bells; NaN for none.

    The bands (n, depth) and what follows are as `fit_lines` has them. Within a line's core the residuals'
    squares are the photons' variance and the square of contrast times light; their median over the lines
    stands for all.
    """
    n = fits.shape[0]
    squares, count = np.empty(n), 0
    for s in range(n):
        if math.isnan(fits[s, 0]):
            continue
        centre, width, amplitude = fits[s, 0] - lows[s // cell], fits[s, 3], fits[s, 2]
        first, last = math.ceil(centre - CORE_SIGMAS * width), math.floor(centre + CORE_SIGMAS * width)
        over, light = 0.0, 0.0
        for j in range(max(first, 0), min(last + 1, charge_e.shape[1])):
            if censored[s, j]:
                continue
            t = (j - centre) / width
            mean = amplitude * math.exp(-0.5 * t * t)
            off = charge_e[s, j] - background_e[s, j] - mean
            over += off * off - shot * max(mean + background_e[s, j], 0.0) - dark_variance_e2
            light += mean * mean
        if light > 0.0:
            squares[count] = over / light
            count += 1
    return float(np.median(squares[:count])) if count >= MIN_DIFFERENCES else math.nan


@kernel(allocates=True)
def _variance_of(values: Float64, lag: int, least: int) -> float:
    """Return the variance of values (n,) by second differences: the median of d^2 / 6 over 0.455.

    NaN where fewer than so many differences are known.
    """
    n = values.shape[0]
    squares, count = np.empty(n), 0
    for i in range(lag, n - lag):
        d = values[i - lag] - 2.0 * values[i] + values[i + lag]
        if math.isfinite(d):
            squares[count] = d * d / 6.0
            count += 1
    return float(np.median(squares[:count]) / MEDIAN_CHI2) if count >= least else math.nan


@kernel(allocates=True)
def _own_variance_of(variances: Float64, lag: int) -> float:
    """Return the median variance that second differences have of variances (n,) alone, NaN for none known."""
    n = variances.shape[0]
    own, count = np.empty(n), 0
    for i in range(lag, n - lag):
        of_three = (variances[i - lag] + 4.0 * variances[i] + variances[i + lag]) / 6.0
        if math.isfinite(of_three):
            own[count] = of_three
            count += 1
    return float(np.median(own[:count])) if count > 0 else math.nan


@kernel(allocates=True)
def differences(
    position_px: Float64,
    expected_px: Float64,
    sigma_px: Float64,
    amplitude_e: Float64,
    lags: Int64,
    lengths: Int64,
    brightness_lags: Int64,
    min_means: int,
    by_lag: Float64,
    by_length: Float64,
    brightness: Float64,
) -> None:
    """Write the variances by second differences, by lag and of means, less the lines' own, px^2.

    Fewer than `min_means` differences of means tell nothing. Into `brightness` goes the square of the
    amplitudes' contrast, by its own lags, of which the last asks for more differences.
    """
    n = position_px.shape[0]
    off, variances, amplitudes = np.empty(n), np.empty(n), np.empty(n)
    held = 0
    for i in range(n):
        off[i] = position_px[i] - expected_px[i]
        variances[i] = sigma_px[i] ** 2
        if math.isfinite(amplitude_e[i]):
            amplitudes[held] = amplitude_e[i]
            held += 1
    typical_e = np.median(amplitudes[:held]) if held > 0 else math.nan
    for k in range(len(lags)):
        by_lag[k] = _variance_of(off, lags[k], MIN_PER_LAG * lags[k]) - _own_variance_of(variances, lags[k])
    for k in range(len(brightness_lags)):
        lag = brightness_lags[k]
        least = MIN_PER_FAR_LAG * lag if k == len(brightness_lags) - 1 else MIN_DIFFERENCES
        brightness[k] = _variance_of(amplitude_e, lag, least) / typical_e**2
    for k in range(len(lengths)):
        length = lengths[k]
        means, own = np.empty(n // length), np.empty(n // length)
        for b in range(n // length):
            total, variance, seen = 0.0, 0.0, 0
            for i in range(b * length, (b + 1) * length):
                if math.isfinite(off[i]):
                    total += off[i]
                    variance += variances[i]
                    seen += 1
            is_mean = seen >= MIN_SEEN_SHARE * length
            means[b] = total / seen if is_mean else math.nan
            own[b] = variance / seen if is_mean else math.nan
        by_length[k] = length * _variance_of(means, 1, min_means) - _own_variance_of(own, 1)
