"""How pixels scatter within bins, and what of it goes with read noise, with light and with the laser's light.

Two details of a bin are blind to what the model says of its mean: that of 2 x 2 pixels, (a - b - c + d) / 2,
and the same of 2 x 2 sums of four, over two. Of white noise either has the variance of a pixel. They see no
slope, and the twist that they would see is that of the bins about. Their squares are fitted by

    v + r s_read^2 + g light^2 + l_k light_laser^2,    k = 1, 2,

for normal details: weights are those of the fitted variance (Fisher's scoring, McCullagh and Nelder 1989).
r = rho^2 - 1 of the read noise, g the relative variance of what goes with all light, l_k what laser speckle
leaves of its own in either detail.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import nnls

from noise_model.arrays import Bool, Float32, Float64
from noise_model.instrument.sensor import linearise, respond_moments
from sim_to_real.data.binned import ObservedFrame
from sim_to_real.data.blocks import SMALL, in_bins
from sim_to_real.fit.linearized_model import CHARGE_STEP_E, Passed

CAP = 5.0
"""Details beyond so many sigmas are cut: a spark is not noise."""

ROUNDS = 5
"""How often weights are taken anew."""

LEAST_VARIANCE = 0.25
"""No variance is taken for less than this share of what is stated."""

GROUPS = 10
"""Groups of light in which the fitted variance is held against the measured one."""

LARGE_PX = 4
"""The pixels of a side that the larger details take."""

_HALVES, _ENDS = np.array([1.0, 1.0, -1.0, -1.0]) / 2.0, np.array([1.0, -1.0, -1.0, 1.0]) / 2.0

LARGE = np.outer(_HALVES, _HALVES).astype(np.float32)
ACROSS = np.outer(np.full(LARGE_PX, 0.5), _ENDS).astype(np.float32)
"""The larger details of pixels: as those of `SMALL`, their squares add up to one."""

OF_COLUMNS = 4.0
"""What gains of columns add to the variance of `across`, over their own."""


@dataclass(frozen=True, eq=False)
class Details:
    """A frame's bins that count (n,): details of 2 x 2 pixels (n, k) and of 4 x 4 (n, j), DN.

    `across` (n, j) are the second differences across four columns of four rows. `stated` (n,) is the variance
    of a pixel, DN^2; `read`, `light` and `laser` (n,) what r, g and l_k of one add. j is 0 where a bin has
    fewer pixels.
    """

    small: Float64
    large: Float64
    across: Float64
    stated: Float64
    read: Float64
    light: Float64
    laser: Float64

    def some(self, chosen: Bool) -> Details:
        """Return some of the bins (n,)."""
        return Details(*(of[chosen] for of in vars(self).values()))

    def variance(self, sizes: Sizes, of_laser: float = 0.0) -> Float64:
        """Return the variance of a pixel (n,), DN^2, with what scatters besides."""
        more = sizes.read * self.read + sizes.light * self.light + of_laser * self.laser
        return np.maximum(self.stated + more, LEAST_VARIANCE * self.stated)


@dataclass(frozen=True, eq=False)
class Sizes:
    """What scatters: r from -1 on, g, l_1 and l_2 from 0 on, and their covariance (4, 4).

    `off` is by how much, relative, the fitted variance is off along the light: what no size explains.
    """

    read: float
    light: float
    laser_small: float
    laser_large: float
    covariance: Float64
    off: float


def details(frame: ObservedFrame, light: Passed, bin_px: int) -> Details:
    """Return the details of a frame's bins that count.

    Their noise is that of the light that is seen: a wrong prediction does not make it wrong.
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
    small, large, across = (in_bins(image, weights, bin_px)[frame.keep] for weights in (SMALL, LARGE, ACROSS))
    return Details(
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


def sizes(of: Sequence[Details]) -> Sizes:
    """Fit what scatters in all frames."""
    one = Details(*(np.concatenate([getattr(frame, name) for frame in of]) for name in vars(of[0])))
    nought = np.zeros_like(one.laser)
    parts = [(one.small**2, np.stack([one.read, one.light, one.laser, nought], axis=1))]
    if one.large.shape[1]:
        parts.append((one.large**2, np.stack([one.read, one.light, nought, one.laser], axis=1)))
    theta, least = np.zeros(4), np.array([-1.0, 0.0, 0.0, 0.0])
    for _ in range(ROUNDS):
        # Before, sizes are nought give or take one: where there is no laser they stay so.
        A, b = np.eye(4), np.zeros(4)
        for squares, columns in parts:
            variance = np.maximum(one.stated + columns @ theta, LEAST_VARIANCE * one.stated)
            measured = np.minimum(squares, CAP**2 * variance[:, np.newaxis]).mean(axis=1)
            weight = squares.shape[1] / (2.0 * variance**2)
            A += (columns * weight[:, np.newaxis]).T @ columns
            b += columns.T @ (weight * (measured - one.stated))
        root = np.linalg.cholesky(A)
        theta = nnls(root.T, np.linalg.solve(root, b) - root.T @ least)[0] + least
    read, light, small, large = (float(size) for size in theta)
    return Sizes(
        read, light, small, large, np.asarray(np.linalg.inv(A), dtype=np.float64), _off(one, parts[0], theta)
    )


def _off(one: Details, part: tuple[Float64, Float64], theta: Float64) -> float:
    """Return by how much the variance of details is off in groups of equal light, beyond their sampling."""
    squares, columns = part
    variance = np.maximum(one.stated + columns @ theta, LEAST_VARIANCE * one.stated)
    ratio = np.minimum(squares / variance[:, np.newaxis], CAP**2).mean(axis=1)
    groups = np.array_split(ratio[np.argsort(one.light)], GROUPS)
    off = np.array([np.mean(group) - 1.0 for group in groups if len(group)])
    sampling = 2.0 * GROUPS / max(squares.size, 1)
    return math.sqrt(max(float(np.mean(off**2)) - sampling, 0.0))


@dataclass(frozen=True)
class Pattern:
    """Relative variances of gains that stay with pixels and with columns, and their 1 sigmas."""

    pixels: float
    pixels_sigma: float
    columns: float
    columns_sigma: float


def pattern(of: Sequence[Details], keeps: Sequence[Bool], using: Sizes) -> Pattern:
    """Return what comes back in the details of the same pixels; `keeps` (h, w) are the frames' bins."""
    variances = [one.variance(using, using.laser_small) for one in of]
    pixels, pixels_sigma = _recurring([one.small for one in of], of, keeps, variances)
    if not of[0].across.shape[1]:
        return Pattern(pixels, pixels_sigma, 0.0, 0.0)
    both, both_sigma = _recurring([one.across for one in of], of, keeps, variances)
    columns = (both - pixels) / OF_COLUMNS
    n_columns = max(int(np.any(keeps, axis=(0, 1)).sum()), 1)
    sampled = columns * math.sqrt(2.0 / n_columns)
    return Pattern(
        pixels, pixels_sigma, columns, math.hypot(math.hypot(both_sigma, pixels_sigma) / OF_COLUMNS, sampled)
    )


def _recurring(
    parts: Sequence[Float64],
    of: Sequence[Details],
    keeps: Sequence[Bool],
    variances: Sequence[Float64],
) -> tuple[float, float]:
    """Return the relative variance of details (n, k) that recur, and its 1 sigma.

    Products of different frames alone count: their noise does not come back.
    """
    shape, k = keeps[0].shape, parts[0].shape[1]
    first, squares = np.zeros((*shape, k)), np.zeros((*shape, k))
    light, light_squares = np.zeros(shape), np.zeros(shape)
    for part, one, keep, variance in zip(parts, of, keeps, variances, strict=True):
        cap = CAP * np.sqrt(variance)[:, np.newaxis]
        weighted = np.clip(part, -cap, cap) * (np.sqrt(one.light) / variance)[:, np.newaxis]
        first[keep] += weighted
        squares[keep] += weighted**2
        light[keep] += one.light / variance
        light_squares[keep] += (one.light / variance) ** 2
    over = float(np.sum(first**2 - squares))
    under = k * float(np.sum(light**2 - light_squares))
    return (over / under, math.sqrt(2.0 / under)) if under > 0.0 else (0.0, math.inf)
