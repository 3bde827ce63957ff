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
from noise_model.median import exact_median
from tracker.joint.measured import START_SIGMA_MM, ShapeFit, fit_points
from tracker.joint.section_fit import BISQUARE_WIDTH
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


@kernel(allocates=True)
def prior_of(stated_mm: float, sigma_mm: float) -> Float64:
    """Return the prior probability of each of GAPS for a stated gap and its 1 sigma, mm."""
    n = GAPS.shape[0]
    prior, below, open_roots = np.empty(n), 0.0, 0.0
    for k in range(n):
        border = 0.5 * (GAPS[k] + GAPS[k + 1]) if k + 1 < n else math.inf
        up_to = 0.5 * (1.0 + math.erf((border - stated_mm) / (math.sqrt(2.0) * sigma_mm)))
        prior[k] = up_to - below
        below = up_to
        open_roots += prior[k] if k > 0 else 0.0
    if stated_mm == 0.0:
        prior[0] = CLOSED_AS_STATED
        for k in range(1, n):
            prior[k] *= (1.0 - CLOSED_AS_STATED) / open_roots
    return prior


@kernel(allocates=True)
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
    n_gaps, m = GAPS.shape[0], prior_sigma.shape[0]
    likeliest, most, alike = fit, -math.inf, likeness_of(points, clear)
    nats, parameters, covariances = np.empty(n_gaps), np.empty((n_gaps, m)), np.empty((n_gaps, m, m))
    prior = prior_of(start[gap], prior_sigma[gap])
    for k in range(n_gaps):
        from_gap, sigma = start.copy(), prior_sigma.copy()
        from_gap[gap], sigma[gap], nats[k] = GAPS[k], CELLS_MM[k], -math.inf
        held = fit_points(shape, points, clear, START_SIGMA_MM, sigma, from_gap)
        if not (math.isfinite(held.chi2) and prior[k] > 0.0):
            continue
        moved = (held.parameters[gap] - GAPS[k]) / CELLS_MM[k]
        left_open = min(held.covariance[gap, gap] / CELLS_MM[k] ** 2, 1.0)
        loss = loss_of(held.weights, clear) / alike
        nats[k] = math.log(prior[k]) - loss - 0.5 * moved**2 + 0.5 * math.log(left_open)
        for i in range(m):
            parameters[k, i] = held.parameters[i]
            for j in range(m):
                covariances[k, i, j] = held.covariance[i, j]
        if nats[k] > most:
            likeliest, most = held, nats[k]
    if most == -math.inf:
        return fit
    mean, covariance = mixture_of(nats, parameters, covariances)
    weights = fit.weights.copy()
    for i in range(weights.shape[0]):
        # What is left out beside the root was left out for the light that it mixes.
        if clear[i]:
            weights[i] = likeliest.weights[i]
    return ShapeFit(mean, covariance, likeliest.chi2, weights)


@kernel(allocates=True)
def likeness_of(points: Float64, clear: Bool) -> float:
    """Return how many of a profile's clear points (n,) say as much as one: errors of neighbours are alike."""
    ratios, count = np.empty(clear.shape[0]), 0
    for i in range(clear.shape[0]):
        if clear[i]:
            ratios[count] = (points[BESIDE_PX, i] / points[SIGMA_PX, i]) ** 2
            count += 1
    return exact_median(ratios[:count]) if count > 0 else 1.0


@kernel
def loss_of(weights: Float64, clear: Bool) -> float:
    """Return `section_fit.tukey_loss` of the weights of clear points (n,)."""
    total = 0.0
    for i in range(weights.shape[0]):
        if clear[i]:
            total += 1.0 - weights[i] * math.sqrt(weights[i])
    return BISQUARE_WIDTH**2 / 6.0 * total


@kernel(allocates=True)
def mixture_of(nats: Float64, parameters: Float64, covariances: Float64) -> tuple[Float64, Float64]:
    """Return mean (m,) and covariance (m, m) of normals (k, m), (k, m, m) by their evidence (k,), nats."""
    n, m = parameters.shape
    most, total = nats.max(), 0.0
    shares, mean, covariance = np.empty(n), np.zeros(m), np.zeros((m, m))
    for k in range(n):
        shares[k] = math.exp(nats[k] - most)
        total += shares[k]
    for k in range(n):
        shares[k] /= total
        # What has no share may not have been fitted at all.
        for i in range(m if shares[k] > 0.0 else 0):
            mean[i] += shares[k] * parameters[k, i]
    for k in range(n):
        for i in range(m if shares[k] > 0.0 else 0):
            for j in range(m):
                off = (parameters[k, i] - mean[i]) * (parameters[k, j] - mean[j])
                covariance[i, j] += shares[k] * (covariances[k, i, j] + off)
    return mean, covariance
