"""The half V: an upright side at smaller y, a bevel opposite; the seam point is the middle of the root."""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.compiled.kernel import kernel
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.common_mode import as_reported
from tracker.joint.groove import weigh_root
from tracker.joint.measured import (
    START_SIGMA_MM,
    SURE_MM,
    SURE_SIGMAS,
    MeasuredJoint,
    fit_points,
    opening_area,
    section_corners,
    shift_of,
    two_angles,
)
from tracker.joint.misfit import SeamEdge
from tracker.joint.section_fit import ShapeFit
from tracker.joint.section_shapes import HALF_GROOVE
from tracker.joint.upright_edge import (
    Faces,
    edge_between,
    edge_covariance,
    hidden_strip,
    no_faces,
    points_around_edge,
)
from tracker.profile import Section, in_scan_order
from tracker.state import DZ_MM, SIGMA_PX, Y_MM, Z_MM, JointShape

SEARCH_STEP_MM = 0.1
CLEAR_OF_EDGE_MM = 0.3
"""Points nearer to the upright side than this wait until it is found."""

ON_FACE_SIGMAS = 2.0
"""A point next to the upright side that lies farther off a face may hold light of both.

One in twenty of a face's own points does, and is outvoted by its neighbours.
"""

BENT_MM = 0.2
"""Largest departure of a face from its straight line next to the upright side."""

GAP, ROOT, TAN, DEPTH_LEFT, DEPTH_RIGHT, SLOPE_LEFT, SLOPE_RIGHT, WALL = range(8)
"""The parameters of a half groove; where its wall is, the last, is not fitted."""

PRIOR_SIGMA = np.array([0.3, 5.0, 0.04, 0.3, 0.3, 0.03, 0.03])
"""1 sigma of the gap, the root's height, tan(bevel), both depths (mm), both plate slopes."""

MEAN_HEIGHT = np.array([0.0, 1.0, 0.0, 0.0, 0.5, 0.0, 0.0])
"""Derivatives of the mean height of the faces at the upright side with the parameters."""

CLOSED_MM = 0.03
"""A root whose mean gap comes out narrower is most probably closed."""

MIN_POINTS = 5.0
"""The weight of the points that must be seen in the groove, and on the bevel if it is not to be bridged."""


def fit_half_v(section: Section, stated: StatedJoint) -> MeasuredJoint | None:
    """Return the half V that a section shows, None where too little lies next to its upright side.

    The faces are fitted clear of the upright side; that lies between the last point of the right plate and
    the first one in the groove, less what it hides there from camera or laser; then they are fitted once
    more.
    """
    points, y_mm, gap_mm = section.points, section.points[Y_MM], stated.gap_mm
    start = start_of(section, stated)
    clear = np.abs(y_mm - start[WALL]) > CLEAR_OF_EDGE_MM
    fit = fit_points(HALF_GROOVE, points, clear, START_SIGMA_MM, PRIOR_SIGMA, start)
    if not math.isfinite(fit.chi2):
        return None
    wall_mm, wall_variance_mm2 = upright_side(
        section, stated.depth_mm, fit.parameters, fit.covariance, start, clear
    )
    if math.isnan(wall_mm):
        return None
    start[WALL] = wall_mm
    fit = fit_points(HALF_GROOVE, points, clear, START_SIGMA_MM, PRIOR_SIGMA, start)
    if not math.isfinite(fit.chi2):
        return None
    p = fit.parameters
    foot_mm, mouth_mm = wall_mm + max(float(p[GAP]), 0.0), float(wall_mm + p[GAP] + p[DEPTH_LEFT] * p[TAN])
    if weight_between(y_mm, fit.weights, foot_mm, mouth_mm) >= MIN_POINTS:
        away = clear & (np.abs(y_mm - 0.5 * (wall_mm + foot_mm)) >= section.mixed_mm)
        fit = weigh_root(HALF_GROOVE, points, away, start, PRIOR_SIGMA, GAP, fit)
    else:
        # A bevel that is not seen is bridged by its priors, in the covariance too; where the root ends is not
        # known, and what lies there counts for nothing.
        sure_mm = wall_mm + max(gap_mm - SURE_SIGMAS * PRIOR_SIGMA[GAP], 0.0)
        clear &= (y_mm < sure_mm) | (y_mm > mouth_mm + SURE_MM)
        fit = fit_points(HALF_GROOVE, points, clear, START_SIGMA_MM, PRIOR_SIGMA, start)
        if not math.isfinite(fit.chi2):
            return None
    if weight_between(y_mm, fit.weights, wall_mm, mouth_mm) < MIN_POINTS:
        return None
    measured, wall = measured_half_v(fit, wall_mm, wall_variance_mm2)
    return as_reported(section, measured, (wall,))


def start_of(section: Section, stated: StatedJoint) -> Float64:
    """Return the parameters of a stated half groove where most of a section's points lie on it."""
    y_mm, z_mm, depth = section.points[Y_MM], section.points[Z_MM], stated.depth_mm
    y_0, z_0 = shift_of(y_mm, z_mm, section.reach_mm, stated.corners_mm, depth, SEARCH_STEP_MM, 0.25 * depth)
    gap_mm = stated.gap_mm
    return np.array([gap_mm, z_0, stated.tan, depth, depth, 0.0, 0.0, y_0 - 0.5 * gap_mm])


@kernel(allocates=True)
def upright_side(
    section: Section, depth_mm: float, p: Float64, covariance: Float64, start: Float64, clear: Bool
) -> tuple[float, float]:
    """Return the place of fitted faces' upright side, mm, and its variance, mm^2; NaN where it is hidden.

    `p` and `covariance` are the fit's from a start. `clear` (n,) gets which points surely lie on one face
    beside it.
    """
    lines, y_mm = in_scan_order(section.points), section.points[Y_MM]
    wall_mm, n = start[WALL], y_mm.shape[0]
    faces, limits_mm = faces_at(lines[Y_MM], p, wall_mm), np.empty(n)
    for i in range(n):
        # Faces may bend next to the upright side.
        sure_mm = math.hypot(BENT_MM, ON_FACE_SIGMAS * abs(lines[DZ_MM, i]) * lines[SIGMA_PX, i])
        is_near = abs(lines[Y_MM, i] - wall_mm) < 5.0 * CLEAR_OF_EDGE_MM
        limits_mm[i] = min(0.25 * p[DEPTH_RIGHT], sure_mm) if is_near else 0.0
    before, behind = points_around_edge(lines, faces, limits_mm)
    if before < 0:
        return math.nan, math.nan
    sources_mm = section.camera_mm, section.laser_mm
    hidden = hidden_strip(sources_mm, wall_mm, start[ROOT] + depth_mm, depth_mm, section.slope_sigma)
    edge = edge_between(
        lines,
        faces,
        limits_mm,
        bent_mm=BENT_MM,
        column_mm=section.column_mm,
        light=section.light,
        before=before,
        behind=behind,
        hidden=hidden,
        is_profile=section.n_columns > 0,
    )
    # What lies between may be either side's, and the first lines in the groove hold light of the plate too.
    for i in range(n):
        clear[i] = y_mm[i] <= lines[Y_MM, before] or y_mm[i] >= lines[Y_MM, behind] + section.mixed_mm
    mean_height = MEAN_HEIGHT.copy()
    return edge.y_mm, edge_covariance(edge, mean_height, mean_height, covariance)[0, 0]


@kernel(allocates=True)
def faces_at(y_mm: Float64, p: Float64, wall_mm: float) -> Faces:
    """Return the faces next to an upright side, carried on to places (n,): right plate and groove."""
    faces = no_faces(y_mm.shape[0])
    for i in range(y_mm.shape[0]):
        y = y_mm[i] - wall_mm
        faces.before_mm[i] = p[ROOT] + (p[DEPTH_RIGHT] + p[SLOPE_RIGHT] * y)
        faces.before_slope[i] = p[SLOPE_RIGHT]
        faces.behind_mm[i] = p[ROOT] + max(y - p[GAP], 0.0) / p[TAN]
        faces.behind_slope[i] = 1.0 / p[TAN] if y > p[GAP] else 0.0
    return faces


def weight_between(y_mm: Float64, weights: Float64, first_mm: float, last_mm: float) -> float:
    """Return the weight of the points (n,) between two places."""
    return float(weights[(y_mm > first_mm) & (y_mm < last_mm)].sum())


def measured_half_v(fit: ShapeFit, wall: float, wall_variance: float) -> tuple[MeasuredJoint, SeamEdge]:
    """Return the joint of a fit next to a given upright side, the side's own variance put in, and the side.

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
    plates, plate_sigmas = two_angles(p, covariance, SLOPE_LEFT, SLOPE_RIGHT)
    whole = np.append(p, wall)
    area, area_sigma = opening_area(HALF_GROOVE, whole, covariance)
    # The upright side takes the root's gap with it, or of a closed root its foot on the bevel.
    with_side = gives_way if p[GAP] >= CLOSED_MM else 1.0
    mismatch_variance = (
        covariance[DEPTH_LEFT, DEPTH_LEFT]
        + covariance[DEPTH_RIGHT, DEPTH_RIGHT]
        - 2.0 * covariance[DEPTH_LEFT, DEPTH_RIGHT]
    )
    shape = JointShape(
        gap_sigma_mm=math.sqrt(covariance[GAP, GAP] + gives_way**2 * wall_variance),
        mismatch_sigma_mm=math.sqrt(mismatch_variance),
        bevel_angles_deg=(math.degrees(bevel), math.nan),
        bevel_sigmas_deg=(math.degrees(bevel_sigma), math.nan),
        plate_angles_deg=plates,
        plate_sigmas_deg=plate_sigmas,
        area_mm2=area,
        area_sigma_mm2=math.hypot(area_sigma, with_side * p[DEPTH_RIGHT] * math.sqrt(wall_variance)),
    )
    by_y = 1.0 - 0.5 * gives_way
    by_z = 0.0 if p[GAP] >= CLOSED_MM else 1.0 / float(p[TAN])
    measured = MeasuredJoint(
        y_mm=float(y_s),
        z_mm=float(p[ROOT]),
        covariance_mm2=np.array([[variance_y, across], [across, variance_z]]),
        gap_mm=max(float(p[GAP]), 0.0),
        mismatch_mm=float(p[DEPTH_LEFT] - p[DEPTH_RIGHT]),
        chi2=fit.chi2,
        shape=shape,
        corners_mm=section_corners(HALF_GROOVE, whole),
    )
    return measured, SeamEdge(wall, by_y, by_z, gives_way)
