"""Grooves with a bevel on either side, V and U: plates, bevels and a root, whose middle is the seam point."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float64
from noise_model.kernel import kernel
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.complete import completed
from tracker.joint.measured import (
    LEFT_OUT,
    START_SIGMA_MM,
    SURE_MM,
    SURE_SIGMAS,
    MeasuredJoint,
    ShapeFit,
    fit_points,
    opening_area,
    shift_of,
    two_angles,
    undetermined,
)
from tracker.joint.root import weigh_root
from tracker.joint.section_shapes import GROOVE, N_CORNERS, ROUND_GROOVE, corners_of
from tracker.profile import Section
from tracker.state import Y_MM, Z_MM, JointShape

SEARCH_STEP_MM = 0.2
PRIOR_SIGMA = np.array([5.0, 5.0, 0.3, 0.04, 0.04, 0.3, 0.3, 0.03, 0.03])
"""1 sigma of y, z, gap, both tan(bevel), both depths (mm), both plate slopes: how far an edge may be off."""

ROUND_PRIOR_SIGMA = np.append(PRIOR_SIGMA, 0.2)
"""The same, and that of a rounding's radius, mm."""

GAP, RADIUS = 2, 9
"""Which parameter the root's gap is, and which a `ROUND_GROOVE`'s radius."""

MUCH_LEFT_OUT, WIDER_MM = 0.2, 1.0
"""A fit that leaves out more of a groove's points may have lost a side: points so far off are let in anew."""

MIN_POINTS, MIN_ALONE = 5.0, 10.0
"""The weight of the points that must be seen on either side of a groove, and on one if it must do alone."""

MIN_GROOVE_SHARE = 0.3
"""The share of a bevel's scan lines, but no more than so many points, without which it is not seen."""

END_SHARE = 0.25
"""The share of a bevel's width at either end whose points may be the root's or the plate's as well."""


@kernel(allocates=True)
def fit_groove(section: Section, stated: StatedJoint) -> MeasuredJoint:
    """Return the V or U that a section shows, not determined where too little of it lies within the bevels.

    It is a U where its roundings' radius is stated.
    """
    points, half_mouth_mm = section.points, stated.corners_mm[-2, 0]
    # A copy of its own has one type: for a constant the kernels would be compiled anew.
    shape, prior_sigma = GROOVE, PRIOR_SIGMA.copy()
    if not math.isnan(stated.radius_mm):
        shape, prior_sigma = ROUND_GROOVE, ROUND_PRIOR_SIGMA.copy()
    start = start_of(points[Y_MM], points[Z_MM], section.reach_mm, stated, prior_sigma)
    chosen = np.ones(points[Y_MM].shape[0], np.bool_)
    fit = fit_points(shape, points, chosen, START_SIGMA_MM, prior_sigma, start)
    if not math.isfinite(fit.chi2):
        return undetermined()
    seen = seen_by(fit, points[Y_MM], half_mouth_mm)
    if seen.left_out > MUCH_LEFT_OUT:
        wider = fit_points(shape, points, chosen, WIDER_MM, prior_sigma, start)
        if math.isfinite(wider.chi2):
            seen_wider = seen_by(wider, points[Y_MM], half_mouth_mm)
            if seen_wider.left_out < seen.left_out:
                fit, seen = wider, seen_wider
    if shape == GROOVE and min(seen.right_bevel, seen.left_bevel) > 0.0:
        for i in range(chosen.shape[0]):
            chosen[i] = abs(points[Y_MM, i] - fit.parameters[0]) >= section.mixed_mm
        fit = weigh_root(shape, points, chosen, start, prior_sigma, GAP, fit)
        seen = seen_by(fit, points[Y_MM], half_mouth_mm)
    amid_mm = (1.0 - 2.0 * END_SHARE) * (half_mouth_mm - 0.5 * stated.gap_mm)
    enough = min(MIN_POINTS, MIN_GROOVE_SHARE * amid_mm / section.column_mm)
    if min(seen.right_bevel, seen.left_bevel) < enough:
        unseen, alone = (1.0, seen.right) if seen.left_bevel < seen.right_bevel else (-1.0, seen.left)
        if max(seen.right_bevel, seen.left_bevel) < enough or alone < MIN_ALONE:
            return undetermined()
        beside_unseen(points[Y_MM], fit.parameters, start, prior_sigma, unseen, half_mouth_mm, chosen)
        fit = fit_points(shape, points, chosen, START_SIGMA_MM, prior_sigma, start)
        if not math.isfinite(fit.chi2):
            return undetermined()
    elif min(seen.right, seen.left) < MIN_POINTS:
        return undetermined()
    # On a side that is not seen its points are left out on purpose.
    return completed(section, measured_groove(shape, fit, seen.left_out))


class Seen(NamedTuple):
    """What a fit sees of a groove: the weight of the points within the mouth on either side, of those amid
    either bevel, and the share of all of them that it leaves out.
    """

    right: float
    left: float
    right_bevel: float
    left_bevel: float
    left_out: float


@kernel(allocates=True)
def start_of(
    y_mm: Float64, z_mm: Float64, reach_mm: float, stated: StatedJoint, prior_sigma: Float64
) -> Float64:
    """Return the parameters (p,) of a stated groove where most of points (n,) lie on it; see `shift_of`.

    Those are as many as have a `prior_sigma` (p,).
    """
    depth = stated.depth_mm
    y_0, z_0 = shift_of(y_mm, z_mm, reach_mm, stated.corners_mm, depth, SEARCH_STEP_MM, 0.25 * depth)
    start = np.zeros(prior_sigma.shape[0])
    start[0], start[1], start[GAP] = y_0, z_0, stated.gap_mm
    start[3], start[4], start[5], start[6] = stated.tan, stated.tan, depth, depth
    if start.shape[0] > RADIUS:
        start[RADIUS] = stated.radius_mm
    return start


@kernel
def seen_in_groove(
    y_mm: Float64,
    weights: Float64,
    middle_mm: float,
    half_gap_mm: float,
    half_mouth_mm: float,
    end_share: float,
    least_weight: float,
) -> Seen:
    """Return what is seen of a groove by points (n,) and their weights.

    Amid is without `end_share` of the bevel's width at either end; left out is what weighs less than
    `least_weight`, 1 of no points.
    """
    ends = end_share * (half_mouth_mm - half_gap_mm)
    low, high = half_gap_mm + ends, half_mouth_mm - ends
    right, left, right_bevel, left_bevel, inside, out = 0.0, 0.0, 0.0, 0.0, 0, 0
    for i in range(y_mm.shape[0]):
        beside = y_mm[i] - middle_mm
        away = abs(beside)
        if away >= half_mouth_mm:
            continue
        inside += 1
        out += weights[i] < least_weight
        amid = weights[i] if low < away < high else 0.0
        if beside < 0.0:
            right += weights[i]
            right_bevel += amid
        else:
            left += weights[i]
            left_bevel += amid
    return Seen(right, left, right_bevel, left_bevel, out / inside if inside else 1.0)


@kernel
def seen_by(fit: ShapeFit, y_mm: Float64, half_mouth_mm: float) -> Seen:
    """Return what a fit sees of a groove of a mouth amid points (n,)."""
    p = fit.parameters
    seen: Seen = seen_in_groove(
        y_mm, fit.weights, p[0], 0.5 * max(p[GAP], 0.0), half_mouth_mm, END_SHARE, LEFT_OUT
    )
    return seen


@kernel
def beside_unseen(
    y_mm: Float64,
    parameters: Float64,
    start: Float64,
    prior_sigma: Float64,
    side: float,
    half_mouth_mm: float,
    counts: Bool,
) -> None:
    """Say which points (n,) count for a groove whose one bevel, on a side, is not seen.

    Priors stand in for that, in the covariance too. Where the root ends there is not known: of the root only
    what lies well this side of it counts.
    """
    half_gap_mm, sure_mm = 0.5 * parameters[GAP], max(start[GAP] - SURE_SIGMAS * prior_sigma[GAP], 0.0)
    for i in range(y_mm.shape[0]):
        out_mm = side * (y_mm[i] - parameters[0])
        counts[i] = out_mm + half_gap_mm < sure_mm or out_mm > half_mouth_mm + SURE_MM


@kernel(allocates=True)
def measured_groove(shape: int, fit: ShapeFit, left_out: float) -> MeasuredJoint:
    """Return the joint that a fitted groove is, of whose points some share is left out."""
    p, covariance = fit.parameters, fit.covariance
    corners_mm = np.empty((N_CORNERS[shape], 2))
    corners_of(shape, p, corners_mm)
    bevels, bevel_sigmas = two_angles(p, covariance, 3, 4)
    plates, plate_sigmas = two_angles(p, covariance, 7, 8)
    area, area_sigma = opening_area(shape, p, covariance)
    joint_shape = JointShape(
        gap_sigma_mm=math.sqrt(covariance[2, 2]),
        mismatch_sigma_mm=math.sqrt(covariance[5, 5] + covariance[6, 6] - 2.0 * covariance[5, 6]),
        bevel_angles_deg=bevels,
        bevel_sigmas_deg=bevel_sigmas,
        plate_angles_deg=plates,
        plate_sigmas_deg=plate_sigmas,
        area_mm2=area,
        area_sigma_mm2=area_sigma,
    )
    return MeasuredJoint(
        y_mm=p[0],
        z_mm=p[1],
        covariance_mm2=covariance[:2, :2].copy(),
        gap_mm=max(p[GAP], 0.0),
        mismatch_mm=p[5] - p[6],
        chi2=fit.chi2,
        shape=joint_shape,
        unexplained=left_out,
        corners_mm=corners_mm,
        evidence_nats=math.nan,
    )
