"""Laser speckle: contrast and grain from the variance that the two details of a bin keep of it.

White noise blurred by a Gaussian of 1 sigma g has the correlation exp(-x^2 / 4 g^2). A detail with weights
u_i u_j keeps (sum_ab u_a u_b exp(-(a - b)^2 / 4 g^2))^2 of its variance. Two details of different size thus
separate the contrast from the grain.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY
from sim_to_real.data.binned import FLOOR_REL
from sim_to_real.variance.haar_details import DETAIL_PX, VarianceSizes

GRAINS_PX, CONTRASTS = np.geomspace(0.3, 6.0, 60), np.geomspace(2e-3, 1.0, 160)
"""Grains and contrasts that are tried."""

WHITE_ERROR_REL = 0.5 * FLOOR_REL
"""The part of the model's relative floor that may differ from pixel to pixel."""

SMALL_WEIGHTS = np.array([1.0, -1.0]) / math.sqrt(2.0)
LARGE_WEIGHTS = np.array([1.0, 1.0, -1.0, -1.0]) / 2.0
"""The details' weights along a side."""


@dataclass(frozen=True)
class Speckle:
    """Contrast and grain with their 1 sigmas, and the evidence for speckle, nats.

    `bin_variance_rel` is the variance of a bin's mean over the square of the laser's light.
    """

    evidence: float
    contrast: float
    grain_px: float
    sigmas: tuple[float, float]
    bin_variance_rel: float


def variance_kept(grain_px: float, weights: Float64) -> float:
    """Return the share of speckle's variance that a detail with weights (k,) along either side keeps."""
    places = np.arange(len(weights), dtype=np.float64)
    correlation = np.exp(-((places[:, np.newaxis] - places) ** 2) / (4.0 * grain_px**2))
    return float(weights @ correlation @ weights) ** 2


def fit_speckle(sizes: VarianceSizes, error: float, error_without: float, bin_px: int) -> Speckle:
    """Return the speckle that fits the two sizes that go with the laser's light.

    `error` is that of either if there is speckle, `error_without` if there is none: the sizes are the model's
    own error then, a share of the variance that there is without. Priors are the catalogue's.
    """
    measured = np.array([sizes.laser_small, sizes.laser_large])
    known = np.array([True, bin_px >= DETAIL_PX])
    covariance, of_none = (
        sizes.covariance[2:, 2:] + np.diag(np.full(2, e**2 + WHITE_ERROR_REL**4))
        for e in (error, error_without)
    )
    kept = np.array([[variance_kept(g, w) for w in (SMALL_WEIGHTS, LARGE_WEIGHTS)] for g in GRAINS_PX])
    predicted = CONTRASTS[:, np.newaxis, np.newaxis] ** 2 * kept
    without = _ln_normal(measured[known], np.zeros(known.sum()), of_none[np.ix_(known, known)])
    # The correlation is no exact Gaussian, and it is sampled: 5 % of the kept variance.
    spread = covariance + np.einsum("cgi,ij->cgij", (0.05 * predicted) ** 2, np.eye(2))
    with_it = _ln_normal(measured[known], predicted[..., known], spread[..., known, :][..., known])
    prior = _ln_prior("contrast", CONTRASTS)[:, np.newaxis] + _ln_prior("grain_px", GRAINS_PX)
    joint = with_it + prior
    total = float(logsumexp(joint))
    weight = np.exp(joint - total)
    contrast, contrast_sigma = _middle(CONTRASTS, weight.sum(axis=1))
    grain, grain_sigma = _middle(GRAINS_PX, weight.sum(axis=0))
    box = np.full(bin_px, 1.0 / bin_px)
    return Speckle(
        float(total - without),
        contrast,
        grain,
        (contrast_sigma, grain_sigma),
        contrast**2 * variance_kept(grain, box),
    )


def _ln_normal(x: Float64, mean: Float64, covariance: Float64) -> Float64:
    """Return the logarithm of normal densities (...,) of x (k,)."""
    remainder = (x - mean)[..., np.newaxis]
    squares = np.sum(remainder * np.linalg.solve(covariance, remainder), axis=(-2, -1))
    return np.asarray(-0.5 * (squares + np.linalg.slogdet(2.0 * math.pi * covariance)[1]))


def _ln_prior(name: str, values: Float64) -> Float64:
    """Return the logarithm of a parameter's prior weights (n,): the catalogue's normal one, over the grid."""
    parameter = next(p for p in REGISTRY["laser_speckle"].parameters if p.name == name)
    ln = -0.5 * ((values - parameter.start) / parameter.prior_sigma) ** 2 + np.log(np.gradient(values))
    return np.asarray(ln - logsumexp(ln))


def _middle(values: Float64, weight: Float64) -> tuple[float, float]:
    """Return the median of values (n,) and their standard deviation."""
    mean = float(values @ weight)
    median = float(np.interp(0.5, np.cumsum(weight) - 0.5 * weight, values))
    return median, math.sqrt(max(float((values - mean) ** 2 @ weight), 0.0))
