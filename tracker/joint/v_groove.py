"""The V-groove: two plates, two bevels and a root; the seam point is the middle of the root."""

from __future__ import annotations

import numpy as np

from noise_model.frames import Float64
from noise_model.surface import Joint, section
from tracker.joint.measured import MeasuredJoint, fit_shape, place_by_template
from tracker.profile import Profile

SEARCH_STEP_MM = 0.2
PRIOR_SIGMA = np.array([5.0, 5.0, 0.3, 0.04, 0.04, 0.3, 0.3, 0.03, 0.03])
"""1 sigma of y, z, gap, both tan(bevel), both depths (mm), both plate slopes: how far an edge may be off."""


def groove_height(parameters: Float64, y: Float64) -> Float64:
    """Return the height z (n,) of a groove over y (n,), mm.

    Parameters: root middle y and z, root gap, tan of the left and right bevel angle, left and right depth,
    slopes of the left and right plate.
    """
    y_s, z_s, gap, tan_left, tan_right, depth_left, depth_right, slope_left, slope_right = parameters
    left = y >= y_s
    outward = np.abs(y - y_s)
    tan, depth = np.where(left, tan_left, tan_right), np.where(left, depth_left, depth_right)
    slope = np.where(left, slope_left, -slope_right)
    shoulder = 0.5 * gap + depth * tan
    wall = np.maximum(outward - 0.5 * gap, 0.0) / tan
    return np.asarray(z_s + np.where(outward < shoulder, wall, depth + slope * (outward - shoulder)))


def fit_v_groove(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the groove that a profile shows, or None where too little of it lies within the bevels."""
    size = joint.dimensions
    vertices = section(joint).vertices
    depth, gap = size["depth_mm"], size["root_gap_mm"]
    tan = float(np.tan(np.radians(size["included_angle_deg"] / 2.0)))

    def nominal(y: Float64) -> Float64:
        return np.interp(y, vertices[:, 0], vertices[:, 1] + depth)

    y_0, z_0 = place_by_template(profile, nominal, SEARCH_STEP_MM, 0.25 * depth)
    start = np.array([y_0, z_0, gap, tan, tan, depth, depth, 0.0, 0.0])
    shape = fit_shape(profile, groove_height, start, PRIOR_SIGMA)
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
        y_s, z_s, shape.covariance[:2, :2], max(gap_mm, 0.0), depth_left - depth_right, shape.chi2
    )
