"""The fillet, inside or outside corner: two plates that meet in the seam point."""

from __future__ import annotations

import math

import numpy as np

from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.common_mode import as_reported
from tracker.joint.measured import (
    START_SIGMA_MM,
    MeasuredJoint,
    fit_points,
    section_corners,
    share_left_out,
    shift_of,
    two_angles,
)
from tracker.joint.section_shapes import CORNER
from tracker.profile import Section
from tracker.state import Y_MM, Z_MM, JointShape

SEARCH_STEP_MM = 0.2
SEARCH_LIMIT_MM = 1.0

NEAR_CORNER_MM = 2.0
"""So near to the corner the points must lie on the plates."""

MIN_POINTS = 10.0
"""The weight of the points that must be seen of either plate."""


def fit_fillet(section: Section, stated: StatedJoint) -> MeasuredJoint | None:
    """Return the corner that a section shows, None where it does not show both plates."""
    points, y_mm = section.points, section.points[Y_MM]
    y_0, z_0 = shift_of(
        y_mm, points[Z_MM], section.reach_mm, stated.corners_mm, 0.0, SEARCH_STEP_MM, SEARCH_LIMIT_MM
    )
    slope = 1.0 / stated.tan
    # 1 sigma of a plate's rotation from where it is stated.
    plate_sigma = math.radians(2.0) * (1.0 + slope**2)
    start, prior_sigma = np.array([y_0, z_0, slope, -slope]), np.array([5.0, 5.0, plate_sigma, plate_sigma])
    chosen = np.ones(len(y_mm), np.bool_)
    fit = fit_points(CORNER, points, chosen, START_SIGMA_MM, prior_sigma, start)
    if not math.isfinite(fit.chi2):
        return None
    p, covariance, weights = fit.parameters, fit.covariance, fit.weights
    is_left = y_mm > p[0]
    turned = max(abs(p[2] - start[2]), abs(p[3] - start[3])) / plate_sigma
    # Plates that are turned by more are not this corner's.
    if turned > 5.0 or min(weights[is_left].sum(), weights[~is_left].sum()) < MIN_POINTS:
        return None
    plates, plate_sigmas = two_angles(p, covariance, 2, 3)
    measured = MeasuredJoint(
        y_mm=float(p[0]),
        z_mm=float(p[1]),
        covariance_mm2=covariance[:2, :2].copy(),
        gap_mm=math.nan,
        mismatch_mm=math.nan,
        chi2=fit.chi2,
        shape=JointShape(plate_angles_deg=plates, plate_sigmas_deg=plate_sigmas),
        unexplained=share_left_out(y_mm, weights, chosen, float(p[0]), NEAR_CORNER_MM),
        corners_mm=section_corners(CORNER, p),
    )
    return as_reported(section, measured)
