"""Butt and edge: two plates with a gap between them; the seam point is the gap's middle at the surface.

Whether scan lines show a plate, or something else or nothing, tells between which of them the plates end, and
the shares that they hold of the plate's stripe where between.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median
from noise_model.surface.stated_joint import StatedJoint
from tracker.joint.common_mode import as_reported
from tracker.joint.evidence import places_of
from tracker.joint.measured import (
    START_SIGMA_MM,
    MeasuredJoint,
    fit_points,
    meet_face,
    section_at,
    section_corners,
    two_angles,
)
from tracker.joint.misfit import SeamEdge
from tracker.joint.plate_lines import (
    BLURRED_LINES,
    MIN_LINES,
    SLACK_MM,
    OnPlates,
    PlateLines,
    StripeImage,
    best_place,
    blurred_lines,
    end_between,
    end_by_shares,
    evidence_of_gap,
    evidence_of_sheets,
    interpolated,
    others_between,
    plate_lines,
)
from tracker.joint.section_fit import ShapeFit
from tracker.joint.section_shapes import SHEETS
from tracker.profile import Section
from tracker.state import Y_MM, Z_MM, JointShape
from tracker.stripe.light import StripeLight

PRIOR_SIGMA = np.array([5.0, 0.5, 0.03, 0.03])
"""1 sigma of the left plate's height, the step to the right one (mm), both plates' slopes."""

ON_BUTT_MM, ON_EDGE_MM = 1.5, 0.5
"""Largest distance of a plate's point from its line, or a quarter of the thickness.

A plate is often bent down at its end, where it was sheared.
"""

PLATE_MM = 3.0
"""Width of a plate next to the gap that is used to place it."""

NEAR_MM = 15.0
"""So near to a joint its plates are straight: farther off they may be bowed."""

MIN_POINTS = 8
"""Points that must be seen of either plate."""


def fit_slot(section: Section, stated: StatedJoint, image: StripeImage) -> MeasuredJoint | None:
    """Return the butt or edge joint that a section shows, None without a gap between two plates.

    An edge joint whose gap is too narrow to be seen is the middle of its two sheets.
    """
    fit, placed_mm, gap, nats = find_gap(section, stated, image)
    if math.isnan(gap.y_mm):
        return None
    return report_slot(section, stated, measured_slot(stated, fit, placed_mm, gap, nats))


@kernel(allocates=True)
def find_gap(
    section: Section, stated: StatedJoint, image: StripeImage
) -> tuple[ShapeFit, float, JointGap, float]:
    """Return the plates' fit, the place about which it is, the gap, its y NaN of none, and its evidence."""
    points, is_edge, gap_mm = section.points, stated.is_edge, stated.gap_mm
    nothing, nats = JointGap(math.nan, math.nan, math.nan, math.nan, 0, 0, math.nan), math.inf
    y_0, limit_mm = exact_median(points[Y_MM]), on_plate_mm(stated)
    fit = fit_plates(points, y_0, np.ones(points.shape[1], np.bool_))
    if not math.isfinite(fit.chi2):
        return fit, y_0, nothing, nats
    lines = plate_lines(section, on_plates(points, fit, y_0, limit_mm), is_edge, image)
    seen_gap_mm = max(gap_mm, (MIN_LINES + 1) * section.column_mm)
    placed_mm = best_place(lines, stated.thickness_mm if is_edge else PLATE_MM, seen_gap_mm, is_edge)
    if math.isnan(placed_mm) and is_edge:
        placed_mm = best_place(lines, stated.thickness_mm + 0.5 * gap_mm, 0.0, is_edge)
    if math.isnan(placed_mm):
        return fit, y_0, nothing, nats
    are_on = on_plates(points, fit, y_0, 2.0 * limit_mm).are_on
    fit = fit_plates(points, placed_mm, plate_points(points, stated, are_on, placed_mm))
    if not math.isfinite(fit.chi2):
        return fit, placed_mm, nothing, nats
    seen = plate_lines(section, on_plates(points, fit, placed_mm, limit_mm), is_edge, image)
    gap = gap_about(seen, section.light, stated, placed_mm)
    if math.isnan(gap.y_mm):
        return fit, placed_mm, gap, nats
    places = places_of(points[Y_MM], section.reach_mm, section.column_mm)
    if is_edge and section.n_columns > 0:
        between, outer_mm = (gap.first, gap.last), 0.5 * gap.width_mm + stated.thickness_mm
        nats = evidence_of_sheets(
            seen, section.n_columns, between, gap.y_mm, outer_mm, sheet_slack_mm(stated)
        ) - math.log(places)
    elif not is_edge:
        nats = evidence_of_gap(seen, section.light, gap.first, gap.last, places)
    return fit, placed_mm, gap, nats


def fit_closed_slot(
    section: Section, stated: StatedJoint, line_mm: float, sigma_mm: float, nats: float
) -> MeasuredJoint | None:
    """Return the butt joint whose gap no scan line shows, but a line in the image, with its evidence.

    How wide its gap is remains unknown. None without two plates, and where the stated gap is too wide to be
    closed.
    """
    points = section.points
    # A joint with a stated gap as wide is never closed: plates are tacked to a few tenths of a millimetre.
    if stated.gap_mm >= 1.0:
        return None
    fit = fit_plates(points, line_mm, np.abs(points[Y_MM] - line_mm) < NEAR_MM)
    if not math.isfinite(fit.chi2):
        return None
    are_on = on_plates(points, fit, line_mm, 2.0 * on_plate_mm(stated)).are_on
    fit = fit_plates(points, line_mm, plate_points(points, stated, are_on, line_mm))
    if not math.isfinite(fit.chi2):
        return None
    closed = JointGap(line_mm, sigma_mm**2, math.nan, math.nan, 0, 0, 0.0)
    return report_slot(section, stated, measured_slot(stated, fit, line_mm, closed, nats))


class JointGap(NamedTuple):
    """Middle and width of a gap, mm, their variances, mm^2, its first and last line.

    `y_per_z` is by how much its scan lines' y goes with the plates' height. Of a closed one no scan line
    tells how wide it is: NaN.
    """

    y_mm: float
    variance_mm2: float
    width_mm: float
    width_variance_mm2: float
    first: int
    last: int
    y_per_z: float


@kernel(allocates=True)
def gap_about(lines: PlateLines, light: StripeLight, stated: StatedJoint, y_0: float) -> JointGap:
    """Return the gap about a placed joint by the plates' ends on its either side; its y is NaN of none.

    An edge joint's lies amid its sheets' outer ends, if they are equal.
    """
    thickness, gap_mm = stated.thickness_mm, stated.gap_mm
    slack = sheet_slack_mm(stated) if stated.is_edge else SLACK_MM
    reach = 0.5 * gap_mm + slack
    if light.position_px.shape[0] == 0:
        # How often a plate misses columns, all of it tells.
        reach = 0.5 * gap_mm + (thickness if stated.is_edge else NEAR_MM)
    right = end_between(lines, light, y_0 - reach, y_0, True)
    left = end_between(lines, light, y_0, y_0 + reach, False)
    first, last = right.line + 1, left.line - 1
    if others_between(lines, right.line, left.line) >= MIN_LINES:
        gap_lines = left.line - right.line - 1
        # A blurred end seems off to its own side: where one is not resolved, in the middle of both that
        # cancels. Of one that another light hides it is the lesser part.
        right_refined = end_by_shares(lines, light, right, True, gap_lines)
        left_refined = end_by_shares(lines, light, left, False, gap_lines)
        blurred_mm2 = (blurred_lines(light) * lines.column_mm) ** 2 / 12.0
        right_lies = not math.isnan(right_refined.y_mm) or right.variance_mm2 > blurred_mm2
        left_lies = not math.isnan(left_refined.y_mm) or left.variance_mm2 > blurred_mm2
        if right_lies and left_lies:
            right = right if math.isnan(right_refined.y_mm) else right_refined
            left = left if math.isnan(left_refined.y_mm) else left_refined
        width = left.y_mm - right.y_mm
        variance = left.variance_mm2 + right.variance_mm2
        width_variance = variance
        if width < blurred_lines(light) * lines.column_mm:
            width_variance = max(width_variance, lines.column_mm**2)
        middle = 0.5 * (left.y_mm + right.y_mm)
        y_per_z = interpolated(middle, lines.y_mm, lines.y_per_z)
        return JointGap(middle, 0.25 * variance, width, width_variance, first, last, y_per_z)
    if not stated.is_edge:
        return JointGap(math.nan, math.nan, math.nan, math.nan, first, last, math.nan)
    outer = 0.5 * gap_mm + thickness
    right = end_between(lines, light, y_0 - outer - slack, y_0 - outer + slack, False)
    left = end_between(lines, light, y_0 + outer - slack, y_0 + outer + slack, True)
    # Tolerance of a sheet's thickness: it moves an edge joint's seam where no gap is seen.
    variance = 0.25 * (left.variance_mm2 + right.variance_mm2) + 0.5 * 0.1**2
    middle, blurred_mm = 0.5 * (left.y_mm + right.y_mm), BLURRED_LINES * lines.column_mm
    y_per_z = interpolated(middle, lines.y_mm, lines.y_per_z)
    return JointGap(middle, variance, 0.0, blurred_mm**2, first, last, y_per_z)


@kernel
def sheet_slack_mm(stated: StatedJoint) -> float:
    """Return the largest distance of an edge joint's ends from their stated places, mm.

    Beyond a thin sheet there is no plate either: more of that than of the sheet would outvote it.
    """
    return min(SLACK_MM, 0.5 * stated.thickness_mm)


@kernel(allocates=True)
def plate_points(points: Float64, stated: StatedJoint, are_on: Bool, y_0: float) -> Bool:
    """Return the points (n,) that place the plates at a placed joint; none if either is too short."""
    n, right, left = are_on.shape[0], 0, 0
    clear = np.empty(n, np.bool_)
    for i in range(n):
        away_mm = abs(points[Y_MM, i] - y_0)
        off_mm = away_mm - 0.5 * stated.gap_mm
        # Distance from the gap's stated ends from which a point is surely a plate's.
        clear[i] = are_on[i] and 0.3 < off_mm < NEAR_MM
        if stated.is_edge:
            clear[i] = clear[i] and away_mm < 0.5 * stated.gap_mm + stated.thickness_mm
        left += clear[i] and points[Y_MM, i] > y_0
        right += clear[i] and not points[Y_MM, i] > y_0
    return clear if min(left, right) >= MIN_POINTS else np.zeros(n, np.bool_)


def measured_slot(
    stated: StatedJoint, fit: ShapeFit, y_0: float, gap: JointGap, nats: float
) -> MeasuredJoint:
    """Return the joint of two plates, whose lines are fitted about a place, with a gap between them."""
    (z_left, down, slope_left, slope_right), thickness = fit.parameters.tolist(), stated.thickness_mm
    half_mm = 0.0 if math.isnan(gap.width_mm) else 0.5 * gap.width_mm
    right_mm, left_mm = gap.y_mm - half_mm, gap.y_mm + half_mm
    to_right, to_left = right_mm - y_0, left_mm - y_0
    # The plates' surfaces where they end.
    left_top, right_top = z_left + to_left * slope_left, z_left + down + to_right * slope_right
    z_s = 0.5 * (left_top + right_top)
    at_seam = np.array([1.0, 0.5, 0.5 * to_left, 0.5 * to_right])
    step = np.array([0.0, -1.0, to_left, -to_right])
    height_variance, step_variance = at_seam @ fit.covariance @ at_seam, step @ fit.covariance @ step
    # Which scan line lies where goes with the plates' heights.
    variance, across = gap.variance_mm2 + gap.y_per_z**2 * height_variance, gap.y_per_z * height_variance
    width_sigma = math.sqrt(gap.width_variance_mm2 + gap.y_per_z**2 * step_variance)
    plates, plate_sigmas = two_angles(fit.parameters, fit.covariance, 2, 3)
    shape = JointShape(
        gap_sigma_mm=width_sigma,
        mismatch_sigma_mm=math.sqrt(step_variance),
        plate_angles_deg=plates,
        plate_sigmas_deg=plate_sigmas,
        area_mm2=math.nan if stated.is_edge else gap.width_mm * thickness,
        area_sigma_mm2=math.nan if stated.is_edge else width_sigma * thickness,
    )
    outer, floor_mm = section_corners(SHEETS, np.append(fit.parameters, y_0)), z_s - thickness
    # What lies deep in the gap is the gap's, whatever it is: it has a floor.
    ends = (right_mm, right_top), (right_mm, floor_mm), (left_mm, floor_mm), (left_mm, left_top)
    return MeasuredJoint(
        y_mm=gap.y_mm,
        z_mm=z_s,
        covariance_mm2=np.array([[variance, across], [across, height_variance]]),
        gap_mm=gap.width_mm,
        mismatch_mm=left_top - right_top,
        chi2=fit.chi2,
        shape=shape,
        corners_mm=np.array([outer[0], *ends, outer[-1]]),
        evidence_nats=nats,
    )


def report_slot(section: Section, stated: StatedJoint, slot: MeasuredJoint) -> MeasuredJoint:
    """Return a slot as it is reported: what lies below its plates is the gap's, whatever it is."""
    (right_mm, right_top), (left_mm, left_top) = slot.corners_mm[1], slot.corners_mm[4]
    y_mm = section.y_mm
    is_over = (y_mm > right_mm) & (y_mm < left_mm)
    top_mm = np.interp(y_mm, [right_mm, left_mm], [right_top, left_top])
    height_mm = np.where(is_over, top_mm, section_at(slot.corners_mm, y_mm)[0] - on_plate_mm(stated))
    plates = section._replace(points=section.points[:, section.z_mm > height_mm])
    edges = SeamEdge(float(right_mm), 0.5, by_gap=1.0), SeamEdge(float(left_mm), 0.5, by_gap=1.0)
    return as_reported(section, slot, edges, plates)


@kernel(allocates=True)
def fit_plates(points: Float64, y_0: float, used: Bool) -> ShapeFit:
    """Fit a line to the plates on either side of a place; the fit's chi2 is NaN where it cannot be."""
    start = np.zeros(5)
    start[0], start[4] = exact_median(points[Z_MM]), y_0
    # A copy of its own has one type: for a constant the kernels would be compiled anew.
    fit: ShapeFit = fit_points(SHEETS, points, used, START_SIGMA_MM, PRIOR_SIGMA.copy(), start)
    return fit


@kernel
def on_plate_mm(stated: StatedJoint) -> float:
    """Return the largest distance of a plate's points from its line, mm."""
    return min(ON_EDGE_MM if stated.is_edge else ON_BUTT_MM, 0.25 * stated.thickness_mm)


@kernel(allocates=True)
def on_plates(points: Float64, plates: ShapeFit, y_0: float, limit_mm: float) -> OnPlates:
    """Write for each point whether it lies on one of the plates' lines, and where."""
    p, n = plates.parameters, points[Y_MM].shape[0]
    are_on, height_mm, slope = np.empty(n, np.bool_), np.empty(n), np.empty(n)
    for i in range(n):
        y = points[Y_MM, i] - y_0
        left_mm, right_mm = p[0] + p[2] * y, p[0] + p[1] + p[3] * y
        off_left, off_right = abs(points[Z_MM, i] - left_mm), abs(points[Z_MM, i] - right_mm)
        is_left = off_left < off_right
        height_mm[i], slope[i] = (left_mm, p[2]) if is_left else (right_mm, p[3])
        are_on[i] = min(off_left, off_right) < limit_mm
    return OnPlates(are_on, meet_face(points, height_mm, slope))
