"""Scatter of a stripe's lines beyond their photons', learned from frame to frame.

`frame_scatter` says what one frame shows; what all frames so far say is averaged before it is used: no setup
states it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel

LAGS = np.array([1, 2, 4, 8])
"""Lags, in lines, at which centres are compared: speckle's grains reach over a few.

From FAR_LAG on these, and LENGTHS, are those of a stripe of USUAL_PX at most: a wider one's lines are
correlated over more.
"""

FAR_LAG = 4
"""Lines as far apart as this are compared where two were read as one too, nearer ones where none were."""

BRIGHTNESS_LAGS = np.append(LAGS, 2 * LAGS[-1])
"""Lags, in lines, at which their brightness is compared."""

SECOND_LAG, FARTHEST_LAG = 1, 8.0
"""Index of the lag of two lines in these, and the farthest lag of centres, in lines."""

LENGTHS = np.array([2, 4, 8, 16])
"""Over how many lines centres are averaged."""

WIDTH_SIGMAS, MIN_WIDTH_LIMIT_LN, MAX_WIDTH_LIMIT_LN = 4.0, 0.35, 0.9
"""Limit of a line's ln(width) about the stripe's: in sigmas of the lines' scatter, at least, at most.

Two faces make a line wider by a third; what is wider by more than the last is no stripe.
"""

WEIGHED_SHARE = 0.5
"""The share of the speckle's contrast that weighs pixels.

All of it would weigh a bell's flanks most, and no stripe's flanks are a bell's. On real metal centres scatter
least from 0.25 to 0.5, and by a quarter more at 1.
"""

REMEMBERED = 10
"""About so many frames are averaged: the metal changes along the seam."""


BY_LAG = 0
BY_LENGTH = BY_LAG + len(LAGS)
BRIGHTNESS = BY_LENGTH + len(LENGTHS)
SPECKLE = BRIGHTNESS + len(BRIGHTNESS_LAGS)
LN_WIDTH, WIDTH_VARIANCE = SPECKLE + 1, SPECKLE + 2
N_NUMBERS = SPECKLE + 3
"""Start of the values of a `FrameScatter` in the one array that kernels take."""


class FrameScatter(NamedTuple):
    """Scatter of one frame beyond photons' noise; NaN where it shows none.

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

    @classmethod
    def of(cls, numbers: Float64) -> FrameScatter:
        """Return the scatter that an array (N_NUMBERS,) holds."""
        return cls(
            by_lag=numbers[BY_LAG:BY_LENGTH],
            by_length=numbers[BY_LENGTH:BRIGHTNESS],
            brightness=numbers[BRIGHTNESS:SPECKLE],
            speckle=numbers[SPECKLE:LN_WIDTH].reshape(()),
            ln_width=numbers[LN_WIDTH:WIDTH_VARIANCE].reshape(()),
            width_variance=numbers[WIDTH_VARIANCE:].reshape(()),
        )

    @property
    def numbers(self) -> Float64:
        """All of it in one array (N_NUMBERS,), as the kernels take it."""
        numbers = np.empty(N_NUMBERS)
        numbers[:BY_LENGTH], numbers[BY_LENGTH:BRIGHTNESS], numbers[BRIGHTNESS:SPECKLE] = self[:3]
        numbers[SPECKLE], numbers[LN_WIDTH], numbers[WIDTH_VARIANCE] = self[3:]
        return numbers


_NOTHING = FrameScatter.of(np.full(N_NUMBERS, math.nan))


@kernel
def _root(variance: float) -> float:
    """Return a variance's root; 0 for one that is not known, or below 0 by chance."""
    return math.sqrt(variance) if variance > 0.0 else 0.0


@kernel
def _plateau(variances: Float64) -> float:
    """Return the larger of the last two that are known, the farthest lags or the longest means; 0 for none.

    Lines that lie near each other are correlated: the variance grows with their distance up to its plateau.
    """
    largest, n = 0.0, 0
    for k in range(variances.shape[0] - 1, -1, -1):
        if n < 2 and math.isfinite(variances[k]):
            largest, n = max(largest, variances[k]), n + 1
    return largest


@kernel
def line_variance_px2(average: Float64) -> float:
    """Return the variance of a line's centre beyond its own."""
    return _plateau(average[BY_LAG:BY_LENGTH])


@kernel
def mean_variance_px2(average: Float64) -> float:
    """Return the variance beyond its own with which a line counts among neighbours."""
    return max(_plateau(average[BY_LAG:BY_LENGTH]), _plateau(average[BY_LENGTH:BRIGHTNESS]))


@kernel
def _share_of_two(variances: Float64, plateau: float) -> float:
    """Return the share of lines' variance that the mean of two neighbours has; all of it if it is not known.

    That is (1 + C(1) / C(0)) / 2, C(L) the covariance of lines L apart. `variances` are those of second
    differences of lines 1, 2 and 4 apart, V(L) = C(0) - 4/3 C(L) + 1/3 C(2 L). So C(L) is
    3/4 (C(0) - V(L) + 1/3 C(2 L)), from the farthest of them on: lines 8 apart know nothing of each other.
    `plateau` is C(0), and lines that do not scatter know nothing of each other either.
    """
    correlation = 0.0
    if not plateau > 0.0:
        return 0.5
    for k in range(2, -1, -1):
        if math.isnan(variances[k]):
            return 1.0
        correlation = min(max(0.75 * (1.0 - variances[k] / plateau + correlation / 3.0), 0.0), 1.0)
    return 0.5 * (1.0 + correlation)


@kernel
def centre_share(average: Float64) -> float:
    """Return the share of `line_variance_px2` that the mean of two neighbours' centres has."""
    return _share_of_two(average[BY_LAG:BY_LENGTH], _plateau(average[BY_LAG:BY_LENGTH]))


@kernel
def brightness_share(average: Float64) -> float:
    """Return the share of `brightness_plateau` that the mean brightness of two neighbours has."""
    return _share_of_two(average[BRIGHTNESS:SPECKLE], brightness_plateau(average))


@kernel
def brightness_plateau(average: Float64) -> float:
    """Return the square of the contrast by which brightness scatters between lines far apart; 0 for none."""
    largest = 0.0
    for k in range(BRIGHTNESS, SPECKLE - 1):
        if math.isfinite(average[k]):
            largest = max(largest, average[k])
    return largest


@kernel
def brightness_correlation(average: Float64) -> float:
    """Return the correlation of two neighbouring lines' brightness, where two k apart have its k-th power.

    Second differences over L lines have the variance (1 - r) (3 - r) / 3, r = rho^L, over that of lines
    far apart. A grain is rounder than that law: L = 2 tells its width best.
    """
    near, plateau = average[BRIGHTNESS + SECOND_LAG], brightness_plateau(average)
    if not plateau > 0.0 or math.isnan(near):
        return 0.0
    of_two = 2.0 - math.sqrt(1.0 + 3.0 * near / plateau)
    # Largest correlation of neighbouring lines' brightness: the rest is what the optics leave.
    return min(math.sqrt(max(float(of_two), 0.0)), 0.9)


@kernel
def texture(average: Float64) -> float:
    """Return a texture's part of a line's variance among neighbours, over its sigma's fourth power."""
    near, far = average[SPECKLE - 2], average[SPECKLE - 1]
    if not far > near:
        return 0.0
    return max(0.75 * float(far - near) / (FARTHEST_LAG * math.log(2.0)), 0.0)


@kernel
def weighing_contrast(average: Float64) -> float:
    """Return the contrast with which a fit weighs a line's pixels."""
    return WEIGHED_SHARE * _root(average[SPECKLE])


@kernel
def pair_contrast(average: Float64) -> float:
    """Return the contrast with which a fit weighs the mean pixels of two lines."""
    return weighing_contrast(average) * math.sqrt(centre_share(average))


@kernel
def _is_as_stated(average: Float64) -> bool:
    """Return True if the lines' width is one that the stated stripe may have."""
    # A stripe that is wider or narrower than the setup says by more is another light.
    return bool(abs(average[LN_WIDTH]) <= 0.45)


@kernel
def width_factor(average: Float64) -> float:
    """Return the stripe's width over that of the setup."""
    return math.exp(average[LN_WIDTH]) if _is_as_stated(average) else 1.0


@kernel
def width_limit_ln(average: Float64) -> float:
    """Return the limit of a line's ln(width) about the stripe's: beyond, it is two faces, or no stripe."""
    if not _is_as_stated(average):
        return MIN_WIDTH_LIMIT_LN
    spread = WIDTH_SIGMAS * _root(average[WIDTH_VARIANCE])
    return min(max(spread, MIN_WIDTH_LIMIT_LN), MAX_WIDTH_LIMIT_LN)


@kernel
def _mix_one(before: float, seen: float, weight: float) -> float:
    """Return a running average: what a frame does not show stays, what is shown first is taken whole."""
    if math.isnan(seen):
        return before
    return seen if math.isnan(before) else before + weight * (seen - before)


@kernel
def add_frame(average: Float64, frames: int, seen: Float64, after: Float64) -> None:
    """Write the average (N_NUMBERS,) of so many frames and one more."""
    weight = 1.0 / min(frames + 1, REMEMBERED)
    for k in range(average.shape[0]):
        after[k] = _mix_one(average[k], seen[k], weight)


@kernel
def widen(
    average: Float64,
    own_px: Float64,
    n_lines: Float64,
    sheet_px: float,
    sigma_px: Float64,
    beside_px: Float64,
) -> None:
    """Write the centres' 1 sigma (n,) with the scatter, and that with which a line counts among neighbours.

    `own_px` (n,) is that of a line alone, and `n_lines` (n,) with how many each was read. The centre that two
    lines share is surer than either's would be; among neighbours both of them count. `sheet_px` is the
    sheet's 1 sigma in the image, without what the lens spreads.
    """
    # Of a texture finer than itself a sheet sees the mean.
    texture_px2 = texture(average) * sheet_px**4 if sheet_px <= FARTHEST_LAG else 0.0
    line, together = line_variance_px2(average), mean_variance_px2(average) + texture_px2
    of_two = centre_share(average) * line
    for s in range(own_px.shape[0]):
        own = own_px[s] * own_px[s]
        sigma_px[s] = math.sqrt(own + line if n_lines[s] == 1 else 0.5 * own + of_two)
        beside_px[s] = math.sqrt(own + together)


class Scatter(NamedTuple):
    """Average scatter of the `frames` frames so far.

    Negative variances are chance.
    """

    average: FrameScatter = _NOTHING
    frames: int = 0

    @property
    def weighing_contrast(self) -> float:
        """The contrast with which a fit weighs a line's pixels."""
        return weighing_contrast(self.average.numbers)

    @property
    def pair_contrast(self) -> float:
        """The contrast with which a fit weighs the mean pixels of two lines."""
        return pair_contrast(self.average.numbers)

    @property
    def width_factor(self) -> float:
        """Width of the stripe over that of the setup."""
        return width_factor(self.average.numbers)

    @property
    def width_limit_ln(self) -> float:
        """Limit of a line's ln(width) about the stripe's: farther off it is two faces, or no stripe."""
        return width_limit_ln(self.average.numbers)


NO_SCATTER = Scatter()
