"""The lap, plain or corrugated: the upper sheet's edge over the lower sheet; the seam point is its foot."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median, median_of, numbers_for
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.common_mode import as_reported
from tracker.joint.measured import (
    OFF_SIGMAS,
    START_SIGMA_MM,
    MeasuredJoint,
    fit_points,
    section_corners,
    shift_of,
    two_angles,
)
from tracker.joint.misfit import SeamEdge
from tracker.joint.section_fit import ShapeFit
from tracker.joint.section_shapes import SHEETS
from tracker.joint.upright_edge import (
    Edge,
    Faces,
    edge_between,
    edge_covariance,
    hidden_strip,
    no_faces,
    points_around_edge,
)
from tracker.profile import Section, in_scan_order
from tracker.state import DZ_MM, SCAN, SIGMA_PX, Y_MM, Z_MM, JointShape

SEARCH_STEP_MM = 0.1
CLEAR_OF_EDGE_MM = 0.4
"""Points nearer to the edge than this may belong to either sheet and wait for the sheets' lines."""

ROLL_BY = 8
"""Points an eighth of a profile apart tell how it is rolled: few such pairs have the edge between them."""

MIN_POINTS = 10
"""Least number of points of either sheet that are seen clear of the edge."""

NEAR_MM, ON_SHEET, MIN_OFF_SHEET = 2.0, 0.25, 0.03
"""Points so near to the edge, or to the strip that it hides, are asked which sheet they lie on: off it by
their noise, but by no more than this share of the step; and by this share at least, for no sheet is flat."""

WIDEST_MM, WIDEST_IN_PROFILE_MM = 2.0 * CLEAR_OF_EDGE_MM, 4.0 * CLEAR_OF_EDGE_MM
"""An edge is lost where the points leave more open than this, and nothing narrows it to that 1 sigma.

A profile may lack as much beside any high edge: the second is a 1 sigma of 0.46 mm.
"""

MAX_SIGMAS = 3.0
"""A line this many times less sure than others fits no bell: its pixels tell more (`upright_edge`)."""

PRIOR_SIGMA = np.array([5.0, 0.5, 0.03, 0.03])
"""1 sigma of the lower sheet's height, the step (mm), both sheets' slopes relative to the profile's own."""


def fit_lap(section: Section, stated: StatedJoint) -> MeasuredJoint | None:
    """Return the lap that a section shows, None where a sheet is not seen next to the edge.

    The sheets' lines are fitted clear of the edge; then each point near it belongs to the line it lies on,
    and the edge lies between the last point of the upper and the first of the lower sheet, less what it
    hides of that one (`upright_edge`).
    """
    points, thickness_mm = section.points, stated.thickness_mm
    y_mm = points[Y_MM]
    roll, y_0, z_level = placed(y_mm, points[Z_MM], section.reach_mm, stated.corners_mm, 0.25 * thickness_mm)
    before, behind = y_mm - y_0 < -CLEAR_OF_EDGE_MM, y_mm - y_0 > CLEAR_OF_EDGE_MM
    if min(np.count_nonzero(before), np.count_nonzero(behind)) < MIN_POINTS:
        return None
    start = np.array([z_level + roll * y_0, thickness_mm, roll, roll, y_0])
    fit = fit_points(SHEETS, points, before | behind, START_SIGMA_MM, PRIOR_SIGMA, start)
    if not math.isfinite(fit.chi2):
        return None
    measured = measured_lap(section, fit, y_0, thickness_mm)
    return None if measured is None else as_reported(section, measured, (SeamEdge(measured.y_mm),))


def measured_lap(section: Section, fit: ShapeFit, y_0: float, thickness_mm: float) -> MeasuredJoint | None:
    """Return the lap of sheets that were fitted, None where they are not seen next to their edge.

    `y_0` is where the edge was while they were fitted.
    """
    p, covariance, lines = fit.parameters, fit.covariance, in_scan_order(section.all_points)
    z_s, step, slope_lower, slope_upper = p.tolist()
    sheets = SheetLines(y_0, z_s, step, slope_lower, slope_upper)
    upright = edge_of_sheets(section, lines, sheets, thickness_mm)
    edge, away = upright.y_mm, upright.y_mm - y_0
    if math.isnan(edge):
        return None
    z_edge = z_s + slope_lower * away
    between, at_edge, of_step = np.array(
        [[1.0, 0.5, 0.5 * away, 0.5 * away], [1.0, 0.0, away, 0.0], [0.0, 1.0, -away, away]]
    )
    step_sigma = math.sqrt(of_step @ covariance @ of_step)
    step += (slope_upper - slope_lower) * away
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
            plate_angles_deg=plates,
            plate_sigmas_deg=plate_sigmas,
        ),
        corners_mm=section_corners(SHEETS, np.array([z_edge, step, slope_lower, slope_upper, edge])),
    )


@kernel(allocates=True)
def certain_lines(lines: Float64, y_0: float) -> Float64:
    """Return the points (N_ROWS, n) that are about as sure as most of the less sure sheet.

    A line that holds light of both sheets leaves a large chi^2, which widens its sigma: so wide it would seem
    to lie on either.
    """
    y_mm, sigma_px = lines[Y_MM], lines[SIGMA_PX]
    usual_px = max(exact_median(sigma_px[y_mm < y_0]), exact_median(sigma_px[y_mm >= y_0]))
    return lines[:, sigma_px <= MAX_SIGMAS * usual_px]


@kernel(allocates=True)
def edge_of_sheets(section: Section, points: Float64, sheets: SheetLines, thickness_mm: float) -> Edge:
    """Return the place of the sheets' edge, NaN where points (n,) do not lie on both next to it."""
    lines = certain_lines(points, sheets.y)
    n, nowhere = lines[Y_MM].shape[0], Edge(math.nan, math.nan, math.nan)
    # The upper sheet is seen up to its edge; of the lower one the edge may hide a strip from camera or laser.
    sources_mm = section.camera_mm, section.laser_mm
    hidden = hidden_strip(sources_mm, sheets.y, sheets.z + sheets.step, sheets.step, section.slope_sigma)
    bent_mm, limits_mm = MIN_OFF_SHEET * thickness_mm, np.empty(n)
    # How often a profile's columns miss a sheet tells where it ends: all of it says that.
    is_profile = section.n_columns > 0
    near_mm, widest_mm = (math.inf, WIDEST_IN_PROFILE_MM) if is_profile else (NEAR_MM, WIDEST_MM)
    for i in range(n):
        off_mm = min(OFF_SIGMAS * abs(lines[DZ_MM, i]) * lines[SIGMA_PX, i], ON_SHEET * thickness_mm)
        # The edge that the sheets were fitted with may lie anywhere in the hidden strip.
        is_near = abs(lines[Y_MM, i] - sheets.y) < near_mm + hidden.width_mm
        limits_mm[i] = max(bent_mm, off_mm) if is_near else 0.0
    faces = sheets_at(lines[Y_MM], sheets)
    before, behind = points_around_edge(lines, faces, limits_mm)
    if before < 0:
        return nowhere
    edge: Edge = edge_between(
        lines,
        faces,
        limits_mm,
        bent_mm=bent_mm,
        column_mm=section.column_mm,
        light=section.light,
        before=before,
        behind=behind,
        hidden=hidden,
        is_profile=is_profile,
    )
    # Glare or spatter over all of the points near it: between those beyond an edge may be anywhere, if the
    # scan lines themselves do not tell, or show a surface that is neither sheet's.
    between_mm = lines[Y_MM, behind] - hidden.width_mm - lines[Y_MM, before]
    n_lines = abs(lines[SCAN, behind] - lines[SCAN, before]) - 1.0
    if not is_profile and behind - before - 1 > 0.5 * n_lines:
        edge = Edge(edge.y_mm, edge.variance_mm2 + between_mm**2 / 12.0, edge.y_per_z)
    is_lost = between_mm > widest_mm and 12.0 * edge.variance_mm2 > widest_mm**2
    # A sheet that shows less than what is open beside it is no more than a run of false echoes.
    shown_mm = min(before + 1, n - behind) * section.column_mm
    is_lost |= is_profile and between_mm > max(shown_mm, WIDEST_MM)
    return nowhere if is_lost else edge


def placed(
    y_mm: Float64, z_mm: Float64, reach_mm: float, corners: Float64, limit_mm: float
) -> tuple[float, float, float]:
    """Return how a profile's points (n,) are rolled, a slope, and the nominal corners' shift (y, z), mm.

    Over a whole profile a rolled workpiece rises by more than the step.
    """
    roll = roll_of(y_mm, z_mm)
    return roll, *shift_of(y_mm, z_mm - roll * y_mm, reach_mm, corners, 0.0, SEARCH_STEP_MM, limit_mm)


@kernel(allocates=True)
def roll_of(y_mm: Float64, z_mm: Float64) -> float:
    """Return the slope that both sheets have: the median of that of pairs of points (n,)."""
    n, apart = y_mm.shape[0], y_mm.shape[0] // ROLL_BY
    slopes = np.empty(numbers_for(n), np.float32)
    for i in range(n - apart):
        slopes[i] = (z_mm[i + apart] - z_mm[i]) / (y_mm[i + apart] - y_mm[i])
    return median_of(slopes, n - apart)


class SheetLines(NamedTuple):
    """Two sheets' lines: the upper one before y, whose z is z + step there, and the lower one behind it."""

    y: float
    z: float
    step: float
    slope_lower: float
    slope_upper: float


@kernel(allocates=True)
def sheets_at(y_mm: Float64, sheets: SheetLines) -> Faces:
    """Return both sheets carried on to places (n,): the upper one before the edge, the lower one behind."""
    faces = no_faces(y_mm.shape[0])
    for i in range(y_mm.shape[0]):
        y = y_mm[i] - sheets.y
        faces.before_mm[i] = sheets.z + sheets.step + sheets.slope_upper * y
        faces.before_slope[i] = sheets.slope_upper
        faces.behind_mm[i], faces.behind_slope[i] = sheets.z + sheets.slope_lower * y, sheets.slope_lower
    return faces
