"""The V-groove: two plates, two bevels and a root; the seam point is the middle of the root."""

from __future__ import annotations

import numpy as np

from noise_model.surface import Joint, section
from tracker.joint.measured import MeasuredJoint, fit_shape, place
from tracker.joint.section_fit import GROOVE
from tracker.profile import Profile

SEARCH_STEP_MM = 0.2
PRIOR_SIGMA = np.array([5.0, 5.0, 0.3, 0.04, 0.04, 0.3, 0.3, 0.03, 0.03])
"""1 sigma of y, z, gap, both tan(bevel), both depths (mm), both plate slopes: how far an edge may be off."""


def fit_v_groove(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the groove that a profile shows, or None where too little of it lies within the bevels."""
    size = joint.dimensions
    depth, gap = size["depth_mm"], size["root_gap_mm"]
    tan = float(np.tan(np.radians(size["included_angle_deg"] / 2.0)))
    corners = section(joint).vertices + np.array([0.0, depth])
    y_0, z_0 = place(profile, corners, SEARCH_STEP_MM, 0.25 * depth)
    start = np.array([y_0, z_0, gap, tan, tan, depth, depth, 0.0, 0.0])
    shape = fit_shape(profile, GROOVE, start, PRIOR_SIGMA)
    if shape is None:
        return None
    y_s, z_s, gap_mm, _, _, depth_left, depth_right, _, _ = (float(p) for p in shape.parameters)
    half_mouth = 0.5 * gap + depth * tan
    inside = np.abs(profile.y_mm - y_s) < half_mouth
    if (
        shape.weights[inside & (profile.y_mm > y_s)].sum() < 5.0
        or shape.weights[inside & (profile.y_mm < y_s)].sum() < 5.0
    ):
        return None
    return MeasuredJoint(
        y_s, z_s, shape.covariance[:2, :2], max(gap_mm, 0.0), depth_left - depth_right, shape.chi2, shape
    )
