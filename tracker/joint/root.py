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
from noise_model.median import median
from tracker.joint.measured import ShapeFit, fit_shape
from tracker.joint.section_fit import tukey_loss
from tracker.profile import Profile

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
    borders = np.concatenate([[-math.inf], 0.5 * (GAPS[1:] + GAPS[:-1]), [math.inf]])
    below = np.array([0.5 * (1.0 + math.erf((b - stated_mm) / (math.sqrt(2.0) * sigma_mm))) for b in borders])
    prior = np.diff(below)
    if stated_mm == 0.0:
        prior[0] = 0.0
        prior *= (1.0 - CLOSED_AS_STATED) / prior.sum()
        prior[0] = CLOSED_AS_STATED
    return np.asarray(prior)


def weigh_root(
    profile: Profile,
    shape: int,
    start: Float64,
    prior_sigma: Float64,
    gap: int,
    middle_mm: float,
    fit: ShapeFit,
    used: Bool | None = None,
) -> ShapeFit:
    """Return a groove's fit with its root weighed, or the fit as it is where the root is wide.

    `gap` is which parameter the root's gap is, `start` holds the stated one; `middle_mm` is where the root
    lies. Where no gap of the grid can be fitted the fit stays too.
    """
    if not fit.parameters[gap] < NARROW_MM:
        return fit
    clear = np.abs(profile.y_mm - middle_mm) >= profile.mixed_mm
    if used is not None:
        clear &= used
    # Errors of neighbours are alike: so many lines say as much as one.
    alike = median((profile.beside_px[clear] / profile.sigma_px[clear]) ** 2) if clear.any() else 1.0
    fits, evidence = [], []
    prior_of_gaps = prior_of(float(start[gap]), float(prior_sigma[gap]))
    for gap_mm, cell_mm, prior in zip(GAPS, CELLS_MM, prior_of_gaps, strict=True):
        from_gap, sigma = start.copy(), prior_sigma.copy()
        from_gap[gap], sigma[gap] = gap_mm, cell_mm
        held = fit_shape(profile, shape, from_gap, sigma, clear)
        if held is None or not prior > 0.0:
            continue
        loss = tukey_loss(held.weights[clear])
        moved = (float(held.parameters[gap]) - gap_mm) / cell_mm
        left_open = min(float(held.covariance[gap, gap]) / cell_mm**2, 1.0)
        fits.append(held)
        evidence.append(math.log(prior) - loss / alike - 0.5 * moved**2 + 0.5 * math.log(left_open))
    if not fits:
        return fit
    probability = np.exp(np.array(evidence) - max(evidence))
    probability /= probability.sum()
    mean = np.sum([p * held.parameters for p, held in zip(probability, fits, strict=True)], axis=0)
    covariance = np.zeros_like(fit.covariance)
    for p, held in zip(probability, fits, strict=True):
        off = held.parameters - mean
        covariance += p * (held.covariance + np.outer(off, off))
    likeliest = fits[int(np.argmax(probability))]
    # What is left out beside the root was left out for the light that it mixes.
    return ShapeFit(mean, covariance, likeliest.chi2, np.where(clear, likeliest.weights, fit.weights))
