"""Butt and edge: two plates with a gap between them; the seam point is the gap's middle at the surface.

Whether scan lines show a plate, or something else or nothing, tells between which of them the plates end, and
the shares that they hold of the plate's stripe where between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float64, Int64
from noise_model.surface.joint import Joint
from tracker.joint.evidence import gap_evidence_nats, places_of
from tracker.joint.image_line import ImageLine
from tracker.joint.measured import (
    OFF_SIGMAS,
    MeasuredJoint,
    OnFace,
    ShapeFit,
    angles_of,
    fit_shape,
    meet_face,
    off_line,
    section_of,
)
from tracker.joint.section_shapes import SHEETS
from tracker.profile import Profile
from tracker.state import JointShape, Pair
from tracker.stripe.edge import WINDOW_SIGMAS, clear_of_an_edge, stripe_end

PRIOR_SIGMA = np.array([5.0, 0.5, 0.03, 0.03])
"""1 sigma of the left plate's height, the step to the right one (mm), both plates' slopes."""

ON_PLATE_MM = {"butt": 1.5, "edge": 0.5}
"""What lies farther than this from either plate, or a quarter of the thickness, is not of it.

A plate is often bent down at its end, where it was sheared.
"""

BESIDE_MM, OUTSIDE_MM = 3.0, 1.0
"""How much of a plate beside the gap, and of what is beyond an edge joint, is looked at to place it."""

NEAR_MM = 15.0
"""So near to a joint its plates are straight: farther off they may be bowed."""

SLACK_MM = 1.5
"""How far an end of a plate may lie off its stated place."""

CLEAR_OF_GAP_MM = 0.3
"""How far from the gap's stated ends a point must lie to be surely a plate's."""

MIN_LINES, MIN_POINTS = 2, 8
"""Scan lines that a gap must be wide to be seen, and points that must be seen of either plate."""

BLURRED_LINES = 4
"""A gap of fewer scan lines seems up to one wider than it is, for its ends blur into one; or is not seen."""

UNREAD = -0.5
"""What a scan line without a stripe says of a plate, 1 being that it is there: spatter hides one, too."""

BRIGHT_LINES, HELD_SHARE = 12, 0.5
"""Lines of either plate that say how bright its stripe is; the share of it at which a gap's lines hold it."""

DIM_SHARE = 0.25
"""A line with less of the plates' brightness holds what the optics throw into a gap, and no plate."""

BESIDE_SIGMAS = 4.0
"""So many of its sigmas beside its middle a stripe leaves its background."""

HIDDEN = 0.0
"""What a scan line says of a plate whose stripe would run over saturated pixels."""

MAX_CLOSED_MM = 1.0
"""A joint with a stated gap as wide is never closed: plates are tacked to a few tenths of a millimetre."""

MIN_AGREEMENT = 0.6
"""By what share of the scan lines those that show what the joint would must outnumber the others."""

THICKNESS_SIGMA_MM = 0.1
"""How far a sheet may be off its stated thickness: it moves an edge joint's seam where no gap is seen."""


def fit_slot(profile: Profile, joint: Joint) -> MeasuredJoint | None:
    """Return the butt or edge joint that a profile shows, or None where it shows no gap between two plates.

    An edge joint whose gap is too narrow to be seen is the middle of its two sheets.
    """
    thickness, gap = joint.dimensions["thickness_mm"], joint.dimensions["gap_mm"]
    is_edge = joint.type == "edge"
    limit_mm = _on_plate_mm(joint)
    y_0 = float(np.median(profile.y_mm))
    everywhere = np.ones(len(profile.y_mm), dtype=bool)
    plates = _plates(profile, y_0, everywhere)
    if plates is None:
        return None
    lines = _Lines(profile, _on_plates(profile, plates, y_0, limit_mm), is_edge)
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
    seen = _Lines(profile, _on_plates(profile, fit, placed, limit_mm), is_edge)
    opening = _gap_of(seen, joint, placed)
    if opening is None or (not is_edge and seen.hold_plates(*opening.lines)):
        return None
    evidence = math.inf
    if not is_edge:
        evidence = seen.gap_evidence_nats(*opening.lines, places_of(profile, profile.column_mm))
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


class _End(NamedTuple):
    """Where a plate ends, mm, its variance, mm^2, and the last line that shows it."""

    y_mm: float
    variance_mm2: float
    line: int


def _gap_of(lines: _Lines, joint: Joint, y_0: float) -> _Gap | None:
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
    start = np.array([float(np.median(profile.z_mm)), 0.0, 0.0, 0.0, y_0])
    return fit_shape(profile, SHEETS, start, PRIOR_SIGMA, used)


def _on_plate_mm(joint: Joint) -> float:
    """Return how far off a plate's line its points may lie, mm."""
    return min(ON_PLATE_MM[joint.type], 0.25 * joint.dimensions["thickness_mm"])


class _OnPlates(NamedTuple):
    """Which points (n,) lie on either plate's line, and where their rays meet it."""

    are_on: Bool
    face: OnFace


def _on_plates(profile: Profile, plates: ShapeFit, y_0: float, limit_mm: float) -> _OnPlates:
    """Say of each point whether it lies on one of the plates' lines, and where."""
    z, step, slope_left, slope_right = plates.parameters
    y = profile.y_mm - y_0
    left_mm, right_mm = z + slope_left * y, z + step + slope_right * y
    off_left, off_right = np.abs(profile.z_mm - left_mm), np.abs(profile.z_mm - right_mm)
    is_left = off_left < off_right
    height_mm, slope = np.where(is_left, left_mm, right_mm), np.where(is_left, slope_left, slope_right)
    return _OnPlates(np.minimum(off_left, off_right) < limit_mm, meet_face(profile, height_mm, slope))


class _Lines:
    """The scan lines in order of y: 1 where a plate is seen, -1 where it is not; y of each (n,), mm.

    Where nothing is seen it is UNREAD, and HIDDEN where saturated pixels lie over the plates' stripe, a
    glint's. `beyond` the profile's ends no plate is seen either if the plates end there, as an edge joint's
    do. A line's y is where the plate is met in it.
    """

    def __init__(self, profile: Profile, on_plates: _OnPlates, beyond: bool) -> None:
        on_plate, face = on_plates
        self.away = 1 if profile.scan[-1] > profile.scan[0] else -1
        scan = self.away * profile.scan
        pad = math.ceil((OUTSIDE_MM + SLACK_MM) / profile.column_mm) if beyond else 0
        place = (scan - scan.min()).astype(np.int64) + pad
        n = int(place.max()) + 1 + pad
        self.first_scan = int(scan.min()) - pad
        self.light, self.image_dn, self.column_mm = profile.light, profile.image_dn, profile.column_mm
        self.sees = np.full(n, UNREAD)
        self.sees[place] = np.where(on_plate, 1.0, -1.0)
        order = np.argsort(place, kind="stable")
        if on_plate.any():
            # Where the plates would be seen: what lies deep in the gap looks shifted beside them.
            order = order[on_plate[order]]
        lines, seen = np.arange(n), place[order]
        outside = np.minimum(lines - seen[0], 0) + np.maximum(lines - seen[-1], 0)
        self.y_mm = np.interp(lines, seen, face.y_mm[order]) + self.column_mm * outside
        self._y_per_z = np.interp(lines, seen, face.y_per_z[order])
        self._leave_out_dim()
        self._leave_out_hidden()

    def _leave_out_dim(self) -> None:
        """Take lines as unread that hold a stripe where the plates' is, but hardly any of its light."""
        if self.light is None or self.image_dn is None:
            return
        plates = np.flatnonzero(self.sees > 0.0)
        scans = self.away * (self.first_scan + plates)
        width_px = float(np.nanmedian(self.light.width_px[scans]))
        brightness = self._brightness(scans, self.light.position_px[scans], width_px)
        self.sees[plates[brightness < DIM_SHARE * np.median(brightness)]] = UNREAD

    def _leave_out_hidden(self) -> None:
        """Let lines say nothing that hold saturated pixels where the plates' stripe would be read."""
        plates = np.flatnonzero(self.sees > 0.0)
        if self.light is None or not len(plates):
            return
        scans = self.away * (self.first_scan + plates)
        width_px = self.light.width_px[scans]
        for line in np.flatnonzero(self.sees <= 0.0):
            scan = self.away * (self.first_scan + int(line))
            if not 0 <= scan < len(self.light.censored):
                continue
            low = self.light.lows[scan // self.light.cell]
            path_px = np.interp(line, plates, self.light.position_px[scans]) - low
            half_px = WINDOW_SIGMAS * np.interp(line, plates, width_px)
            near = slice(max(math.floor(path_px - half_px), 0), max(math.ceil(path_px + half_px) + 1, 0))
            if self.light.censored[scan, near].any():
                self.sees[line] = HIDDEN

    def place(self, plate_mm: float, gap_mm: float, ends: bool) -> float | None:
        """Return where two plates of a width with a gap between them agree best, None if nowhere enough."""
        plate, gap = (max(round(width / self.column_mm), 0) for width in (plate_mm, gap_mm))
        outside = round(OUTSIDE_MM / self.column_mm) if ends else 0
        signs = np.concatenate(
            [-np.ones(outside), np.ones(plate), -np.ones(gap), np.ones(plate), -np.ones(outside)]
        )
        if len(signs) > len(self.sees):
            return None
        votes = np.correlate(np.abs(self.sees), np.ones(len(signs)), "valid")
        agreement = np.correlate(self.sees, signs, "valid") / np.maximum(votes, 1.0)
        best = int(np.argmax(agreement))
        middle = best + len(signs) // 2
        in_gap = self.sees[middle - gap // 2 : middle - gap // 2 + gap]
        if agreement[best] < MIN_AGREEMENT or (gap and (in_gap < 0.0).sum() < MIN_LINES):
            return None
        return float(self.y_mm[best] + 0.5 * (len(signs) - 1) * self.column_mm)

    def end(self, low_mm: float, high_mm: float, plate_first: bool) -> _End:
        """Return the end of a plate between two places: where most lines agree.

        Lines that a blurred end leaves unread before what is seen beyond may be the plate's as well.
        """
        first, last = np.searchsorted(self.y_mm, [low_mm, high_mm])
        sees = self.sees[first:last] * (1.0 if plate_first else -1.0)
        votes = np.concatenate([[0.0], np.cumsum(sees)])
        best = np.flatnonzero(votes == votes.max())[[0, -1]] + first
        before, behind = max(int(best[0]) - 1, 0), min(int(best[1]), len(self.y_mm) - 1)
        plate = before if plate_first else behind
        if plate_first:
            behind += self._unread_by_blur(self.sees[behind:])
        else:
            before -= self._unread_by_blur(self.sees[before::-1])
        low, high = float(self.y_mm[before]), float(self.y_mm[behind])
        spread = max(high - low, self.column_mm)
        return _End(0.5 * (low + high), spread**2 / 12.0, plate)

    def _unread_by_blur(self, sees: Float64) -> int:
        """Return how many lines (n,) from an end on are unread, 0 if more than a blurred end leaves."""
        is_read = sees != UNREAD
        unread = int(np.argmax(is_read)) if is_read.any() else len(sees)
        most = 0 if self.light is None else clear_of_an_edge(self.light)
        return unread if unread < most else 0

    def by_shares(self, end: _End, plate_first: bool, gap_lines: int) -> _End | None:
        """Return an end at a gap of some lines as the shares say that lines hold of the plate's stripe.

        None where they do not tell it as well, or tell what lines that were read deny.
        """
        if self.light is None:
            return None
        towards = 1 if plate_first else -1
        scan = self.away * (self.first_scan + end.line)
        seen_end = stripe_end(self.light, scan, self.away * towards, gap_lines)
        off = self.away * towards * (seen_end.line - scan)
        if (self.sees[end.line + towards :: towards][:1] == HIDDEN).any():
            return None
        is_read = self.sees[end.line + towards :: towards] != UNREAD
        unread = int(np.argmax(is_read)) if is_read.any() else 0
        variance, blurred = (seen_end.sigma * self.column_mm) ** 2, clear_of_an_edge(self.light)
        if not (variance < end.variance_mm2 and -blurred < off < unread + blurred):
            return None
        y_mm = np.interp(end.line + towards * off, np.arange(len(self.y_mm)), self.y_mm)
        return _End(float(y_mm), variance, end.line)

    def hold_plates(self, first: int, last: int) -> bool:
        """Say whether the lines from `first` to `last` hold the plates' stripe all the same.

        Where a gap is expected the stripe is sought on what is below it, and not where the plates have it.
        """
        if self.light is None or self.image_dn is None:
            return False
        between = np.arange(first, last + 1)
        plates = np.flatnonzero(self.sees > 0.0)
        plates = plates[np.argsort(np.minimum(abs(plates - first), abs(plates - last)))[: 2 * BRIGHT_LINES]]
        scans = self.away * (self.first_scan + np.sort(plates))
        path_px = np.interp(between, np.sort(plates), self.light.position_px[scans])
        width_px = float(np.nanmedian(self.light.width_px[scans]))
        held = self._brightness(self.away * (self.first_scan + between), path_px, width_px)
        whole = self._brightness(scans, self.light.position_px[scans], width_px)
        return float(np.median(held)) > HELD_SHARE * float(np.median(whole))

    def _brightness(self, scans: Int64, path_px: Float64, width_px: float) -> Float64:
        """Return how much brighter scan lines (n,) are about a path (n,), px, than beside it, DN."""
        assert self.image_dn is not None
        near = np.arange(-math.ceil(width_px), math.ceil(width_px) + 1)
        far = math.ceil(BESIDE_SIGMAS * width_px)
        offsets = np.concatenate([near, near - far, near + far])
        places = np.clip(np.rint(path_px).astype(np.int64)[:, None] + offsets, 0, self.image_dn.shape[1] - 1)
        within, *beside = np.split(self.image_dn[scans[:, None], places].astype(np.float64), 3, axis=1)
        return np.asarray(within.mean(axis=1) - np.minimum(*(side.mean(axis=1) for side in beside)))

    @property
    def blurred(self) -> int:
        """The scan lines of a gap whose ends blur into one."""
        if self.light is None:
            return BLURRED_LINES
        return max(BLURRED_LINES, 2 * (clear_of_an_edge(self.light) - 1))

    def gap_evidence_nats(self, first: int, last: int, places: float) -> float:
        """Return the evidence, nats, that lines from `first` to `last` are a gap's and not lost by chance.

        Beyond the last line that shows a plate nothing is lost: the stripe has ended, or leaves its reach.
        """
        plate = np.flatnonzero(self.sees > 0.0)
        start, end = int(plate[0]), int(plate[-1]) + 1
        return gap_evidence_nats(self.sees[start:end] < 0.0, first - start, last - start, places)

    def y_per_z_at(self, y_mm: float) -> float:
        """Return by how much a line's y at a place goes with the plates' height."""
        return float(np.interp(y_mm, self.y_mm, self._y_per_z))

    def others_between(self, first: int, last: int) -> int:
        """Return how many scan lines between two lines show no plate."""
        return int((self.sees[first + 1 : last] < 0.0).sum())
