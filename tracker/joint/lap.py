"""The lap, plain or corrugated: the upper sheet's edge over the lower sheet; the seam point is its foot."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float64
from noise_model.kernel import kernel
from noise_model.median import median, median_of, numbers_for
from noise_model.surface.joint import Joint, section
from tracker.joint.measured import (
    OFF_SIGMAS,
    SIGMA_FLOOR_PX,
    MeasuredJoint,
    OnFace,
    angles_of,
    fit_shape,
    section_of,
    shift_of,
)
from tracker.joint.section_fit import MIN_ALONG_MM
from tracker.joint.section_shapes import SHEETS
from tracker.joint.upright_edge import edge_between, hidden_strip, neighbours_of_edge
from tracker.profile import Profile
from tracker.state import JointShape

SEARCH_STEP_MM = 0.1
CLEAR_OF_EDGE_MM = 0.4
"""Points nearer to the edge than this may belong to either sheet and wait for the sheets' lines."""

ROLL_BY = 8
"""Points an eighth of a profile apart tell how it is rolled: few such pairs have the edge between them."""

MIN_POINTS = 10
"""So many points of either sheet must be seen clear of the edge."""

NEAR_MM, ON_SHEET, MIN_OFF_SHEET = 2.0, 0.25, 0.03
"""Points so near to the edge are asked which sheet they lie on: off it by their noise, but by no more than
this share of the step; and by this share at least, for no sheet is flat."""

PRIOR_SIGMA = np.array([5.0, 0.5, 0.03, 0.03])
"""1 sigma of the lower sheet's height, the step (mm), both sheets' slopes beside the profile's own."""


def fit_lap(profile: Profile, joint: Joint, camera_mm: Float64, laser_mm: Float64) -> MeasuredJoint | None:
    """Return the lap that a profile shows, or None where a sheet is not seen beside the edge, or near to it.

    The sheets' lines are fitted clear of the edge; then each point near it belongs to the line it lies on,
    and the edge lies between the last point of the upper and the first of the lower sheet, less what it
    hides of that one (`edge_between`). `camera_mm` and `laser_mm` (3,) say from where, joint frame.
    """
    thickness = joint.dimensions["thickness_mm"]
    roll, y_0, z_level = placed(
        profile.y_mm, profile.z_mm, profile.reach_mm, section(joint).vertices, 0.25 * thickness
    )
    clear, on_upper, on_lower = np.empty((3, len(profile.y_mm)), dtype=np.bool_)
    if min(clear_of_edge(profile.y_mm, y_0, clear)) < MIN_POINTS:
        return None
    start = np.array([z_level + roll * y_0, thickness, roll, roll, y_0])
    shape = fit_shape(profile, SHEETS, start, PRIOR_SIGMA, clear)
    if shape is None:
        return None
    z_s, step, slope_lower, slope_upper = shape.parameters.tolist()
    sheets = Sheets(y_0, z_s, step, slope_lower, slope_upper)
    lines = profile.by_scan()
    off_mm = OFF_SIGMAS * median(np.abs(profile.dz_mm) * profile.sigma_px)
    limit_mm = max(MIN_OFF_SHEET * thickness, min(off_mm, ON_SHEET * thickness))
    near_sheets(lines.y_mm, lines.z_mm, sheets, limit_mm, on_upper, on_lower)
    before, behind = neighbours_of_edge(on_upper, on_lower)
    if before < 0:
        return None
    # The upper sheet is seen up to its edge; of the lower one the edge may hide a strip from camera or laser.
    hidden = hidden_strip((camera_mm, laser_mm), y_0, z_s + step, step, profile.slope_sigma)
    # Glare or spatter over all of the points near it: between those beyond, an edge may be anywhere.
    if lines.y_mm[behind] - hidden.width_mm - lines.y_mm[before] > 2.0 * CLEAR_OF_EDGE_MM:
        return None
    upright = edge_between(lines, before, behind, hidden, sheets.met_by(lines, before))
    edge = upright.y_mm
    z_edge = z_s + slope_lower * (edge - y_0)
    between = np.array([1.0, 0.5, 0.5 * (edge - y_0), 0.5 * (edge - y_0)])
    at_edge = np.array([1.0, 0.0, edge - y_0, 0.0])
    covariance = upright.covariance(between, at_edge, shape.covariance)
    left_out = share_off(profile.y_mm, profile.z_mm, profile.dz_mm, profile.sigma_px, sheets, edge)
    plates, plate_sigmas = angles_of(shape, 2, 3)
    step += (slope_upper - slope_lower) * (edge - y_0)
    of_step = np.array([0.0, 1.0, y_0 - edge, edge - y_0])
    step_sigma = math.sqrt(of_step @ shape.covariance @ of_step)
    at_foot = np.array([z_edge, step, slope_lower, slope_upper])
    return MeasuredJoint(
        edge,
        z_edge,
        covariance,
        max(step - thickness, 0.0),
        -step,
        shape.chi2,
        JointShape(step_sigma, step_sigma, plate_angles_deg=plates, plate_sigmas_deg=plate_sigmas),
        left_out,
        section_of(SHEETS, shape._replace(parameters=at_foot), (edge,)),
    )


@kernel(allocates=True)
def placed(
    y_mm: Float64, z_mm: Float64, reach_mm: float, corners: Float64, limit_mm: float
) -> tuple[float, float, float]:
    """Return how a profile's points (n,) are rolled, a slope, and the nominal corners' shift (y, z), mm.

    Over a whole profile a rolled workpiece rises by more than the step. The slope that both sheets have is
    the median of that of pairs of points.
    """
    n, apart = y_mm.shape[0], y_mm.shape[0] // ROLL_BY
    slopes, level_mm = np.empty(numbers_for(n), np.float32), np.empty(n)
    for i in range(n - apart):
        slopes[i] = (z_mm[i + apart] - z_mm[i]) / (y_mm[i + apart] - y_mm[i])
    roll = median_of(slopes, n - apart)
    for i in range(n):
        level_mm[i] = z_mm[i] - roll * y_mm[i]
    y_0, z_0 = shift_of(y_mm, level_mm, reach_mm, corners, 0.0, SEARCH_STEP_MM, limit_mm)
    return roll, y_0, z_0


class Sheets(NamedTuple):
    """Two sheets' lines: the upper one before y, whose z is z + step there, and the lower one behind it."""

    y: float
    z: float
    step: float
    slope_lower: float
    slope_upper: float

    def met_by(self, profile: Profile, before: int) -> OnFace:
        """Return where points' rays meet the upper sheet, up to the point `before` the edge, or the lower."""
        return OnFace(*meet_sheets(profile.y_mm, profile.z_mm, profile.dy_mm, profile.dz_mm, self, before))


@kernel(allocates=True)
def meet_sheets(
    y_mm: Float64, z_mm: Float64, dy_mm: Float64, dz_mm: Float64, sheets: Sheets, before: int
) -> tuple[Float64, Float64]:
    """Return `OnFace`'s numbers of points (n,), on the upper sheet up to `before`, else on the lower one."""
    n = y_mm.shape[0]
    met_mm, y_per_z = np.empty(n), np.empty(n)
    for i in range(n):
        slope = sheets.slope_upper if i <= before else sheets.slope_lower
        height_mm = sheets.z + (sheets.step if i <= before else 0.0) + slope * (y_mm[i] - sheets.y)
        across = dz_mm[i] - slope * dy_mm[i]
        y_per_z[i] = dy_mm[i] / across if abs(across) > MIN_ALONG_MM else 0.0
        met_mm[i] = y_mm[i] - y_per_z[i] * (z_mm[i] - height_mm)
    return met_mm, y_per_z


@kernel
def clear_of_edge(y_mm: Float64, edge_mm: float, clear: Bool) -> tuple[int, int]:
    """Say of each point (n,) whether it lies clear of an edge; return how many do before and behind it."""
    before, behind = 0, 0
    for i in range(y_mm.shape[0]):
        off = y_mm[i] - edge_mm
        clear[i] = abs(off) > CLEAR_OF_EDGE_MM
        before += off < -CLEAR_OF_EDGE_MM
        behind += off > CLEAR_OF_EDGE_MM
    return before, behind


@kernel
def near_sheets(
    y_mm: Float64, z_mm: Float64, sheets: Sheets, limit: float, on_upper: Bool, on_lower: Bool
) -> None:
    """Say of each point (n,) whether it lies near the edge and, within a limit, mm, on either sheet."""
    for i in range(y_mm.shape[0]):
        y = y_mm[i] - sheets.y
        over = z_mm[i] - sheets.z
        is_near = abs(y) < NEAR_MM
        on_upper[i] = is_near and abs(over - sheets.step - sheets.slope_upper * y) < limit
        on_lower[i] = is_near and abs(over - sheets.slope_lower * y) < limit


@kernel
def share_off(
    y_mm: Float64, z_mm: Float64, dz_mm: Float64, sigma_px: Float64, sheets: Sheets, edge_mm: float
) -> float:
    """Return the share of the points near the edge that lie off the sheet of their side, 1 without any.

    Off is more than OFF_SIGMAS of their own height.
    """
    near, off = 0, 0
    for i in range(y_mm.shape[0]):
        y = y_mm[i] - sheets.y
        if abs(y) >= NEAR_MM:
            continue
        on_upper = y_mm[i] < edge_mm
        line = sheets.z + (sheets.step + sheets.slope_upper * y if on_upper else sheets.slope_lower * y)
        sigma = abs(dz_mm[i]) * math.sqrt(sigma_px[i] ** 2 + SIGMA_FLOOR_PX**2)
        near += 1
        off += abs(z_mm[i] - line) > OFF_SIGMAS * sigma
    return off / near if near else 1.0
