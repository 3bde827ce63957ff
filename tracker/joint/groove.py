"""Grooves with a bevel on either side, V and U: plates, bevels and a root, whose middle is the seam point."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Float64
from noise_model.kernel import kernel
from noise_model.surface.joint import Joint, section
from tracker.joint.measured import (
    LEFT_OUT,
    SURE_MM,
    SURE_SIGMAS,
    MeasuredJoint,
    ShapeFit,
    fit_shape,
    opening_area,
    place,
    two_angles,
)
from tracker.joint.root import weigh_root
from tracker.joint.section_shapes import GROOVE, N_CORNERS, ROUND_GROOVE, corners_of
from tracker.profile import Profile
from tracker.state import JointShape

SEARCH_STEP_MM = 0.2
PRIOR_SIGMA = np.array([5.0, 5.0, 0.3, 0.04, 0.04, 0.3, 0.3, 0.03, 0.03])
"""1 sigma of y, z, gap, both tan(bevel), both depths (mm), both plate slopes: how far an edge may be off."""

ROUND_PRIOR_SIGMA = np.append(PRIOR_SIGMA, 0.2)
"""The same, and that of a rounding's radius, mm."""

GAP = 2
"""Which parameter the root's gap is."""

MUCH_LEFT_OUT, WIDER_MM = 0.2, 1.0
"""A fit that leaves out more of a groove's points may have lost a side: points so far off are let in anew."""

MIN_POINTS, MIN_ALONE = 5.0, 10.0
"""The weight of the points that must be seen on either side of a groove, and on one if it must do alone."""

MIN_GROOVE_SHARE = 0.3
"""The share of a bevel's scan lines, but no more than so many points, without which it is not seen."""

END_SHARE = 0.25
"""The share of a bevel's width at either end whose points may be the root's or the plate's as well."""


def fit_v_groove(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the V that a profile shows, or None where too little of it lies within the bevels."""
    size = joint.dimensions
    tan = math.tan(math.radians(size["included_angle_deg"] / 2.0))
    return _fit(profile, joint, GROOVE, tan, (), PRIOR_SIGMA)


def fit_u_groove(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the U that a profile shows, or None where too little of it lies within the bevels."""
    size = joint.dimensions
    tan = math.tan(math.radians(size["bevel_angle_deg"]))
    return _fit(profile, joint, ROUND_GROOVE, tan, (size["root_radius_mm"],), ROUND_PRIOR_SIGMA)


def _fit(
    profile: Profile, joint: Joint, shape: int, tan: float, more: tuple[float, ...], prior_sigma: Float64
) -> MeasuredJoint | None:
    depth, gap = joint.dimensions["depth_mm"], joint.dimensions["root_gap_mm"]
    corners = section(joint).vertices
    y_0, z_0 = place(profile, corners, SEARCH_STEP_MM, 0.25 * depth, depth)
    start = np.array([y_0, z_0, gap, tan, tan, depth, depth, 0.0, 0.0, *more])
    fit = fit_shape(profile, shape, start, prior_sigma)
    if fit is None:
        return None
    half_mouth = float(corners[-2, 0])
    seen = _seen_of(profile, fit, half_mouth)
    if seen.left_out > MUCH_LEFT_OUT:
        again = fit_shape(profile, shape, start, prior_sigma, start_sigma_mm=WIDER_MM)
        if again is not None and _seen_of(profile, again, half_mouth).left_out < seen.left_out:
            fit = again
            seen = _seen_of(profile, fit, half_mouth)
    if shape == GROOVE and min(seen.right_bevel, seen.left_bevel) > 0.0:
        fit = weigh_root(profile, shape, start, prior_sigma, GAP, float(fit.parameters[0]), fit)
        seen = _seen_of(profile, fit, half_mouth)
    amid_mm = (1.0 - 2.0 * END_SHARE) * (half_mouth - 0.5 * gap)
    enough = min(MIN_POINTS, MIN_GROOVE_SHARE * amid_mm / profile.column_mm)
    if min(seen.right_bevel, seen.left_bevel) < enough:
        unseen, alone = (1.0, seen.right) if seen.left_bevel < seen.right_bevel else (-1.0, seen.left)
        if max(seen.right_bevel, seen.left_bevel) < enough or alone < MIN_ALONE:
            return None
        bridged = _bridged(profile, fit, shape, start, prior_sigma, unseen, half_mouth)
        if bridged is None:
            return None
        fit = bridged
    elif min(seen.right, seen.left) < MIN_POINTS:
        return None
    y_s, z_s, gap_mm, _, _, depth_left, depth_right = fit.parameters[:7].tolist()
    joint_shape, corners_mm = groove_section(shape, fit.parameters, fit.covariance)
    return MeasuredJoint(
        y_s,
        z_s,
        fit.covariance[:2, :2],
        max(gap_mm, 0.0),
        depth_left - depth_right,
        fit.chi2,
        joint_shape,
        seen.left_out,
        corners_mm,
    )


class Seen(NamedTuple):
    """What a fit sees of a groove: the weight of the points within the mouth on either side, of those amid
    either bevel, and the share of all of them that it leaves out.
    """

    right: float
    left: float
    right_bevel: float
    left_bevel: float
    left_out: float


def _seen_of(profile: Profile, fit: ShapeFit, half_mouth_mm: float) -> Seen:
    """Return what a fit sees of a groove."""
    y_s, half_gap = float(fit.parameters[0]), 0.5 * max(float(fit.parameters[2]), 0.0)
    return Seen(*seen_in_groove(profile.y_mm, fit.weights, y_s, half_gap, half_mouth_mm, END_SHARE, LEFT_OUT))


@kernel
def seen_in_groove(
    y_mm: Float64,
    weights: Float64,
    middle_mm: float,
    half_gap_mm: float,
    half_mouth_mm: float,
    end_share: float,
    least_weight: float,
) -> tuple[float, float, float, float, float]:
    """Return the numbers of `Seen` from points (n,) and their weights.

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
    return right, left, right_bevel, left_bevel, out / inside if inside else 1.0


def _bridged(
    profile: Profile,
    fit: ShapeFit,
    shape: int,
    start: Float64,
    prior_sigma: Float64,
    side: float,
    half_mouth_mm: float,
) -> ShapeFit | None:
    """Fit a groove whose one bevel is not seen; the priors stand in for it, in the covariance too.

    Where the root ends on that side is not known: of the root only what lies well this side of it counts.
    """
    y_s, gap = float(fit.parameters[0]), float(fit.parameters[2])
    from_seen = side * (profile.y_mm - y_s) + 0.5 * gap
    sure = max(float(start[2]) - SURE_SIGMAS * float(prior_sigma[2]), 0.0)
    on_plate = side * (profile.y_mm - y_s) > half_mouth_mm + SURE_MM
    return fit_shape(profile, shape, start, prior_sigma, (from_seen < sure) | on_plate)


@kernel(allocates=True)
def groove_section(shape: int, p: Float64, covariance: Float64) -> tuple[JointShape, Float64]:
    """Return what a fitted groove's section shows, and its corners (n, 2), mm."""
    corners_mm = np.empty((N_CORNERS[shape], 2))
    corners_of(shape, p, corners_mm)
    bevels, bevel_sigmas = two_angles(p, covariance, 3, 4)
    plates, plate_sigmas = two_angles(p, covariance, 7, 8)
    area, area_sigma = opening_area(shape, p, covariance)
    joint_shape = JointShape(
        math.sqrt(covariance[2, 2]),
        math.sqrt(covariance[5, 5] + covariance[6, 6] - 2.0 * covariance[5, 6]),
        bevels,
        bevel_sigmas,
        plates,
        plate_sigmas,
        area,
        area_sigma,
    )
    return joint_shape, corners_mm
