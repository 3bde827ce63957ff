"""The scatter of pixels within bins, parted into read noise, a part with all light, one with the laser's.

Two Haar details of a bin do not depend on its mean: that of 2 x 2 pixels, (a - b - c + d) / 2, and the same
of 2 x 2 sums of four, over two. For white noise either has the variance of a pixel. They are 0 for a slope;
the twist that they would see is subtracted, estimated from the neighbouring bins. Their squares are fitted by

    v + r s_read^2 + g light^2 + l_k light_laser^2,    k = 1, 2,

for normal details with the weights of the fitted variance (Fisher's scoring, McCullagh and Nelder 1989). Here
r = rho^2 - 1 is of the read noise, g is the relative variance that goes with all light, and l_k is the part
of the laser speckle's variance that either detail keeps.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import nnls

from noise_model.compiled.arrays import Bool, Float32, Float64
from noise_model.instrument.sensor import linearise, respond_moments
from sim_to_real.data.binned import ObservedFrame
from sim_to_real.data.blocks import DETAIL_2X2, weighted_sums_in_bins
from sim_to_real.fit.frame_light import CHARGE_STEP_E, FrameLight

CLIP_SIGMAS = 5.0
"""Clipping of details, in sigmas: a spark is not noise."""

MIN_VARIANCE_RATIO = 0.25
"""The smallest variance, over the stated one."""

DETAIL_PX = 4
"""The side of the larger details."""

_HALVES, _ENDS = np.array([1.0, 1.0, -1.0, -1.0]) / 2.0, np.array([1.0, -1.0, -1.0, 1.0]) / 2.0

DETAIL_4X4 = np.outer(_HALVES, _HALVES).astype(np.float32)
SECOND_DIFFERENCE = np.outer(np.full(DETAIL_PX, 0.5), _ENDS).astype(np.float32)
"""The weights of the larger details; like those of `DETAIL_2X2`, their squares add up to one."""

COLUMN_GAIN = 4.0
"""The variance that gains of columns add to `across`, over their own variance."""


@dataclass(frozen=True, eq=False)
class HaarDetails:
    """A frame's bins that count (n,): details of 2 x 2 pixels (n, k) and of 4 x 4 (n, j), DN.

    `across` (n, j) are the second differences across four columns of four rows. `stated` (n,) is the variance
    of a pixel, DN^2; `read`, `light` and `laser` (n,) are what r, g and l_k of 1 add to it. j is 0 if bins
    have fewer than 4 x 4 pixels.
    """

    small: Float64
    large: Float64
    across: Float64
    stated: Float64
    read: Float64
    light: Float64
    laser: Float64

    def subset(self, chosen: Bool) -> "HaarDetails":
        """Return some of the bins (n,)."""
        return HaarDetails(*(values[chosen] for values in vars(self).values()))

    def variance(self, sizes: "VarianceSizes", of_laser: float = 0.0) -> Float64:
        """Return the variance of a pixel (n,), DN^2, with random effects of these sizes."""
        more = sizes.read * self.read + sizes.light * self.light + of_laser * self.laser
        return np.maximum(self.stated + more, MIN_VARIANCE_RATIO * self.stated)


@dataclass(frozen=True, eq=False)
class VarianceSizes:
    """The fitted sizes: r, which is -1 or more; g, l_1 and l_2, which are 0 or more; their covariance (4, 4).

    `error_rel` is the relative error of the fitted variance along the light, which no size explains.
    """

    read: float
    light: float
    laser_small: float
    laser_large: float
    covariance: Float64
    error_rel: float


def haar_details(frame: ObservedFrame, light: FrameLight, bin_px: int) -> HaarDetails:
    """Return the details of a frame's bins that count.

    Their stated noise is that of the light that is seen, so a wrong prediction does not make it wrong.
    """
    seen_dn = frame.kept_dn - light.black_dn
    mean_e = np.maximum(linearise(seen_dn, light.sensor), 0.0)
    noise_e2 = mean_e + light.sensor.read_noise_e**2
    at_dn, stated = respond_moments(mean_e, noise_e2, light.sensor)
    above_dn, _ = respond_moments(mean_e + CHARGE_STEP_E, noise_e2, light.sensor)
    dn_per_e = (above_dn - at_dn) / CHARGE_STEP_E
    twist = _twist(frame.binned_dn, bin_px)[frame.keep, np.newaxis]
    image = frame.image_dn.astype(np.float32)
    bend = _bend(frame.binned_dn, bin_px)[frame.keep, np.newaxis]
    small, large, across = (
        weighted_sums_in_bins(image, weights, bin_px)[frame.keep]
        for weights in (DETAIL_2X2, DETAIL_4X4, SECOND_DIFFERENCE)
    )
    return HaarDetails(
        np.asarray(small - 0.5 * twist, dtype=np.float64),
        np.asarray(large - 4.0 * twist, dtype=np.float64),
        np.asarray(across - 2.0 * bend, dtype=np.float64),
        stated,
        (dn_per_e * light.sensor.read_noise_e) ** 2,
        (dn_per_e * mean_e) ** 2,
        (dn_per_e * light.laser_e) ** 2,
    )


def _twist(binned_dn: Float32, bin_px: int) -> Float32:
    """Return the mixed derivative (h, w), DN/px^2, of an image of bins."""
    wide = cv2.copyMakeBorder(binned_dn, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    return np.asarray((wide[2:, 2:] - wide[2:, :-2] - wide[:-2, 2:] + wide[:-2, :-2]) / (2.0 * bin_px) ** 2)


def _bend(binned_dn: Float32, bin_px: int) -> Float32:
    """Return the second derivative along rows (h, w), DN/px^2, of an image of bins."""
    wide = cv2.copyMakeBorder(binned_dn, 0, 0, 1, 1, cv2.BORDER_REPLICATE)
    return np.asarray((wide[:, 2:] - 2.0 * wide[:, 1:-1] + wide[:, :-2]) / bin_px**2)


def fit_sizes(details: Sequence[HaarDetails]) -> VarianceSizes:
    """Fit the sizes of random effects to the details of all frames."""
    pooled = HaarDetails(
        *(np.concatenate([getattr(frame, name) for frame in details]) for name in vars(details[0]))
    )
    none = np.zeros_like(pooled.laser)
    parts = [(pooled.small**2, np.stack([pooled.read, pooled.light, pooled.laser, none], axis=1))]
    if pooled.large.shape[1]:
        parts.append((pooled.large**2, np.stack([pooled.read, pooled.light, none, pooled.laser], axis=1)))
    theta, lower = np.zeros(4), np.array([-1.0, 0.0, 0.0, 0.0])
    for _ in range(5):
        # The sizes' prior is 0 +- 1: without a laser they stay there.
        A, b = np.eye(4), np.zeros(4)
        for squares, columns in parts:
            variance = np.maximum(pooled.stated + columns @ theta, MIN_VARIANCE_RATIO * pooled.stated)
            measured = np.minimum(squares, CLIP_SIGMAS**2 * variance[:, np.newaxis]).mean(axis=1)
            weight = squares.shape[1] / (2.0 * variance**2)
            A += (columns * weight[:, np.newaxis]).T @ columns
            b += columns.T @ (weight * (measured - pooled.stated))
        root = np.linalg.cholesky(A)
        theta = nnls(root.T, np.linalg.solve(root, b) - root.T @ lower)[0] + lower
    read, light, small, large = (float(size) for size in theta)
    return VarianceSizes(
        read,
        light,
        small,
        large,
        np.asarray(np.linalg.inv(A), dtype=np.float64),
        _relative_error(pooled, parts[0], theta),
    )


def _relative_error(pooled: HaarDetails, part: tuple[Float64, Float64], theta: Float64) -> float:
    """Return the relative error of the fitted variance in groups of light, beyond the sampling error."""
    squares, columns = part
    variance = np.maximum(pooled.stated + columns @ theta, MIN_VARIANCE_RATIO * pooled.stated)
    ratio = np.minimum(squares / variance[:, np.newaxis], CLIP_SIGMAS**2).mean(axis=1)
    n_groups = 10
    groups = np.array_split(ratio[np.argsort(pooled.light)], n_groups)
    errors = np.array([np.mean(group) - 1.0 for group in groups if len(group)])
    sampling = 2.0 * n_groups / max(squares.size, 1)
    return math.sqrt(max(float(np.mean(errors**2)) - sampling, 0.0))


@dataclass(frozen=True)
class FixedPattern:
    """Relative variances of the gains of pixels and of columns, and their 1 sigmas."""

    pixels: float
    pixels_sigma: float
    columns: float
    columns_sigma: float


def fixed_pattern(
    details: Sequence[HaarDetails], keeps: Sequence[Bool], using: VarianceSizes, places: Sequence[int]
) -> FixedPattern:
    """Return the pattern that recurs in the details of the same pixels; `keeps` (h, w) are the frames' bins.

    Frames of one of the `places` (n_frames,) show the same of the part, whose own pattern recurs too: what
    they share counts for nothing.
    """
    variances = [frame.variance(using, using.laser_small) for frame in details]
    pixels, pixels_sigma = _recurring([frame.small for frame in details], details, keeps, variances, places)
    if not details[0].across.shape[1]:
        return FixedPattern(pixels, pixels_sigma, 0.0, 0.0)
    both, both_sigma = _recurring([frame.across for frame in details], details, keeps, variances, places)
    columns = (both - pixels) / COLUMN_GAIN
    n_columns = max(int(np.any(keeps, axis=(0, 1)).sum()), 1)
    sampled = columns * math.sqrt(2.0 / n_columns)
    return FixedPattern(
        pixels, pixels_sigma, columns, math.hypot(math.hypot(both_sigma, pixels_sigma) / COLUMN_GAIN, sampled)
    )


def _recurring(
    parts: Sequence[Float64],
    details: Sequence[HaarDetails],
    keeps: Sequence[Bool],
    variances: Sequence[Float64],
    places: Sequence[int],
) -> tuple[float, float]:
    """Return the relative variance of details (n, k) that recur, and its 1 sigma.

    Only products of frames of different places count: their noise does not recur.
    """
    shape, k = keeps[0].shape, parts[0].shape[1]
    every, light_of_all = np.zeros((*shape, k)), np.zeros(shape)
    over = under = 0.0
    for place in sorted(set(places)):
        here, light = np.zeros((*shape, k)), np.zeros(shape)
        for n in (n for n, of_frame in enumerate(places) if of_frame == place):
            variance, keep = variances[n], keeps[n]
            cap = CLIP_SIGMAS * np.sqrt(variance)[:, np.newaxis]
            over_noise = np.clip(parts[n], -cap, cap) * (np.sqrt(details[n].light) / variance)[:, np.newaxis]
            here[keep] += over_noise
            light[keep] += details[n].light / variance
        over -= float(np.sum(here**2))
        under -= k * float(np.sum(light**2))
        every, light_of_all = every + here, light_of_all + light
    over, under = over + float(np.sum(every**2)), under + k * float(np.sum(light_of_all**2))
    return (over / under, math.sqrt(2.0 / under)) if under > 0.0 else (0.0, math.inf)
