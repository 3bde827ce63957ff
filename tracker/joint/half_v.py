"""The half V: an upright side at smaller y, a bevel opposite; the seam point is the middle of the root."""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Float64
from noise_model.surface.joint import Joint, section
from tracker.joint.measured import (
    SURE_MM,
    SURE_SIGMAS,
    MeasuredJoint,
    OnFace,
    ShapeFit,
    angles_of,
    fit_shape,
    meet_face,
    opening_of,
    place,
    points_of,
    section_of,
    unexplained,
)
from tracker.joint.root import weigh_root
from tracker.joint.section_shapes import HALF_GROOVE
from tracker.joint.upright_edge import edge_between, edge_covariance, hidden_strip, neighbours_of_edge
from tracker.profile import Profile
from tracker.state import JointShape

SEARCH_STEP_MM = 0.1
CLEAR_OF_EDGE_MM = 0.3
"""Points nearer to the upright side than this wait until it is found."""

ON_FACE_SIGMAS = 2.0
"""A point beside the upright side that lies farther off a face may hold light of both.

One in twenty of a face's own points does, and is outvoted by its neighbours.
"""

BENT_MM = 0.2
"""So far a face may bend off its straight line beside the upright side."""

GAP, ROOT, TAN, DEPTH_LEFT, DEPTH_RIGHT, SLOPE_LEFT, SLOPE_RIGHT = range(7)
PRIOR_SIGMA = np.array([0.3, 5.0, 0.04, 0.3, 0.3, 0.03, 0.03])
"""1 sigma of the gap, the root's height, tan(bevel), both depths (mm), both plate slopes."""

MEAN_HEIGHT = np.array([0.0, 1.0, 0.0, 0.0, 0.5, 0.0, 0.0])
"""How the mean height of the faces beside the upright side goes with the parameters."""

CLOSED_MM = 0.03
"""A root whose mean gap comes out narrower is most probably closed."""

MIN_POINTS = 5.0
"""The weight of the points that must be seen in the groove, and on the bevel if it is not to be bridged."""


def fit_half_v(profile: Profile, joint: Joint, camera_mm: Float64, laser_mm: Float64) -> MeasuredJoint | None:
    """Return the half V that a profile shows, or None where too little of it lies beside its upright side.

    The faces are fitted clear of the upright side; that lies between the last point of the right plate and
    the first one in the groove, less what it hides there from `camera_mm` or `laser_mm` (3,), joint frame;
    then they are fitted once more.
    """
    size = joint.dimensions
    depth, gap = size["depth_mm"], size["root_gap_mm"]
    tan = math.tan(math.radians(size["bevel_angle_deg"]))
    corners = section(joint).vertices + np.array([0.0, depth])
    y_0, z_0 = place(profile, corners, SEARCH_STEP_MM, 0.25 * depth)
    start = np.array([gap, z_0, tan, depth, depth, 0.0, 0.0, y_0 - 0.5 * gap])
    fit = fit_shape(
        profile, HALF_GROOVE, start, PRIOR_SIGMA, np.abs(profile.y_mm - start[-1]) > CLEAR_OF_EDGE_MM
    )
    if fit is None:
        return None
    lines = profile.by_scan()
    before, behind = _beside_the_upright(lines, fit, float(start[-1]))
    if before < 0:
        return None
    hidden = hidden_strip((camera_mm, laser_mm), float(start[-1]), z_0 + depth, depth, profile.slope_sigma)
    upright = edge_between(lines, before, behind, hidden, _met(lines, fit, float(start[-1]), before))
    start[-1] = upright.y_mm
    wall_variance = float(edge_covariance(upright, MEAN_HEIGHT, MEAN_HEIGHT, fit.covariance)[0, 0])
    # What lies between may be either side's, and the first lines in the groove hold light of the plate too.
    clear = (profile.y_mm <= lines.y_mm[before]) | (profile.y_mm >= lines.y_mm[behind] + profile.mixed_mm)
    fit = fit_shape(profile, HALF_GROOVE, start, PRIOR_SIGMA, clear)
    if fit is None:
        return None
    wall, p = float(start[-1]), fit.parameters
    mouth = wall + p[GAP] + p[DEPTH_LEFT] * p[TAN]
    on_bevel = (profile.y_mm > wall + max(p[GAP], 0.0)) & (profile.y_mm < mouth)
    is_seen = fit.weights[on_bevel].sum() >= MIN_POINTS
    if not is_seen:
        # A bevel that is not seen is bridged by its priors, in the covariance too; where the root ends is not
        # known, and what lies there counts for nothing.
        sure = wall + max(gap - SURE_SIGMAS * PRIOR_SIGMA[GAP], 0.0)
        clear &= (profile.y_mm < sure) | (profile.y_mm > mouth + SURE_MM)
        fit = fit_shape(profile, HALF_GROOVE, start, PRIOR_SIGMA, clear)
        if fit is None:
            return None
    inside = (profile.y_mm > wall) & (profile.y_mm < mouth)
    if is_seen:
        middle_mm = wall + 0.5 * max(float(fit.parameters[GAP]), 0.0)
        away = clear & (np.abs(profile.y_mm - middle_mm) >= profile.mixed_mm)
        fit = weigh_root(HALF_GROOVE, points_of(profile), away, start, PRIOR_SIGMA, GAP, fit)
    if fit.weights[inside].sum() < MIN_POINTS:
        return None
    left_out = unexplained(profile, fit, 0.5 * (wall + mouth), 0.5 * (mouth - wall), clear)
    return _measured(fit, wall, wall_variance, left_out)


def _beside_the_upright(profile: Profile, fit: ShapeFit, wall: float) -> tuple[int, int]:
    """Return the last point of the right plate and the first in the groove beside an upright side, or -1."""
    p = fit.parameters
    y = profile.y_mm - wall
    over_plate = profile.z_mm - (p[ROOT] + p[DEPTH_RIGHT] + p[SLOPE_RIGHT] * y)
    over_groove = profile.z_mm - (p[ROOT] + np.maximum(y - p[GAP], 0.0) / p[TAN])
    near = np.abs(y) < 5.0 * CLEAR_OF_EDGE_MM
    sure_mm = np.hypot(BENT_MM, ON_FACE_SIGMAS * np.abs(profile.dz_mm) * profile.sigma_px)
    limit = np.minimum(0.25 * p[DEPTH_RIGHT], sure_mm)
    return neighbours_of_edge(near & (np.abs(over_plate) < limit), near & (np.abs(over_groove) < limit))


def _met(profile: Profile, fit: ShapeFit, wall: float, before: int) -> OnFace:
    """Return where points' rays meet the right plate, up to the point `before` the upright, or the groove."""
    p, y = fit.parameters, profile.y_mm - wall
    is_plate, is_bevel = np.arange(len(y)) <= before, y > p[GAP]
    plate_mm = p[DEPTH_RIGHT] + p[SLOPE_RIGHT] * y
    groove_mm = np.maximum(y - p[GAP], 0.0) / p[TAN]
    slope = np.where(is_plate, p[SLOPE_RIGHT], np.where(is_bevel, 1.0 / p[TAN], 0.0))
    return meet_face(profile, p[ROOT] + np.where(is_plate, plate_mm, groove_mm), slope)


def _measured(fit: ShapeFit, wall: float, wall_variance: float, left_out: float) -> MeasuredJoint:
    """Turn a fit beside a given upright side into the joint, the side's own variance put in.

    As far as the profile and not the prior tells where the bevel's foot is, the gap gives way to the side.
    """
    p, covariance = fit.parameters, fit.covariance
    gives_way = max(0.0, 1.0 - covariance[GAP, GAP] / PRIOR_SIGMA[GAP] ** 2)
    y_s = wall + 0.5 * p[GAP]
    variance_y = (1.0 - 0.5 * gives_way) ** 2 * wall_variance + 0.25 * covariance[GAP, GAP]
    variance_z, across = covariance[ROOT, ROOT], 0.5 * covariance[GAP, ROOT]
    if p[GAP] < CLOSED_MM:
        # The root is where the bevel meets the side, and goes up and down with that.
        gives_way, variance_y = 0.0, wall_variance + 0.25 * covariance[GAP, GAP]
        variance_z, across = variance_z + wall_variance / p[TAN] ** 2, across + wall_variance / p[TAN]
    bevel, bevel_sigma = math.atan(p[TAN]), math.sqrt(covariance[TAN, TAN]) / (1.0 + p[TAN] ** 2)
    plates, plate_sigmas = angles_of(fit, SLOPE_LEFT, SLOPE_RIGHT)
    area, area_sigma = opening_of(HALF_GROOVE, fit, (wall,))
    # The upright side takes the root's gap with it, or of a closed root its foot on the bevel.
    with_side = gives_way if p[GAP] >= CLOSED_MM else 1.0
    area_sigma = math.hypot(area_sigma, with_side * p[DEPTH_RIGHT] * math.sqrt(wall_variance))
    shape = JointShape(
        math.sqrt(covariance[GAP, GAP] + gives_way**2 * wall_variance),
        math.sqrt(
            covariance[DEPTH_LEFT, DEPTH_LEFT]
            + covariance[DEPTH_RIGHT, DEPTH_RIGHT]
            - 2.0 * covariance[DEPTH_LEFT, DEPTH_RIGHT]
        ),
        (math.degrees(bevel), math.nan),
        (math.degrees(bevel_sigma), math.nan),
        plates,
        plate_sigmas,
        area,
        area_sigma,
    )
    return MeasuredJoint(
        float(y_s),
        float(p[ROOT]),
        np.array([[variance_y, across], [across, variance_z]]),
        float(max(p[GAP], 0.0)),
        float(p[DEPTH_LEFT] - p[DEPTH_RIGHT]),
        fit.chi2,
        shape,
        left_out,
        section_of(HALF_GROOVE, fit, (wall,)),
    )
