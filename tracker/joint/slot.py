"""Butt and edge: two plates with a gap between them; the seam point is the gap's middle at the surface.

Whether scan lines show a plate, or something else or nothing, tells between which of them the plates end, and
the shares that they hold of the plate's stripe where between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from noise_model.arrays import Bool
from noise_model.median import median
from noise_model.surface.joint import Joint
from tracker.joint.evidence import places_of
from tracker.joint.image_line import ImageLine
from tracker.joint.measured import (
    OFF_SIGMAS,
    MeasuredJoint,
    ShapeFit,
    angles_of,
    fit_shape,
    meet_face,
    off_line,
    points_of,
    section_of,
)
from tracker.joint.plate_lines import BLURRED_LINES, MIN_LINES, SLACK_MM, OnPlates, PlateLines
from tracker.joint.section_shapes import SHEETS
from tracker.profile import Profile
from tracker.state import JointShape, Pair

PRIOR_SIGMA = np.array([5.0, 0.5, 0.03, 0.03])
"""1 sigma of the left plate's height, the step to the right one (mm), both plates' slopes."""

ON_PLATE_MM = {"butt": 1.5, "edge": 0.5}
"""What lies farther than this from either plate, or a quarter of the thickness, is not of it.

A plate is often bent down at its end, where it was sheared.
"""

BESIDE_MM = 3.0
"""How much of a plate beside the gap is looked at to place it."""

NEAR_MM = 15.0
"""So near to a joint its plates are straight: farther off they may be bowed."""

CLEAR_OF_GAP_MM = 0.3
"""How far from the gap's stated ends a point must lie to be surely a plate's."""

MIN_POINTS = 8
"""Points that must be seen of either plate."""

MAX_CLOSED_MM = 1.0
"""A joint with a stated gap as wide is never closed: plates are tacked to a few tenths of a millimetre."""

THICKNESS_SIGMA_MM = 0.1
"""How far a sheet may be off its stated thickness: it moves an edge joint's seam where no gap is seen."""


def fit_slot(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the butt or edge joint that a profile shows, or None where it shows no gap between two plates.

    An edge joint whose gap is too narrow to be seen is the middle of its two sheets.
    """
    thickness, gap = joint.dimensions["thickness_mm"], joint.dimensions["gap_mm"]
    is_edge = joint.type == "edge"
    limit_mm = _on_plate_mm(joint)
    y_0 = median(profile.y_mm)
    everywhere = np.ones(len(profile.y_mm), dtype=bool)
    plates = _plates(profile, y_0, everywhere)
    if plates is None:
        return None
    lines = PlateLines(profile, _on_plates(profile, plates, y_0, limit_mm), is_edge)
    seen_gap = max(gap, (MIN_LINES + 1) * profile.column_mm)
    placed = lines.place(thickness if is_edge else BESIDE_MM, seen_gap, is_edge)
    if placed is None and is_edge:
        placed = lines.place(thickness + 0.5 * gap, 0.0, is_edge)
    if placed is None:
        return None
    on_plates = _on_plates(profile, plates, y_0, 2.0 * limit_mm)
    fit = _plates_beside(profile, joint, on_plates.are_on, placed)
    if fit is None:
        return None
    seen = PlateLines(profile, _on_plates(profile, fit, placed, limit_mm), is_edge)
    opening = _gap_of(seen, joint, placed)
    if opening is None or (not is_edge and seen.hold_plates(*opening.lines)):
        return None
    evidence = math.inf
    if not is_edge:
        places = places_of(profile.y_mm, profile.reach_mm, profile.column_mm)
        evidence = seen.gap_evidence_nats(*opening.lines, places)
    return _measured(profile, joint, fit, placed, opening, evidence)


def fit_closed_slot(profile: Profile, joint: Joint, line: ImageLine) -> MeasuredJoint | None:
    """Return the butt joint whose gap no scan line shows, but a line in the image; None without two plates.

    How wide its gap is remains unknown. None also where the stated gap is too wide to be closed.
    """
    if joint.dimensions["gap_mm"] >= MAX_CLOSED_MM:
        return None
    near = np.abs(profile.y_mm - line.y_mm) < NEAR_MM
    plates = _plates(profile, line.y_mm, near)
    if plates is None:
        return None
    on_plates = _on_plates(profile, plates, line.y_mm, 2.0 * _on_plate_mm(joint))
    fit = _plates_beside(profile, joint, on_plates.are_on, line.y_mm)
    if fit is None:
        return None
    closed = _Gap(line.y_mm, line.sigma_mm**2, math.nan, math.nan, (0, 0), 0.0)
    return _measured(profile, joint, fit, line.y_mm, closed, line.evidence_nats)


@dataclass(frozen=True)
class _Gap:
    """Where a gap's middle is and how wide it is, mm, and their variances, mm^2; its first and last line.

    `y_per_z` is by how much its scan lines' y goes with the plates' height. Of a closed one no scan line
    tells how wide it is: NaN.
    """

    y_mm: float
    variance_mm2: float
    width_mm: float
    width_variance_mm2: float
    lines: tuple[int, int]
    y_per_z: float


def _gap_of(lines: PlateLines, joint: Joint, y_0: float) -> _Gap | None:
    """Find the gap about a placed joint by the plates' ends on its either side; None where none is seen.

    An edge joint's lies amid its sheets' outer ends, if they are alike.
    """
    thickness, gap = joint.dimensions["thickness_mm"], joint.dimensions["gap_mm"]
    # Beyond a thin sheet there is no plate either: more of that than of the sheet would outvote it.
    slack = min(SLACK_MM, 0.5 * thickness) if joint.type == "edge" else SLACK_MM
    reach = 0.5 * gap + slack
    right, left = lines.end(y_0 - reach, y_0, True), lines.end(y_0, y_0 + reach, False)
    between = right.line + 1, left.line - 1
    if lines.others_between(right.line, left.line) >= MIN_LINES:
        gap_lines = left.line - right.line - 1
        # A blurred end seems off to its own side: where one is not told, in the middle of both that cancels.
        right_told = lines.by_shares(right, True, gap_lines)
        left_told = lines.by_shares(left, False, gap_lines)
        if right_told is not None and left_told is not None:
            right, left = right_told, left_told
        width = left.y_mm - right.y_mm
        variance = width_variance = left.variance_mm2 + right.variance_mm2
        if width < lines.blurred * lines.column_mm:
            width_variance = max(width_variance, lines.column_mm**2)
        middle = 0.5 * (left.y_mm + right.y_mm)
        return _Gap(middle, 0.25 * variance, width, width_variance, between, lines.y_per_z_at(middle))
    if joint.type != "edge":
        return None
    outer = 0.5 * gap + thickness
    right = lines.end(y_0 - outer - slack, y_0 - outer + slack, False)
    left = lines.end(y_0 + outer - slack, y_0 + outer + slack, True)
    variance = 0.25 * (left.variance_mm2 + right.variance_mm2) + 0.5 * THICKNESS_SIGMA_MM**2
    middle, blurred_mm = 0.5 * (left.y_mm + right.y_mm), BLURRED_LINES * lines.column_mm
    return _Gap(middle, variance, 0.0, blurred_mm**2, between, lines.y_per_z_at(middle))


def _plates_beside(profile: Profile, joint: Joint, on_plates: Bool, y_0: float) -> ShapeFit | None:
    """Fit lines to the points on the plates beside a placed joint once more; None if either is too short."""
    gap = joint.dimensions["gap_mm"]
    off_mm = np.abs(profile.y_mm - y_0) - 0.5 * gap
    clear = on_plates & (off_mm > CLEAR_OF_GAP_MM) & (off_mm < NEAR_MM)
    if joint.type == "edge":
        clear &= np.abs(profile.y_mm - y_0) < 0.5 * gap + joint.dimensions["thickness_mm"]
    on_left = profile.y_mm > y_0
    if min((clear & on_left).sum(), (clear & ~on_left).sum()) < MIN_POINTS:
        return None
    return _plates(profile, y_0, clear)


def _measured(
    profile: Profile, joint: Joint, fit: ShapeFit, y_0: float, opening: _Gap, evidence_nats: float
) -> MeasuredJoint:
    """Return the joint of two plates, whose lines are fitted about a place, with a gap between them."""
    thickness, is_edge = joint.dimensions["thickness_mm"], joint.type == "edge"
    half_mm = 0.0 if math.isnan(opening.width_mm) else 0.5 * opening.width_mm
    right_mm, left_mm = opening.y_mm - half_mm, opening.y_mm + half_mm
    # The plates' surfaces where they end.
    left_surface = np.array([1.0, 0.0, left_mm - y_0, 0.0])
    right_surface = np.array([1.0, 1.0, 0.0, right_mm - y_0])
    at_seam, step = 0.5 * (left_surface + right_surface), left_surface - right_surface
    z_s = float(at_seam @ fit.parameters)
    plate_angles, plate_sigmas = angles_of(fit, 2, 3)
    # Which scan line lies where goes with the plates' heights.
    y_per_z, height_variance = opening.y_per_z, float(at_seam @ fit.covariance @ at_seam)
    variance = opening.variance_mm2 + y_per_z**2 * height_variance
    across = y_per_z * height_variance
    step_variance = float(step @ fit.covariance @ step)
    width_sigma = math.sqrt(opening.width_variance_mm2 + y_per_z**2 * step_variance)
    shape = JointShape(
        width_sigma,
        math.sqrt(step_variance),
        plate_angles_deg=plate_angles,
        plate_sigmas_deg=plate_sigmas,
        area_mm2=math.nan if is_edge else opening.width_mm * thickness,
        area_sigma_mm2=math.nan if is_edge else width_sigma * thickness,
    )
    far_right, *_, far_left = section_of(SHEETS, fit, (y_0,))
    right_top, left_top = float(right_surface @ fit.parameters), float(left_surface @ fit.parameters)
    # What lies deep in the gap is the gap's, whatever it is.
    floor = z_s - thickness
    corners = [far_right, (right_mm, right_top), (right_mm, floor), (left_mm, floor), (left_mm, left_top)]
    return MeasuredJoint(
        opening.y_mm,
        z_s,
        np.array([[variance, across], [across, height_variance]]),
        opening.width_mm,
        float(step @ fit.parameters),
        fit.chi2,
        shape,
        _raised(profile, fit, y_0, (right_mm, left_mm)),
        np.array([*corners, far_left]),
        evidence_nats,
    )


def _raised(profile: Profile, fit: ShapeFit, y_0: float, ends_mm: Pair) -> float:
    """Return the share of the points near the gap that no plate and no gap has, as a tack weld's.

    Beside the gap they lie off their plate, in the gap over it.
    """
    z, step, slope_left, slope_right = fit.parameters
    y, (right_mm, left_mm) = profile.y_mm, ends_mm
    on_left = y > 0.5 * (right_mm + left_mm)
    line = np.where(on_left, z + slope_left * (y - y_0), z + step + slope_right * (y - y_0))
    off = off_line(profile, line)
    near = (y > right_mm - SLACK_MM) & (y < left_mm + SLACK_MM)
    in_gap = (y > right_mm) & (y < left_mm)
    wrong = np.where(in_gap, off > OFF_SIGMAS, np.abs(off) > OFF_SIGMAS)
    return float(np.mean(wrong[near])) if near.any() else 1.0


def _plates(profile: Profile, y_0: float, used: Bool) -> ShapeFit | None:
    """Fit a line to the plates on either side of a place."""
    start = np.array([median(profile.z_mm), 0.0, 0.0, 0.0, y_0])
    return fit_shape(profile, SHEETS, start, PRIOR_SIGMA, used)


def _on_plate_mm(joint: Joint) -> float:
    """Return how far off a plate's line its points may lie, mm."""
    return min(ON_PLATE_MM[joint.type], 0.25 * joint.dimensions["thickness_mm"])


def _on_plates(profile: Profile, plates: ShapeFit, y_0: float, limit_mm: float) -> OnPlates:
    """Say of each point whether it lies on one of the plates' lines, and where."""
    z, step, slope_left, slope_right = plates.parameters
    y = profile.y_mm - y_0
    left_mm, right_mm = z + slope_left * y, z + step + slope_right * y
    off_left, off_right = np.abs(profile.z_mm - left_mm), np.abs(profile.z_mm - right_mm)
    is_left = off_left < off_right
    height_mm, slope = np.where(is_left, left_mm, right_mm), np.where(is_left, slope_left, slope_right)
    return OnPlates(
        np.minimum(off_left, off_right) < limit_mm, meet_face(points_of(profile), height_mm, slope)
    )
