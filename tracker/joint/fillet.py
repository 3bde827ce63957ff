"""The fillet, inside or outside corner: two plates that meet in the seam point."""

from __future__ import annotations

import math

import numpy as np

from noise_model.surface.joint import Joint, section
from tracker.joint.measured import MeasuredJoint, angles_of, fit_shape, place, section_of, unexplained
from tracker.joint.section_shapes import CORNER
from tracker.profile import Profile
from tracker.state import JointShape

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


def fit_fillet(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the corner that a profile shows, or None where it does not show both plates."""
    y_0, z_0 = place(profile, section(joint).vertices, SEARCH_STEP_MM, SEARCH_LIMIT_MM)
    slope = 1.0 / math.tan(math.radians(joint.dimensions["included_angle_deg"] / 2.0))
    plate_sigma = math.radians(PLATE_SIGMA_DEG) * (1.0 + slope**2)
    start = np.array([y_0, z_0, slope, -slope])
    fit = fit_shape(profile, CORNER, start, np.array([5.0, 5.0, plate_sigma, plate_sigma]))
    if fit is None:
        return None
    y_s, z_s = float(fit.parameters[0]), float(fit.parameters[1])
    left_out = unexplained(profile, fit, y_s, BESIDE_MM, np.ones(len(profile.y_mm), dtype=bool))
    on_left = profile.y_mm > y_s
    turned = np.abs(fit.parameters[2:] - start[2:]).max() / plate_sigma
    if (
        turned > MAX_TURNED_SIGMAS
        or min(fit.weights[on_left].sum(), fit.weights[~on_left].sum()) < MIN_POINTS
    ):
        return None
    plates, plate_sigmas = angles_of(fit, 2, 3)
    shape = JointShape(plate_angles_deg=plates, plate_sigmas_deg=plate_sigmas)
    return MeasuredJoint(
        y_s,
        z_s,
        fit.covariance[:2, :2].copy(),
        math.nan,
        math.nan,
        fit.chi2,
        shape,
        left_out,
        section_of(CORNER, fit),
    )
