"""Plain NumPy twins of the kernels that put a joint's fit together; the least squares are `fit_points`'."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from edge_twins import FacesBeside
from profiles import Profile

from noise_model.compiled.arrays import Bool, Float64
from noise_model.surface.joint import Joint, section
from tracker.joint import half_v
from tracker.joint.fillet import (
    BESIDE_MM,
    MAX_TURNED_SIGMAS,
    PLATE_SIGMA_DEG,
    SEARCH_LIMIT_MM,
)
from tracker.joint.fillet import MIN_POINTS as MIN_ON_PLATE
from tracker.joint.fillet import SEARCH_STEP_MM as CORNER_STEP_MM
from tracker.joint.groove import (
    CELLS_MM,
    CLOSED_AS_STATED,
    END_SHARE,
    GAP,
    GAPS,
    MIN_ALONE,
    MIN_GROOVE_SHARE,
    MIN_POINTS,
    MUCH_LEFT_OUT,
    NARROW_MM,
    PRIOR_SIGMA,
    ROUND_PRIOR_SIGMA,
    SEARCH_STEP_MM,
    WIDER_MM,
)
from tracker.joint.measured import LEFT_OUT, START_SIGMA_MM, SURE_MM, SURE_SIGMAS, fit_points, shift_of
from tracker.joint.section_fit import BISQUARE_WIDTH, ShapeFit
from tracker.joint.section_shapes import CORNER, GROOVE, HALF_GROOVE, ROUND_GROOVE
from tracker.joint.upright_edge import (
    hidden_strip,
    neighbours_of_edge,
    upright_edge,
)


def tukey_loss(weights: Float64) -> float:
    """Tukey's loss, nats, from his weights (n,): half the square of a residual that is small."""
    return BISQUARE_WIDTH**2 / 6.0 * float(np.sum(1.0 - weights**1.5))


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
    fit: ShapeFit = fit_points(shape, profile.points, chosen, start_sigma_mm, prior_sigma, start)
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


class HalfV(NamedTuple):
    """A half V as it was fitted: its faces, where its upright side is, and the share of points left out."""

    fit: ShapeFit
    wall_mm: float
    left_out: float


def fitted_half_v(profile: Profile, joint: Joint, camera_mm: Float64, laser_mm: Float64) -> HalfV | None:
    """The half V that a profile shows, None where too little of it lies beside its upright side."""
    size, sigma, y_mm = joint.dimensions, half_v.PRIOR_SIGMA, profile.y_mm
    depth, gap = size["depth_mm"], size["root_gap_mm"]
    corners = section(joint).vertices + np.array([0.0, depth])
    y_0, z_0 = shift_of(
        y_mm, profile.z_mm, profile.reach_mm, corners, 0.0, half_v.SEARCH_STEP_MM, 0.25 * depth
    )
    tan = math.tan(math.radians(size["bevel_angle_deg"]))
    start = np.array([gap, z_0, tan, depth, depth, 0.0, 0.0, y_0 - 0.5 * gap])
    fit = fit_of(profile, HALF_GROOVE, start, sigma, np.abs(y_mm - start[-1]) > half_v.CLEAR_OF_EDGE_MM)
    if fit is None:
        return None
    lines, wall_mm = profile.by_scan(), float(start[-1])
    faces, near, before, behind = beside_the_upright(lines, fit, wall_mm)
    if before < 0:
        return None
    hidden = hidden_strip((camera_mm, laser_mm), wall_mm, z_0 + depth, depth, profile.slope_sigma)
    met, change = faces.met(lines, before), faces.change(lines, near, half_v.BENT_MM, before, behind)
    edge = upright_edge(lines.scan, lines.column_mm, lines.light, before, behind, hidden, met, change)
    start[-1] = wall_mm = edge.y_mm
    clear = (y_mm <= lines.y_mm[before]) | (y_mm >= lines.y_mm[behind] + profile.mixed_mm)
    fit = fit_of(profile, HALF_GROOVE, start, sigma, clear)
    if fit is None:
        return None
    p = fit.parameters
    foot_mm, mouth_mm = wall_mm + max(p[half_v.GAP], 0.0), wall_mm + p[half_v.GAP] + p[3] * p[half_v.TAN]
    inside = (y_mm > wall_mm) & (y_mm < mouth_mm)
    if fit.weights[(y_mm > foot_mm) & (y_mm < mouth_mm)].sum() >= half_v.MIN_POINTS:
        away = clear & (np.abs(y_mm - 0.5 * (wall_mm + foot_mm)) >= profile.mixed_mm)
        fit = weighed_root(profile, HALF_GROOVE, away, start, sigma, half_v.GAP, fit)
    else:
        sure_mm = wall_mm + max(gap - SURE_SIGMAS * sigma[half_v.GAP], 0.0)
        clear &= (y_mm < sure_mm) | (y_mm > mouth_mm + SURE_MM)
        fit = fit_of(profile, HALF_GROOVE, start, sigma, clear)
    if fit is None or fit.weights[inside].sum() < half_v.MIN_POINTS:
        return None
    return HalfV(fit, wall_mm, left_out_of(fit, clear & inside))


class BesideUpright(NamedTuple):
    """The faces beside an upright side, points (n,) that are near it, and the two next to it, or -1."""

    faces: FacesBeside
    near: Bool
    before: int
    behind: int


def beside_the_upright(profile: Profile, fit: ShapeFit, wall_mm: float) -> BesideUpright:
    """What lies beside an upright side: the right plate before it, the groove behind."""
    gap, root, tan, _, depth, _, slope = fit.parameters
    y = profile.y_mm - wall_mm
    heights_mm = np.stack([root + depth + slope * y, root + np.maximum(y - gap, 0.0) / tan])
    slopes = np.stack([np.full(len(y), slope), np.where(y > gap, 1.0 / tan, 0.0)])
    sigma_mm = half_v.ON_FACE_SIGMAS * np.abs(profile.dz_mm) * profile.sigma_px
    limit_mm = np.minimum(0.25 * depth, np.hypot(half_v.BENT_MM, sigma_mm))
    near = np.abs(y) < 5.0 * half_v.CLEAR_OF_EDGE_MM
    on_plate, in_groove = near & (np.abs(profile.z_mm - heights_mm) < limit_mm)
    return BesideUpright(FacesBeside(heights_mm, slopes), near, *neighbours_of_edge(on_plate, in_groove))


def left_out_of(fit: ShapeFit, near: Bool) -> float:
    """The share of the points near a joint that weigh next to nothing; 1 without any."""
    return float(np.mean(fit.weights[near] < LEFT_OUT)) if near.any() else 1.0


def fitted_fillet(profile: Profile, joint: Joint) -> tuple[ShapeFit, float] | None:
    """The corner that a profile shows and the share of points left out; None without both plates."""
    corners, y_mm = section(joint).vertices, profile.y_mm
    y_0, z_0 = shift_of(y_mm, profile.z_mm, profile.reach_mm, corners, 0.0, CORNER_STEP_MM, SEARCH_LIMIT_MM)
    slope = 1.0 / math.tan(math.radians(joint.dimensions["included_angle_deg"] / 2.0))
    plate_sigma = math.radians(PLATE_SIGMA_DEG) * (1.0 + slope**2)
    start = np.array([y_0, z_0, slope, -slope])
    fit = fit_of(profile, CORNER, start, np.array([5.0, 5.0, plate_sigma, plate_sigma]))
    if fit is None:
        return None
    on_left = y_mm > fit.parameters[0]
    turned = np.abs(fit.parameters[2:] - start[2:]).max() / plate_sigma
    least = min(fit.weights[on_left].sum(), fit.weights[~on_left].sum())
    if turned > MAX_TURNED_SIGMAS or least < MIN_ON_PLATE:
        return None
    return fit, left_out_of(fit, np.abs(y_mm - fit.parameters[0]) < BESIDE_MM)
