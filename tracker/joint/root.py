"""A narrow root: gap and height as the profile leaves them open, weighed and not picked.

Bevels are seen well, and with them where they would meet. The seam point lies above that by gap / (2 tan) of
a V: what the root's gap is moves it, and of a narrow root no line tells, for each that crosses it holds the
light of both bevels. So the groove is fitted from each gap of a grid, lines near the root left out, and the
answer is the fits' mean and covariance by their posterior probability (Hoeting et al. 1999, Statistical
Science 14, 382). A gap cannot be less than none: what the prior has below counts for the closed root.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Bool, Float64
from noise_model.kernel import kernel
from noise_model.median import median
from tracker.joint.measured import START_SIGMA_MM, fit_points
from tracker.joint.section_fit import BISQUARE_WIDTH, ShapeFit
from tracker.state import BESIDE_PX, SIGMA_PX

NARROW_MM = 0.8
"""A root that comes out narrower than this is weighed."""

GAPS = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.95, 1.1, 1.3, 1.5])
"""The gaps that are weighed, mm: none, and as wide as a narrow root may come out."""

EXACT_MM = 1e-4
"""1 sigma of a closed root's gap, mm. Another may move by half its cell of the grid."""

CELLS_MM = np.array([EXACT_MM, *(0.5 * np.diff(GAPS))])
"""1 sigma of the gap about each of GAPS, mm."""

CLOSED_AS_STATED = 0.95
"""How probable it is, before it is seen, that a root that is stated closed is closed: tacked plates touch."""


def prior_of(stated_mm: float, sigma_mm: float) -> Float64:
    """Return the prior probability of each of GAPS for a stated gap and its 1 sigma, mm."""
    borders = [*(0.5 * (GAPS[1:] + GAPS[:-1])), math.inf]
    up_to = [0.5 * (1.0 + math.erf((b - stated_mm) / (math.sqrt(2.0) * sigma_mm))) for b in borders]
    prior = np.diff(up_to, prepend=0.0)
    if stated_mm == 0.0:
        prior[1:] *= (1.0 - CLOSED_AS_STATED) / prior[1:].sum()
        prior[0] = CLOSED_AS_STATED
    return prior


def weigh_root(
    shape: int,
    points: Float64,
    clear: Bool,
    start: Float64,
    prior_sigma: Float64,
    gap: int,
    fit: ShapeFit,
) -> ShapeFit:
    """Return a groove's fit with its root weighed, or the fit as it is where the root is wide.

    `gap` is which parameter the root's gap is, `start` holds the stated one; `clear` (n,) are the points that
    hold light of one face. Where no gap of the grid can be fitted the fit stays too.
    """
    if not fit.parameters[gap] < NARROW_MM:
        return fit
    prior = prior_of(float(start[gap]), float(prior_sigma[gap]))
    parameters, covariances, weights, chi2, losses = fit_gaps(shape, points, clear, start, prior_sigma, gap)
    (held,) = np.nonzero(np.isfinite(chi2) & (prior > 0.0))
    if not len(held):
        return fit
    # Errors of neighbours go together: so many points say as much as one.
    common = median((points[BESIDE_PX, clear] / points[SIGMA_PX, clear]) ** 2) if clear.any() else 1.0
    moved = (parameters[held, gap] - GAPS[held]) / CELLS_MM[held]
    left_open = np.minimum(covariances[held, gap, gap] / CELLS_MM[held] ** 2, 1.0)
    nats = np.log(prior[held]) - losses[held] / common - 0.5 * moved**2 + 0.5 * np.log(left_open)
    mean, covariance = mixture_of(nats, parameters[held], covariances[held])
    likeliest = held[np.argmax(nats)]
    # What is left out beside the root was left out for the light that it mixes.
    weights = np.where(clear, weights[likeliest], fit.weights)
    return ShapeFit(mean, covariance, float(chi2[likeliest]), weights)


@kernel(allocates=True)
def fit_gaps(
    shape: int, points: Float64, clear: Bool, start: Float64, prior_sigma: Float64, gap: int
) -> tuple[Float64, Float64, Float64, Float64, Float64]:
    """Return a groove's fits from GAPS (k,): parameters, covariances, weights, chi2 and losses, nats."""
    k, m, n = GAPS.shape[0], prior_sigma.shape[0], clear.shape[0]
    parameters, covariances, weights = np.empty((k, m)), np.empty((k, m, m)), np.empty((k, n))
    chi2, losses = np.empty(k), np.zeros(k)
    for j in range(k):
        from_gap, sigma = start.copy(), prior_sigma.copy()
        from_gap[gap], sigma[gap] = GAPS[j], CELLS_MM[j]
        held = fit_points(shape, points, clear, START_SIGMA_MM, sigma, from_gap)
        chi2[j], parameters[j] = held.chi2, held.parameters
        covariances[j], weights[j] = held.covariance, held.weights
        for i in range(n):
            if clear[i]:
                losses[j] += BISQUARE_WIDTH**2 / 6.0 * (1.0 - weights[j, i] * math.sqrt(weights[j, i]))
    return parameters, covariances, weights, chi2, losses


def mixture_of(nats: Float64, parameters: Float64, covariances: Float64) -> tuple[Float64, Float64]:
    """Return mean (m,) and covariance (m, m) of normals (k, m), (k, m, m) by their evidence (k,), nats."""
    shares = np.exp(nats - nats.max())
    shares /= shares.sum()
    mean = shares @ parameters
    off = parameters - mean
    return mean, np.tensordot(shares, covariances + off[:, :, None] * off[:, None, :], 1)
