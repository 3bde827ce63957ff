"""Laser speckle: contrast and grain from what it leaves in the two details of a bin.

White noise behind a Gaussian of 1 sigma g is correlated as exp(-x^2 / 4 g^2): of its variance a detail with
weights u_i u_j keeps (sum_ab u_a u_b exp(-(a - b)^2 / 4 g^2))^2. Two details of different size tell the
contrast from the grain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY
from sim_to_real.data.binned import FLOOR_REL
from sim_to_real.variance.haar_details import LARGE_PX, Sizes

GRAINS_PX, CONTRASTS = np.geomspace(0.3, 6.0, 60), np.geomspace(2e-3, 1.0, 160)
"""Grains and contrasts that are tried."""

WHITE_OFF = 0.5 * FLOOR_REL
"""Of what the model may be off, relative to the light, this may differ from pixel to pixel."""

FORM = 0.05
"""1 sigma of what another correlation than a Gaussian's, or a sampled one, leaves otherwise, relative."""

SMALL_WEIGHTS = np.array([1.0, -1.0]) / math.sqrt(2.0)
LARGE_WEIGHTS = np.array([1.0, 1.0, -1.0, -1.0]) / 2.0
"""The details' weights along a side."""


@dataclass(frozen=True)
class Speckle:
    """Contrast and grain with their 1 sigmas, the evidence for speckle, nats, and what a bin's mean keeps.

    `of_bins` is the variance of a bin's mean over the square of the laser's light.
    """

    evidence: float
    contrast: float
    grain_px: float
    sigmas: tuple[float, float]
    of_bins: float


def left_of_grain(grain_px: float, weights: Float64) -> float:
    """Return what a detail with weights (k,) along either side keeps of speckle's variance."""
    at = np.arange(len(weights), dtype=np.float64)
    correlation = np.exp(-((at[:, np.newaxis] - at) ** 2) / (4.0 * grain_px**2))
    return float(weights @ correlation @ weights) ** 2


def speckle(sizes: Sizes, off: float, bin_px: int) -> Speckle:
    """Return the speckle that two sizes of what goes with the laser say; `off` is what either may be off.

    Priors are the catalogue's. Without speckle the sizes are what the model is off.
    """
    measured = np.array([sizes.laser_small, sizes.laser_large])
    known = np.array([True, bin_px >= LARGE_PX])
    covariance = sizes.covariance[2:, 2:] + np.diag(np.full(2, off**2 + WHITE_OFF**4))
    kept = np.array([[left_of_grain(g, w) for w in (SMALL_WEIGHTS, LARGE_WEIGHTS)] for g in GRAINS_PX])
    predicted = CONTRASTS[:, np.newaxis, np.newaxis] ** 2 * kept
    without = _ln_normal(measured[known], np.zeros(known.sum()), covariance[np.ix_(known, known)])
    spread = covariance + np.einsum("cgi,ij->cgij", (FORM * predicted) ** 2, np.eye(2))
    with_it = _ln_normal(measured[known], predicted[..., known], spread[..., known, :][..., known])
    prior = _ln_prior("contrast", CONTRASTS)[:, np.newaxis] + _ln_prior("grain_px", GRAINS_PX)
    joint = with_it + prior
    total = float(logsumexp(joint))
    weight = np.exp(joint - total)
    contrast, contrast_sigma = _middle(CONTRASTS, weight.sum(axis=1))
    grain, grain_sigma = _middle(GRAINS_PX, weight.sum(axis=0))
    at = np.full(bin_px, 1.0 / bin_px)
    return Speckle(
        float(total - without),
        contrast,
        grain,
        (contrast_sigma, grain_sigma),
        contrast**2 * left_of_grain(grain, at),
    )


def _ln_normal(x: Float64, mean: Float64, covariance: Float64) -> Float64:
    """Return the logarithm of normal densities (...,) of x (k,)."""
    left = (x - mean)[..., np.newaxis]
    squares = np.sum(left * np.linalg.solve(covariance, left), axis=(-2, -1))
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
