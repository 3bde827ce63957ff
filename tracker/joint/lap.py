"""The lap, plain or corrugated: the upper sheet's edge over the lower sheet; the seam point is its foot."""

from __future__ import annotations

import math

import numpy as np

from noise_model.frames import Float64
from noise_model.surface import Joint, section
from tracker.joint.measured import (
    OFF_SIGMAS,
    JointShape,
    MeasuredJoint,
    angles_of,
    fit_shape,
    off_line,
    place,
    section_of,
)
from tracker.joint.section_shapes import SHEETS
from tracker.joint.upright_edge import hidden_strip, neighbours_of_edge
from tracker.profile import Profile

SEARCH_STEP_MM = 0.1
CLEAR_OF_EDGE_MM = 0.4
"""Points nearer to the edge than this may belong to either sheet and wait for the sheets' lines."""

PRIOR_SIGMA = np.array([5.0, 0.5, 0.03, 0.03])
"""1 sigma of the lower sheet's height, the step (mm), both sheets' slopes."""


def fit_lap(profile: Profile, joint: Joint, camera_mm: Float64, laser_mm: Float64) -> MeasuredJoint | None:
    """Return the lap that a profile shows, or None where one of its sheets is not seen beside the edge.

    The sheets' lines are fitted clear of the edge; then each point near it belongs to the line it lies on,
    and the edge lies between the last point of the upper and the first of the lower sheet, less what it
    hides of that one. `camera_mm` and `laser_mm` (3,) say from where, joint frame.
    """
    thickness = joint.dimensions["thickness_mm"]
    y_0, z_0 = place(profile, section(joint).vertices, SEARCH_STEP_MM, 0.25 * thickness)
    clear = np.abs(profile.y_mm - y_0) > CLEAR_OF_EDGE_MM
    upper, lower = clear & (profile.y_mm < y_0), clear & (profile.y_mm > y_0)
    if upper.sum() < 10 or lower.sum() < 10:
        return None
    shape = fit_shape(profile, SHEETS, np.array([z_0, thickness, 0.0, 0.0, y_0]), PRIOR_SIGMA, clear)
    if shape is None:
        return None
    z_s, step, slope_lower, slope_upper = (float(p) for p in shape.parameters)
    y = profile.y_mm - y_0
    over_lower = profile.z_mm - (z_s + slope_lower * y)
    over_upper = profile.z_mm - (z_s + step + slope_upper * y)
    near = np.abs(y) < 5.0 * CLEAR_OF_EDGE_MM
    on_upper = near & (np.abs(over_upper) < 0.25 * step)
    on_lower = near & (np.abs(over_lower) < 0.25 * step)
    beside = neighbours_of_edge(profile.y_mm, on_upper, on_lower)
    if beside is None:
        return None
    # The upper sheet is seen up to its edge; of the lower one the edge may hide a strip from camera or laser.
    hidden = max(hidden_strip(source, y_0, z_s + step, step) for source in (camera_mm, laser_mm))
    last_upper, first_lower = beside[0], beside[1] - hidden
    edge = 0.5 * (last_upper + first_lower)
    spread = max(abs(first_lower - last_upper), profile.column_mm)
    z_edge = z_s + slope_lower * (edge - y_0)
    at_edge = np.array([1.0, 0.0, edge - y_0, 0.0])
    covariance = np.diag([spread**2 / 12.0, float(at_edge @ shape.covariance @ at_edge)])
    over = np.where(profile.y_mm < edge, z_s + step + slope_upper * y, z_s + slope_lower * y)
    left_out = float(np.mean(np.abs(off_line(profile, over))[near] > OFF_SIGMAS))
    plates, plate_sigmas = angles_of(shape, 2, 3)
    step += (slope_upper - slope_lower) * (edge - y_0)
    of_step = np.array([0.0, 1.0, y_0 - edge, edge - y_0])
    step_sigma = math.sqrt(of_step @ shape.covariance @ of_step)
    return MeasuredJoint(
        edge,
        z_edge,
        covariance,
        max(step - thickness, 0.0),
        -step,
        shape.chi2,
        JointShape(step_sigma, step_sigma, plate_angles_deg=plates, plate_sigmas_deg=plate_sigmas),
        left_out,
        section_of(SHEETS, shape, (edge,)),
    )
