"""Plain NumPy twins of the kernels that put a joint's fit together; the least squares are `fit_points`'."""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Bool, Float64
from noise_model.surface.joint import Joint, section
from tracker.joint.groove import (
    END_SHARE,
    GAP,
    MIN_ALONE,
    MIN_GROOVE_SHARE,
    MIN_POINTS,
    MUCH_LEFT_OUT,
    PRIOR_SIGMA,
    ROUND_PRIOR_SIGMA,
    SEARCH_STEP_MM,
    WIDER_MM,
)
from tracker.joint.measured import (
    LEFT_OUT,
    START_SIGMA_MM,
    SURE_MM,
    SURE_SIGMAS,
    ShapeFit,
    fit_points,
    points_of,
    shift_of,
)
from tracker.joint.root import CELLS_MM, CLOSED_AS_STATED, GAPS, NARROW_MM
from tracker.joint.section_fit import tukey_loss
from tracker.joint.section_shapes import GROOVE, ROUND_GROOVE
from tracker.profile import Profile


def fit_of(
    profile: Profile,
    shape: int,
    start: Float64,
    prior_sigma: Float64,
    used: Bool | None = None,
    start_sigma_mm: float = START_SIGMA_MM,
) -> ShapeFit | None:
    """A shape's fit to the points that are used, None where it cannot be."""
    chosen = np.ones(len(profile.y_mm), dtype=bool) if used is None else used
    fit: ShapeFit = fit_points(shape, points_of(profile), chosen, start_sigma_mm, prior_sigma, start)
    return fit if math.isfinite(fit.chi2) else None


def root_prior(stated_mm: float, sigma_mm: float) -> Float64:
    """What a normal has between the middles of GAPS; of a root that is stated closed most of it at none."""
    borders = np.concatenate([[-math.inf], 0.5 * (GAPS[1:] + GAPS[:-1]), [math.inf]])
    below = np.array([0.5 * (1.0 + math.erf((b - stated_mm) / (math.sqrt(2.0) * sigma_mm))) for b in borders])
    prior = np.diff(below)
    if stated_mm == 0.0:
        prior[0] = 0.0
        prior *= (1.0 - CLOSED_AS_STATED) / prior.sum()
        prior[0] = CLOSED_AS_STATED
    return np.asarray(prior)


def weighed_root(
    profile: Profile,
    shape: int,
    clear: Bool,
    start: Float64,
    prior_sigma: Float64,
    gap: int,
    fit: ShapeFit,
) -> ShapeFit:
    """The fits from each gap of a grid, averaged by their posterior probability."""
    if not fit.parameters[gap] < NARROW_MM:
        return fit
    ratio = profile.beside_px[clear] / profile.sigma_px[clear]
    alike = float(np.median(ratio**2)) if clear.any() else 1.0
    fits, evidence = [], []
    prior_of_gaps = root_prior(float(start[gap]), float(prior_sigma[gap]))
    for gap_mm, cell_mm, prior in zip(GAPS, CELLS_MM, prior_of_gaps, strict=True):
        from_gap, sigma = start.copy(), prior_sigma.copy()
        from_gap[gap], sigma[gap] = gap_mm, cell_mm
        held = fit_of(profile, shape, from_gap, sigma, clear)
        if held is None or not prior > 0.0:
            continue
        moved = (float(held.parameters[gap]) - gap_mm) / cell_mm
        left_open = min(float(held.covariance[gap, gap]) / cell_mm**2, 1.0)
        loss = tukey_loss(held.weights[clear]) / alike
        fits.append(held)
        evidence.append(math.log(prior) - loss - 0.5 * moved**2 + 0.5 * math.log(left_open))
    if not fits:
        return fit
    probability = np.exp(np.array(evidence) - max(evidence))
    probability /= probability.sum()
    parameters = np.stack([held.parameters for held in fits])
    mean = probability @ parameters
    spread = np.einsum("k,ki,kj->ij", probability, parameters - mean, parameters - mean)
    covariance = spread + np.einsum("k,kij->ij", probability, np.stack([held.covariance for held in fits]))
    likeliest = fits[int(np.argmax(probability))]
    return ShapeFit(mean, covariance, likeliest.chi2, np.where(clear, likeliest.weights, fit.weights))


def fitted_groove(profile: Profile, joint: Joint) -> ShapeFit | None:
    """The fit of a V or U that a profile shows, None where too little of it lies within the bevels."""
    size = joint.dimensions
    depth, gap = size["depth_mm"], size["root_gap_mm"]
    corners, y_mm = section(joint).vertices, profile.y_mm
    angle_deg = size["included_angle_deg"] / 2.0 if joint.type == "v_groove" else size["bevel_angle_deg"]
    tan, half_mouth_mm = math.tan(math.radians(angle_deg)), float(corners[-2, 0])
    y_0, z_0 = shift_of(y_mm, profile.z_mm, profile.reach_mm, corners, depth, SEARCH_STEP_MM, 0.25 * depth)
    shape, prior_sigma = GROOVE, PRIOR_SIGMA
    start = np.array([y_0, z_0, gap, tan, tan, depth, depth, 0.0, 0.0])
    if joint.type == "u_groove":
        shape, prior_sigma = ROUND_GROOVE, ROUND_PRIOR_SIGMA
        start = np.append(start, size["root_radius_mm"])
    fit = fit_of(profile, shape, start, prior_sigma)
    if fit is None:
        return None
    right, left, right_bevel, left_bevel, left_out = seen_of(y_mm, fit, half_mouth_mm)
    if left_out > MUCH_LEFT_OUT:
        wider = fit_of(profile, shape, start, prior_sigma, start_sigma_mm=WIDER_MM)
        if wider is not None and seen_of(y_mm, wider, half_mouth_mm)[-1] < left_out:
            fit = wider
            right, left, right_bevel, left_bevel, left_out = seen_of(y_mm, fit, half_mouth_mm)
    if shape == GROOVE and min(right_bevel, left_bevel) > 0.0:
        clear = np.abs(y_mm - fit.parameters[0]) >= profile.mixed_mm
        fit = weighed_root(profile, shape, clear, start, prior_sigma, GAP, fit)
        right, left, right_bevel, left_bevel, left_out = seen_of(y_mm, fit, half_mouth_mm)
    amid_mm = (1.0 - 2.0 * END_SHARE) * (half_mouth_mm - 0.5 * gap)
    enough = min(MIN_POINTS, MIN_GROOVE_SHARE * amid_mm / profile.column_mm)
    if min(right_bevel, left_bevel) >= enough:
        return fit if min(right, left) >= MIN_POINTS else None
    side, alone = (1.0, right) if left_bevel < right_bevel else (-1.0, left)
    if max(right_bevel, left_bevel) < enough or alone < MIN_ALONE:
        return None
    out_mm = side * (y_mm - fit.parameters[0])
    sure_mm = max(gap - SURE_SIGMAS * prior_sigma[GAP], 0.0)
    counts = (out_mm + 0.5 * fit.parameters[GAP] < sure_mm) | (out_mm > half_mouth_mm + SURE_MM)
    return fit_of(profile, shape, start, prior_sigma, counts)


def seen_of(y_mm: Float64, fit: ShapeFit, half_mouth_mm: float) -> tuple[float, float, float, float, float]:
    """The weights on either side of a groove and amid either bevel, and the share of points left out."""
    beside, weights = y_mm - fit.parameters[0], fit.weights
    half_gap_mm = 0.5 * max(fit.parameters[GAP], 0.0)
    ends = END_SHARE * (half_mouth_mm - half_gap_mm)
    inside = np.abs(beside) < half_mouth_mm
    amid = (np.abs(beside) > half_gap_mm + ends) & (np.abs(beside) < half_mouth_mm - ends)
    right, left = inside & (beside < 0.0), inside & (beside >= 0.0)
    left_out = np.mean(weights[inside] < LEFT_OUT) if inside.any() else 1.0
    masks = right, left, right & amid, left & amid
    a, b, c, d = (float(weights[mask].sum()) for mask in masks)
    return a, b, c, d, float(left_out)
