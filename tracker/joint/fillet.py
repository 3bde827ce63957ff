"""The fillet, inside or outside corner: two plates that meet in the seam point."""

from __future__ import annotations

import math

import numpy as np

from noise_model.kernel import kernel
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.complete import completed
from tracker.joint.measured import (
    START_SIGMA_MM,
    MeasuredJoint,
    fit_points,
    share_left_out,
    shift_of,
    two_angles,
    undetermined,
)
from tracker.joint.section_shapes import CORNER, N_CORNERS, corners_of
from tracker.profile import Section
from tracker.state import Y_MM, Z_MM, JointShape

SEARCH_STEP_MM = 0.2
SEARCH_LIMIT_MM = 1.0
PLATE_SIGMA_DEG = 2.0
"""How far a plate may be turned from where it is stated to stand."""

MAX_TURNED_SIGMAS = 5.0
"""Plates that are turned by more are not this corner's."""

BESIDE_MM = 2.0
"""So near to the corner the points must lie on the plates."""

MIN_POINTS = 10.0
"""The weight of the points that must be seen of either plate."""


@kernel(allocates=True)
def fit_fillet(section: Section, stated: StatedJoint) -> MeasuredJoint:
    """Return the corner that a section shows, not determined where it does not show both plates."""
    points, y_mm = section.points, section.points[Y_MM]
    y_0, z_0 = shift_of(
        y_mm, points[Z_MM], section.reach_mm, stated.corners_mm, 0.0, SEARCH_STEP_MM, SEARCH_LIMIT_MM
    )
    slope = 1.0 / stated.tan
    plate_sigma = math.radians(PLATE_SIGMA_DEG) * (1.0 + slope**2)
    start, prior_sigma = np.empty(4), np.empty(4)
    start[0], start[1], start[2], start[3] = y_0, z_0, slope, -slope
    prior_sigma[0], prior_sigma[1], prior_sigma[2], prior_sigma[3] = 5.0, 5.0, plate_sigma, plate_sigma
    chosen = np.ones(y_mm.shape[0], np.bool_)
    fit = fit_points(CORNER, points, chosen, START_SIGMA_MM, prior_sigma, start)
    if not math.isfinite(fit.chi2):
        return undetermined()
    p, covariance = fit.parameters, fit.covariance
    right, left = 0.0, 0.0
    for i in range(y_mm.shape[0]):
        if y_mm[i] > p[0]:
            left += fit.weights[i]
        else:
            right += fit.weights[i]
    turned = max(abs(p[2] - start[2]), abs(p[3] - start[3])) / plate_sigma
    if turned > MAX_TURNED_SIGMAS or min(left, right) < MIN_POINTS:
        return undetermined()
    corners_mm, unknown = np.empty((N_CORNERS[CORNER], 2)), (math.nan, math.nan)
    corners_of(CORNER, p, corners_mm)
    plates, plate_sigmas = two_angles(p, covariance, 2, 3)
    measured = MeasuredJoint(
        y_mm=p[0],
        z_mm=p[1],
        covariance_mm2=covariance[:2, :2].copy(),
        gap_mm=math.nan,
        mismatch_mm=math.nan,
        chi2=fit.chi2,
        shape=JointShape(
            gap_sigma_mm=math.nan,
            mismatch_sigma_mm=math.nan,
            bevel_angles_deg=unknown,
            bevel_sigmas_deg=unknown,
            plate_angles_deg=plates,
            plate_sigmas_deg=plate_sigmas,
            area_mm2=math.nan,
            area_sigma_mm2=math.nan,
        ),
        unexplained=share_left_out(y_mm, fit.weights, chosen, p[0], BESIDE_MM),
        corners_mm=corners_mm,
        evidence_nats=math.nan,
    )
    return completed(section, measured)
