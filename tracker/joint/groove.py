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
    shift_of,
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


def fit_v_groove(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the V that a profile shows, or None where too little of it lies within the bevels."""
    size = joint.dimensions
    tan = math.tan(math.radians(size["included_angle_deg"] / 2.0))
    return _fit(profile, joint, GROOVE, tan, 0.0, PRIOR_SIGMA)


def fit_u_groove(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the U that a profile shows, or None where too little of it lies within the bevels."""
    size = joint.dimensions
    tan = math.tan(math.radians(size["bevel_angle_deg"]))
    return _fit(profile, joint, ROUND_GROOVE, tan, size["root_radius_mm"], ROUND_PRIOR_SIGMA)


def _fit(
    profile: Profile, joint: Joint, shape: int, tan: float, radius_mm: float, prior_sigma: Float64
) -> MeasuredJoint | None:
    depth, gap = joint.dimensions["depth_mm"], joint.dimensions["root_gap_mm"]
    corners = section(joint).vertices
    stated = Stated(corners, gap, tan, depth, radius_mm)
    start = start_of(profile.y_mm, profile.z_mm, profile.reach_mm, stated, prior_sigma)
    fit = fit_shape(profile, shape, start, prior_sigma)
    if fit is None:
        return None
    y_mm, half_mouth = profile.y_mm, float(corners[-2, 0])
    seen, measured = measured_groove(shape, y_mm, fit, half_mouth)
    if seen.left_out > MUCH_LEFT_OUT:
        wider = fit_shape(profile, shape, start, prior_sigma, start_sigma_mm=WIDER_MM)
        if wider is not None:
            seen_wider, measured_wider = measured_groove(shape, y_mm, wider, half_mouth)
            if seen_wider.left_out < seen.left_out:
                fit, seen, measured = wider, seen_wider, measured_wider
    if shape == GROOVE and min(seen.right_bevel, seen.left_bevel) > 0.0:
        weighed = weigh_root(profile, shape, start, prior_sigma, GAP, measured.y_mm, fit)
        if weighed is not fit:
            fit = weighed
            seen, measured = measured_groove(shape, y_mm, fit, half_mouth)
    amid_mm = (1.0 - 2.0 * END_SHARE) * (half_mouth - 0.5 * gap)
    enough = min(MIN_POINTS, MIN_GROOVE_SHARE * amid_mm / profile.column_mm)
    if min(seen.right_bevel, seen.left_bevel) < enough:
        unseen, alone = (1.0, seen.right) if seen.left_bevel < seen.right_bevel else (-1.0, seen.left)
        if max(seen.right_bevel, seen.left_bevel) < enough or alone < MIN_ALONE:
            return None
        bridged = _bridged(profile, fit, shape, start, prior_sigma, unseen, half_mouth)
        if bridged is None:
            return None
        # On the side that is not seen its points are left out on purpose.
        measured = measured_groove(shape, y_mm, bridged, half_mouth)[1]._replace(unexplained=seen.left_out)
    elif min(seen.right, seen.left) < MIN_POINTS:
        return None
    return measured


class Seen(NamedTuple):
    """What a fit sees of a groove: the weight of the points within the mouth on either side, of those amid
    either bevel, and the share of all of them that it leaves out.
    """

    right: float
    left: float
    right_bevel: float
    left_bevel: float
    left_out: float


class Stated(NamedTuple):
    """A groove as it is stated: its corners (n, 2), mm, and its dimensions.

    `tan` is that of both bevels' angles, `radius_mm` that of a `ROUND_GROOVE`'s roundings.
    """

    corners: Float64
    gap_mm: float
    tan: float
    depth_mm: float
    radius_mm: float


@kernel(allocates=True)
def start_of(y_mm: Float64, z_mm: Float64, reach_mm: float, stated: Stated, prior_sigma: Float64) -> Float64:
    """Return the parameters (p,) of a stated groove where most of points (n,) lie on it; see `place`.

    Those are as many as have a `prior_sigma` (p,).
    """
    depth = stated.depth_mm
    y_0, z_0 = shift_of(y_mm, z_mm, reach_mm, stated.corners, depth, SEARCH_STEP_MM, 0.25 * depth)
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
def measured_groove(
    shape: int, y_mm: Float64, fit: ShapeFit, half_mouth_mm: float
) -> tuple[Seen, MeasuredJoint]:
    """Return what a fit sees of a groove of a mouth amid points (n,), and the joint that it is."""
    p, covariance = fit.parameters, fit.covariance
    right, left, right_bevel, left_bevel, left_out = seen_in_groove(
        y_mm, fit.weights, p[0], 0.5 * max(p[GAP], 0.0), half_mouth_mm, END_SHARE, LEFT_OUT
    )
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
    measured = MeasuredJoint(
        p[0],
        p[1],
        covariance[:2, :2],
        max(p[GAP], 0.0),
        p[5] - p[6],
        fit.chi2,
        joint_shape,
        left_out,
        corners_mm,
        math.nan,
    )
    return Seen(right, left, right_bevel, left_bevel, left_out), measured
