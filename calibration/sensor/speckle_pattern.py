"""Speckle's contrast and grain from the mean image of a stripe that stands still.

The stripe is laid straight along its lines. What is left of its logarithm over a smooth stripe is speckle: a
field of variance V = ln(1 + C^2) with the correlation exp(-d^2 / 4 g^2), the model's own, and what the mean
over the frames leaves of the noise, which is white and known. So the field's variance and the covariance of
neighbours say C and g. The smooth stripe takes a part of both off, some 1.8 g over its smoothing's length,
which is computed. The sigmas are a jackknife's over blocks of lines: they need no model of what speckle's
fourth moments are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates

from calibration.sensor.still_frames import StillStatistics
from noise_model.compiled.arrays import Bool, Float64
from noise_model.fit import student_t

MIN_LINES = 64
"""Least number of lines of an unbroken stripe."""

CORE_SIGMAS = 1.0
"""Half-width of the columns that count about the stripe's middle, in its sigmas."""

SMOOTH_LINES = 24.0
"""The stripe's path, width and brightness change over more lines than this, 1 sigma of the smoothing."""

PATH_LINES, NEARBY_LINES = 2.0 * SMOOTH_LINES, 4.0
"""The path is smoother than what is taken off along it: it must not follow the speckle."""

LEVEL_LINES = 4.0 * SMOOTH_LINES
"""The stripe's level is smoother still: what is taken off twice would be counted once."""

MAX_SATURATED_SHARE = 3e-3
"""With more of the core saturated the brightest speckles are missing, and the contrast would be too low."""

MIN_RATIO = 0.05
"""Pixels darker than this share of the smooth stripe are noise."""

MAX_LINES = 640
"""Largest number of lines used for the residual of a smooth stripe."""

N_BLOCKS = 16
"""Blocks of lines of the jackknife: longer than any grain."""

GRAINS_PX = (0.25, 10.0)
"""The grains that the model has."""


@dataclass(frozen=True)
class SpecklePattern:
    """Contrast and grain, px, with their 1 sigma, from `n_lines` lines of `n_columns` columns."""

    contrast: float
    contrast_sigma: float
    grain_px: float
    grain_sigma_px: float
    n_lines: int
    n_columns: int

    @property
    def half_width(self) -> float:
        """Half of a 95 % interval, in sigmas: Student's, of the jackknife's blocks."""
        return student_t(0.95, N_BLOCKS - 1.0)


def fit_speckle_pattern(seen: StillStatistics) -> SpecklePattern | None:
    """Return the speckle of a still stripe, None where there is too little of the stripe."""
    straight = _straighten(seen)
    if straight is None:
        return None
    remainder, noise, is_level = straight
    along = remainder[1:] * remainder[:-1]
    # Lines between which the path steps to another column are no neighbours along it.
    remainder, noise, along = remainder[:-1][is_level], noise[:-1][is_level], along[is_level]
    across = remainder[:, 1:] * remainder[:, :-1]
    parts = np.stack([(remainder**2 - noise).mean(axis=1), 0.5 * (along.mean(axis=1) + across.mean(axis=1))])
    blocks = np.array_split(parts, N_BLOCKS, axis=1)
    kept = _GrainVariance.along(len(is_level) + 1)
    whole = kept.contrast_and_grain(parts.mean(axis=1))
    without = [
        kept.contrast_and_grain(
            np.concatenate([b for k, b in enumerate(blocks) if k != n], axis=1).mean(axis=1)
        )
        for n in range(N_BLOCKS)
    ]
    fits = [pair for pair in without if pair is not None]
    if whole is None or len(fits) < N_BLOCKS:
        return None
    spread = np.array(fits) - np.mean(fits, axis=0)
    sigma = np.sqrt((N_BLOCKS - 1) / N_BLOCKS * np.sum(spread**2, axis=0))
    # The jackknife's own correction of a bias that falls as one over the lines.
    contrast, grain = N_BLOCKS * np.array(whole) - (N_BLOCKS - 1) * np.mean(fits, axis=0)
    return SpecklePattern(
        float(contrast),
        float(sigma[0]),
        float(grain),
        float(sigma[1]),
        remainder.shape[0],
        remainder.shape[1],
    )


@dataclass(frozen=True, eq=False)
class _GrainVariance:
    """Share of the variance that a smooth stripe leaves at grains (g,), px, and its neighbours' share."""

    grains_px: Float64
    variance: Float64
    neighbour: Float64

    @classmethod
    def along(cls, n_lines: int) -> _GrainVariance:
        """Return it for a stripe of `n_lines`, its ends included."""
        grains = np.geomspace(*GRAINS_PX, 48)
        # Of longer stripes the ends hardly matter.
        n = min(n_lines, MAX_LINES)
        B = np.eye(n) - gaussian_filter1d(np.eye(n), SMOOTH_LINES, axis=0)
        lags = np.arange(-n + 1, n)
        # <(B x)_i (B x)_i+k> is the sum over lags of the correlation times a diagonal of B^T B.
        alone, neighbour = (
            np.array([np.trace(product, lag) for lag in lags]) / len(rows)
            for product, rows in ((B.T @ B, B), (B[1:].T @ B[:-1], B[1:]))
        )
        variances, shares = [], []
        for grain in grains:
            correlation = np.exp(-(lags**2) / (4.0 * grain**2))
            variance = float(correlation @ alone)
            variances.append(variance)
            shares.append(0.5 * (float(correlation @ neighbour) / variance + math.exp(-0.25 / grain**2)))
        return cls(grains, np.array(variances), np.array(shares))

    def contrast_and_grain(self, moments: Float64) -> tuple[float, float] | None:
        """Return contrast and grain, px, of variance and neighbours' covariance (2,); None for no speckle."""
        variance, neighbour = float(moments[0]), float(moments[1])
        if not variance > 0.0 or not self.neighbour[0] < neighbour / variance < self.neighbour[-1]:
            return None
        ln_grain = float(np.interp(neighbour / variance, self.neighbour, np.log(self.grains_px)))
        whole = variance / float(np.interp(ln_grain, np.log(self.grains_px), self.variance))
        return math.sqrt(math.expm1(whole)), math.exp(ln_grain)


def _straighten(seen: StillStatistics) -> tuple[Float64, Float64, Bool] | None:
    """Return the logarithm's remainder and its noise's variance (n, m) in the stripe's core, or None."""
    light = seen.image_dn - seen.black_dn
    noise = seen.noise_dn2 / seen.n_frames
    usable = seen.is_usable
    # Lines run across the stripe: along rows where the stripe's light spreads least along them.
    along_rows, along_columns = (float(np.std(light.sum(axis=axis))) for axis in (0, 1))
    if along_rows < along_columns:
        light, noise, usable = light.T, noise.T, usable.T
    path = _path(light, noise, usable)
    if path is None:
        return None
    first, last, centre, width = path
    reach = max(1, math.floor(CORE_SIGMAS * float(np.median(width))))
    offsets = np.arange(-reach, reach + 1)
    columns = np.rint(centre)[:, np.newaxis].astype(np.int64) + offsets
    if columns.min() < 0 or columns.max() >= light.shape[1]:
        return None
    rows = np.arange(first, last)[:, np.newaxis]
    core, ok = light[rows, columns], usable[rows, columns]
    off = columns - centre[:, np.newaxis]
    bell = np.exp(-0.5 * (off / width[:, np.newaxis]) ** 2)
    level = gaussian_filter1d((core * bell).sum(axis=1) / (bell**2).sum(axis=1), LEVEL_LINES)
    if (~ok).mean() > MAX_SATURATED_SHARE or level.min() <= 0.0:
        return None
    # A few saturated pixels stand for at least what they read.
    ratio = np.maximum(core / (level[:, np.newaxis] * bell), MIN_RATIO)
    relative = noise[rows, columns] / (level[:, np.newaxis] * bell * ratio) ** 2
    remainder = np.log(ratio)
    remainder -= gaussian_filter1d(remainder, SMOOTH_LINES, axis=0)
    return remainder, np.asarray(relative), np.diff(columns[:, 0]) == 0


def _path(light: Float64, noise: Float64, usable: np.ndarray) -> tuple[int, int, Float64, Float64] | None:
    """Return the longest run of lines with a stripe: from, to, its smooth centre and width (n,), px."""
    smooth = gaussian_filter1d(light, 1.0, axis=1)
    peak = smooth.argmax(axis=1)
    lines = np.arange(len(light))
    is_stripe = smooth[lines, peak] > 6.0 * np.sqrt(noise[lines, peak])
    is_stripe &= smooth[lines, peak] > 0.2 * float(np.percentile(smooth[lines, peak], 90.0))
    steady = np.abs(np.diff(peak, prepend=peak[0])) < 40
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (is_stripe & steady).astype(int), [0]])))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return None
    first, last = max(runs.tolist(), key=lambda run: run[1] - run[0])
    if last - first < MIN_LINES:
        return None
    part = np.maximum(light[first:last], 0.0)
    # Moments about the path's smooth peak, within what half the peak cuts off: twice, to settle.
    centre = gaussian_filter1d(peak[first:last].astype(np.float64), SMOOTH_LINES, mode="nearest")
    mean_profile = _mean_profile(part, centre)
    above = np.flatnonzero(mean_profile > 0.5 * mean_profile.max())
    sigma = (above[-1] - above[0] + 1) / 2.355
    places = np.arange(part.shape[1])
    for _ in range(3):
        window = np.exp(-0.5 * ((places - centre[:, np.newaxis]) / (1.5 * sigma)) ** 2)
        weight = part * window
        total = weight.sum(axis=1)
        moved = (weight * (places - centre[:, np.newaxis])).sum(axis=1) * (1.0 + 1.0 / 1.5**2)
        # All of the path is smoothed each time: steps that are smoothed alone would follow the speckle.
        pulled = gaussian_filter1d(total * centre + moved, PATH_LINES, mode="nearest")
        centre = pulled / gaussian_filter1d(total, PATH_LINES, mode="nearest")
    nearby = gaussian_filter1d(total, NEARBY_LINES)
    off = (
        gaussian_filter1d((part * window * (places - centre[:, np.newaxis])).sum(axis=1), NEARBY_LINES)
        / nearby
    )
    # With more than 5 % of its lines off a smooth path the stripe has corners.
    if float(np.mean(np.abs(off) > 0.5 * sigma)) > 0.05:
        return None
    return first, last, centre, np.full(last - first, sigma)


def _mean_profile(part: Float64, centre: Float64) -> Float64:
    """Return the stripe's mean profile over 60 px to either side of a path (n,)."""
    reach_px = 60
    places = np.arange(-reach_px, reach_px + 1)
    lines = np.broadcast_to(np.arange(len(part))[:, np.newaxis], (len(part), len(places)))
    shifted = map_coordinates(part, [lines, centre[:, np.newaxis] + places], order=1, mode="constant")
    return np.asarray(shifted.mean(axis=0))
