"""The lap, plain or corrugated: the upper sheet's edge over the lower sheet; the seam point is its foot."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float64
from noise_model.kernel import kernel
from noise_model.median import median_of, numbers_for
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.complete import completed
from tracker.joint.measured import (
    OFF_SIGMAS,
    SIGMA_FLOOR_PX,
    START_SIGMA_MM,
    MeasuredJoint,
    ShapeFit,
    fit_points,
    shift_of,
    two_angles,
    undetermined,
)
from tracker.joint.section_shapes import N_CORNERS, SHEETS, corners_of
from tracker.joint.upright_edge import (
    Edge,
    Faces,
    edge_between,
    edge_covariance,
    hidden_strip,
    no_faces,
    points_beside,
)
from tracker.profile import Section, in_scan_order
from tracker.state import DZ_MM, SIGMA_PX, Y_MM, Z_MM, JointShape

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


@kernel(allocates=True)
def fit_lap(section: Section, stated: StatedJoint) -> MeasuredJoint:
    """Return the lap that a section shows, not determined where a sheet is not seen beside the edge.

    The sheets' lines are fitted clear of the edge; then each point near it belongs to the line it lies on,
    and the edge lies between the last point of the upper and the first of the lower sheet, less what it
    hides of that one (`upright_edge`).
    """
    # A copy of its own has one type: for a constant the kernels would be compiled anew.
    prior_sigma = PRIOR_SIGMA.copy()
    y_0, fit = fit_sheets(
        section.points, section.reach_mm, stated.corners_mm, stated.thickness_mm, prior_sigma
    )
    if not math.isfinite(fit.chi2):
        return undetermined()
    measured = measured_lap(section, in_scan_order(section.points), fit, y_0, stated.thickness_mm)
    return undetermined() if math.isnan(measured.y_mm) else completed(section, measured)


@kernel(allocates=True)
def fit_sheets(
    points: Float64, reach_mm: float, corners: Float64, thickness_mm: float, prior_sigma: Float64
) -> tuple[float, ShapeFit]:
    """Place a lap amid a profile's points and fit its sheets' lines clear of the edge.

    Returned are where it was placed and the fit, whose chi2 is NaN where it cannot be.
    """
    roll, y_0, z_level = placed(points[Y_MM], points[Z_MM], reach_mm, corners, 0.25 * thickness_mm)
    clear, start = np.empty(points[Y_MM].shape[0], np.bool_), np.empty(prior_sigma.shape[0] + 1)
    start[0], start[1], start[2], start[3], start[4] = z_level + roll * y_0, thickness_mm, roll, roll, y_0
    before, behind = clear_of_edge(points[Y_MM], y_0, clear)
    if min(before, behind) < MIN_POINTS:
        return y_0, ShapeFit(start[:-1], np.empty((0, 0)), math.nan, np.empty(0))
    return y_0, fit_points(SHEETS, points, clear, START_SIGMA_MM, prior_sigma, start)


@kernel(allocates=True)
def measured_lap(
    section: Section, lines: Float64, fit: ShapeFit, y_0: float, thickness_mm: float
) -> MeasuredJoint:
    """Return the lap of sheets that were fitted, its y NaN where they are not seen beside their edge.

    `lines` (n,) are in order of their scan lines, `y_0` is where the edge was while they were fitted.
    """
    p, covariance = fit.parameters, fit.covariance
    z_s, step, slope_lower, slope_upper = p[0], p[1], p[2], p[3]
    sheets = Sheets(y_0, z_s, step, slope_lower, slope_upper)
    upright = edge_of_sheets(section, lines, sheets, thickness_mm)
    edge, beside = upright.y_mm, upright.y_mm - y_0
    z_edge = z_s + slope_lower * beside
    between, at_edge, of_step = np.empty(4), np.empty(4), np.empty(4)
    between[0], between[1], between[2], between[3] = 1.0, 0.5, 0.5 * beside, 0.5 * beside
    at_edge[0], at_edge[1], at_edge[2], at_edge[3] = 1.0, 0.0, beside, 0.0
    of_step[0], of_step[1], of_step[2], of_step[3] = 0.0, 1.0, -beside, beside
    variance = 0.0
    for j in range(4):
        with_step = 0.0
        for i in range(4):
            with_step += of_step[i] * covariance[i, j]
        variance += with_step * of_step[j]
    step += (slope_upper - slope_lower) * beside
    foot, corners_mm = np.empty(5), np.empty((N_CORNERS[SHEETS], 2))
    foot[0], foot[1], foot[2], foot[3], foot[4] = z_edge, step, slope_lower, slope_upper, edge
    corners_of(SHEETS, foot, corners_mm)
    step_sigma, unknown = math.sqrt(variance), (math.nan, math.nan)
    plates, plate_sigmas = two_angles(p, covariance, 2, 3)
    return MeasuredJoint(
        y_mm=edge,
        z_mm=z_edge,
        covariance_mm2=edge_covariance(upright, between, at_edge, covariance),
        gap_mm=max(step - thickness_mm, 0.0),
        mismatch_mm=-step,
        chi2=fit.chi2,
        shape=JointShape(
            gap_sigma_mm=step_sigma,
            mismatch_sigma_mm=step_sigma,
            bevel_angles_deg=unknown,
            bevel_sigmas_deg=unknown,
            plate_angles_deg=plates,
            plate_sigmas_deg=plate_sigmas,
            area_mm2=math.nan,
            area_sigma_mm2=math.nan,
        ),
        unexplained=share_off(lines[Y_MM], lines[Z_MM], lines[DZ_MM], lines[SIGMA_PX], sheets, edge),
        corners_mm=corners_mm,
        evidence_nats=math.nan,
    )


@kernel(allocates=True)
def edge_of_sheets(section: Section, lines: Float64, sheets: Sheets, thickness_mm: float) -> Edge:
    """Return where the sheets' edge is, NaN where points (n,) do not lie on both beside it."""
    n, nowhere = lines[Y_MM].shape[0], Edge(math.nan, math.nan, math.nan)
    bent_mm, limits_mm = MIN_OFF_SHEET * thickness_mm, np.empty(n)
    for i in range(n):
        off_mm = min(OFF_SIGMAS * abs(lines[DZ_MM, i]) * lines[SIGMA_PX, i], ON_SHEET * thickness_mm)
        limits_mm[i] = max(bent_mm, off_mm) if abs(lines[Y_MM, i] - sheets.y) < NEAR_MM else 0.0
    faces = sheets_at(lines[Y_MM], sheets)
    before, behind = points_beside(lines, faces, limits_mm)
    if before < 0:
        return nowhere
    # The upper sheet is seen up to its edge; of the lower one the edge may hide a strip from camera or laser.
    sources_mm = section.camera_mm, section.laser_mm
    hidden = hidden_strip(sources_mm, sheets.y, sheets.z + sheets.step, sheets.step, section.slope_sigma)
    # Glare or spatter over all of the points near it: between those beyond, an edge may be anywhere.
    if lines[Y_MM, behind] - hidden.width_mm - lines[Y_MM, before] > 2.0 * CLEAR_OF_EDGE_MM:
        return nowhere
    edge: Edge = edge_between(
        lines, faces, limits_mm, bent_mm, section.column_mm, section.light, before, behind, hidden
    )
    return edge


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


@kernel(allocates=True)
def sheets_at(y_mm: Float64, sheets: Sheets) -> Faces:
    """Return both sheets carried on to places (n,): the upper one before the edge, the lower one behind."""
    faces = no_faces(y_mm.shape[0])
    for i in range(y_mm.shape[0]):
        y = y_mm[i] - sheets.y
        faces.before_mm[i], faces.before_slope[i] = (
            sheets.z + sheets.step + sheets.slope_upper * y,
            sheets.slope_upper,
        )
        faces.behind_mm[i], faces.behind_slope[i] = sheets.z + sheets.slope_lower * y, sheets.slope_lower
    return faces


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
