"""Plain NumPy twins of the kernels that place two plates and the gap between them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from joint_twins import fit_of
from profiles import Profile

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Bool, Float64, Int64
from noise_model.surface.joint import Joint
from tracker.joint.measured import OFF_SIGMAS, OnFace
from tracker.joint.plate_lines import (
    BESIDE_SIGMAS,
    BLURRED_LINES,
    BRIGHT_LINES,
    DIM_SHARE,
    HELD_SHARE,
    HIDDEN,
    MIN_AGREEMENT,
    MIN_LINES,
    OUTSIDE_MM,
    SLACK_MM,
    UNREAD,
    OnPlates,
    PlateEnd,
)
from tracker.joint.section_fit import SIGMA_FLOOR_PX, ShapeFit
from tracker.joint.section_shapes import SHEETS
from tracker.joint.slot import (
    BESIDE_MM,
    CLEAR_OF_GAP_MM,
    MIN_POINTS,
    NEAR_MM,
    ON_BUTT_MM,
    ON_EDGE_MM,
    PRIOR_SIGMA,
    THICKNESS_SIGMA_MM,
    JointGap,
)
from tracker.stripe.edge import clear_of_an_edge, stripe_end
from tracker.stripe.light import WINDOW_SIGMAS


class LinesTwin:
    """The scan lines in order of y: 1 where a plate is seen, -1 where it is not; y of each (n,), mm.

    Where nothing is seen it is UNREAD, and HIDDEN where saturated pixels lie over the plates' stripe, a
    glint's. `beyond` the profile's ends no plate is seen either if the plates end there, as an edge joint's
    do. A line's y is where the plate is met in it.
    """

    def __init__(self, profile: Profile, on_plates: OnPlates, beyond: bool) -> None:
        on_plate, face = on_plates
        self.away = 1 if profile.scan[-1] > profile.scan[0] else -1
        # A point of two lines lies between them: both see what it does.
        half = 0.5 * (profile.lines_each - 1.0)
        scans = self.away * np.concatenate([profile.scan - half, profile.scan + half])
        pad = math.ceil((OUTSIDE_MM + SLACK_MM) / profile.column_mm) if beyond else 0
        place = self.away * profile.scan - scans.min() + pad
        n = int(np.ptp(scans)) + 1 + 2 * pad
        self.first_scan = int(scans.min()) - pad
        self.light, self.image_dn, self.column_mm = profile.light, profile.image_dn, profile.column_mm
        self.sees = np.full(n, UNREAD)
        for side in (-half, half):
            self.sees[(place + side).astype(np.int64)] = np.where(on_plate, 1.0, -1.0)
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
        plates = np.flatnonzero(self.sees > 0.0)
        if not len(self.light.position_px) or self.image_dn is None or not len(plates):
            return
        scans = self.away * (self.first_scan + plates)
        width_px = np.nanmedian(self.light.width_px[scans])
        brightness = self._brightness(scans, self.light.position_px[scans], width_px)
        self.sees[plates[brightness < DIM_SHARE * np.median(brightness)]] = UNREAD

    def _leave_out_hidden(self) -> None:
        """Let lines say nothing that hold saturated pixels where the plates' stripe would be read."""
        plates = np.flatnonzero(self.sees > 0.0)
        if not len(self.light.position_px) or not len(plates):
            return
        scans = self.away * (self.first_scan + plates)
        width_px = self.light.width_px[scans]
        for line in np.flatnonzero(self.sees <= 0.0):
            scan = self.away * (self.first_scan + int(line))
            if not 0 <= scan < len(self.light.censored):
                continue
            low = self.light.lows[scan // CELL]
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

    def end(self, low_mm: float, high_mm: float, plate_first: bool) -> PlateEnd:
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
        return PlateEnd(0.5 * (low + high), spread**2 / 12.0, plate)

    def _unread_by_blur(self, sees: Float64) -> int:
        """Return how many lines (n,) from an end on are unread, 0 if more than a blurred end leaves."""
        is_read = sees != UNREAD
        unread = int(np.argmax(is_read)) if is_read.any() else len(sees)
        most = 0 if self.light is None else clear_of_an_edge(self.light)
        return unread if unread < most else 0

    def by_shares(self, end: PlateEnd, plate_first: bool, gap_lines: int) -> PlateEnd | None:
        """Return an end at a gap of some lines as the shares say that lines hold of the plate's stripe.

        None where they do not tell it as well, or tell what lines that were read deny.
        """
        if self.light is None:
            return None
        towards = 1 if plate_first else -1
        scan = self.away * (self.first_scan + end.line)
        if (self.sees[end.line + towards :: towards][:1] == HIDDEN).any():
            return None
        is_read = self.sees[end.line + towards :: towards] != UNREAD
        unread = int(np.argmax(is_read)) if is_read.any() else 0
        seen_end = stripe_end(self.light, scan, self.away * towards, gap_lines, unread)
        off = self.away * towards * (seen_end.line - scan)
        variance, blurred = (seen_end.sigma * self.column_mm) ** 2, clear_of_an_edge(self.light)
        if not (variance < end.variance_mm2 and -blurred < off < unread + blurred):
            return None
        y_mm = np.interp(end.line + towards * off, np.arange(len(self.y_mm)), self.y_mm)
        return PlateEnd(float(y_mm), variance, end.line)

    def hold_plates(self, first: int, last: int) -> bool:
        """Say whether the lines from `first` to `last` hold the plates' stripe all the same.

        Where a gap is expected the stripe is sought on what is below it, and not where the plates have it.
        """
        if not len(self.light.position_px) or self.image_dn is None:
            return False
        between = np.arange(first, last + 1)
        plates = np.flatnonzero(self.sees > 0.0)
        plates = plates[np.argsort(np.minimum(abs(plates - first), abs(plates - last)))[: 2 * BRIGHT_LINES]]
        scans = self.away * (self.first_scan + np.sort(plates))
        path_px = np.interp(between, np.sort(plates), self.light.position_px[scans])
        width_px = np.nanmedian(self.light.width_px[scans])
        held = self._brightness(self.away * (self.first_scan + between), path_px, width_px)
        whole = self._brightness(scans, self.light.position_px[scans], width_px)
        return bool(np.median(held) > HELD_SHARE * np.median(whole))

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

    def y_per_z_at(self, y_mm: float) -> float:
        """Return by how much a line's y at a place goes with the plates' height."""
        return float(np.interp(y_mm, self.y_mm, self._y_per_z))

    def others_between(self, first: int, last: int) -> int:
        """Return how many scan lines between two lines show no plate."""
        return int((self.sees[first + 1 : last] < 0.0).sum())


class SlotTwin(NamedTuple):
    """A slot as it was placed: its plates' lines about a place, the gap, and its plates where they end."""

    fit: ShapeFit
    placed_mm: float
    gap: JointGap


def fitted_slot(profile: Profile, joint: Joint) -> SlotTwin | None:
    """The butt or edge joint that a profile shows, or None where it shows no gap between two plates."""
    thickness, gap_mm = joint.dimensions["thickness_mm"], joint.dimensions["gap_mm"]
    is_edge = joint.type == "edge"
    limit_mm = min(ON_EDGE_MM if is_edge else ON_BUTT_MM, 0.25 * thickness)
    y_0 = float(np.median(profile.y_mm))
    plates = plates_about(profile, y_0, np.ones(len(profile.y_mm), dtype=bool))
    if plates is None:
        return None
    lines = LinesTwin(profile, points_on(profile, plates, y_0, limit_mm), is_edge)
    seen_gap = max(gap_mm, (MIN_LINES + 1) * profile.column_mm)
    placed = lines.place(thickness if is_edge else BESIDE_MM, seen_gap, is_edge)
    if placed is None and is_edge:
        placed = lines.place(thickness + 0.5 * gap_mm, 0.0, is_edge)
    if placed is None:
        return None
    off_mm = np.abs(profile.y_mm - placed) - 0.5 * gap_mm
    clear = points_on(profile, plates, y_0, 2.0 * limit_mm).are_on
    clear &= (off_mm > CLEAR_OF_GAP_MM) & (off_mm < (min(thickness, NEAR_MM) if is_edge else NEAR_MM))
    on_left = profile.y_mm > placed
    if min((clear & on_left).sum(), (clear & ~on_left).sum()) < MIN_POINTS:
        return None
    fit = plates_about(profile, placed, clear)
    if fit is None:
        return None
    seen = LinesTwin(profile, points_on(profile, fit, placed, limit_mm), is_edge)
    gap = gap_of(seen, joint, placed)
    if gap is None or (not is_edge and seen.hold_plates(gap.first, gap.last)):
        return None
    return SlotTwin(fit, placed, gap)


def gap_of(lines: LinesTwin, joint: Joint, y_0: float) -> JointGap | None:
    """The gap about a placed joint by the plates' ends on its either side; None where none is seen."""
    thickness, gap_mm = joint.dimensions["thickness_mm"], joint.dimensions["gap_mm"]
    # Beyond a thin sheet there is no plate either: more of that than of the sheet would outvote it.
    slack = min(SLACK_MM, 0.5 * thickness) if joint.type == "edge" else SLACK_MM
    reach = 0.5 * gap_mm + slack
    right, left = lines.end(y_0 - reach, y_0, True), lines.end(y_0, y_0 + reach, False)
    between = right.line + 1, left.line - 1
    if lines.others_between(right.line, left.line) >= MIN_LINES:
        gap_lines = left.line - right.line - 1
        # A blurred end seems off to its own side: where one is not told, in the middle of both that cancels.
        right_refined = lines.by_shares(right, True, gap_lines)
        left_refined = lines.by_shares(left, False, gap_lines)
        if right_refined is not None and left_refined is not None:
            right, left = right_refined, left_refined
        width = left.y_mm - right.y_mm
        variance = width_variance = left.variance_mm2 + right.variance_mm2
        if width < lines.blurred * lines.column_mm:
            width_variance = max(width_variance, lines.column_mm**2)
        middle = 0.5 * (left.y_mm + right.y_mm)
        return JointGap(middle, 0.25 * variance, width, width_variance, *between, lines.y_per_z_at(middle))
    if joint.type != "edge":
        return None
    outer = 0.5 * gap_mm + thickness
    right = lines.end(y_0 - outer - slack, y_0 - outer + slack, False)
    left = lines.end(y_0 + outer - slack, y_0 + outer + slack, True)
    variance = 0.25 * (left.variance_mm2 + right.variance_mm2) + 0.5 * THICKNESS_SIGMA_MM**2
    middle, blurred_mm = 0.5 * (left.y_mm + right.y_mm), BLURRED_LINES * lines.column_mm
    return JointGap(middle, variance, 0.0, blurred_mm**2, *between, lines.y_per_z_at(middle))


def plates_about(profile: Profile, y_0: float, used: Bool) -> ShapeFit | None:
    """A line through the plates on either side of a place."""
    start = np.array([np.median(profile.z_mm), 0.0, 0.0, 0.0, y_0])
    return fit_of(profile, SHEETS, start, PRIOR_SIGMA, used)


def points_on(profile: Profile, plates: ShapeFit, y_0: float, limit_mm: float) -> OnPlates:
    """Which points lie on one of the plates' lines, and where their rays meet it."""
    z, step, slope_left, slope_right = plates.parameters
    y = profile.y_mm - y_0
    left_mm, right_mm = z + slope_left * y, z + step + slope_right * y
    off_left, off_right = np.abs(profile.z_mm - left_mm), np.abs(profile.z_mm - right_mm)
    is_left = off_left < off_right
    height_mm, slope = np.where(is_left, left_mm, right_mm), np.where(is_left, slope_left, slope_right)
    y_per_z = profile.dy_mm / (profile.dz_mm - slope * profile.dy_mm)
    met = OnFace(profile.y_mm - y_per_z * (profile.z_mm - height_mm), y_per_z)
    return OnPlates(np.minimum(off_left, off_right) < limit_mm, met)


def share_raised(profile: Profile, slot: SlotTwin) -> float:
    """The share of the points near the gap that lie off their plate, or in the gap over it."""
    z, step, slope_left, slope_right = slot.fit.parameters
    y, half_mm = profile.y_mm, 0.5 * slot.gap.width_mm
    right_mm, left_mm = slot.gap.y_mm - half_mm, slot.gap.y_mm + half_mm
    beside = y - slot.placed_mm
    line = np.where(y > slot.gap.y_mm, z + slope_left * beside, z + step + slope_right * beside)
    off = (profile.z_mm - line) / (np.abs(profile.dz_mm) * np.hypot(profile.sigma_px, SIGMA_FLOOR_PX))
    near = (y > right_mm - SLACK_MM) & (y < left_mm + SLACK_MM)
    wrong = np.where((y > right_mm) & (y < left_mm), off > OFF_SIGMAS, np.abs(off) > OFF_SIGMAS)
    return float(np.mean(wrong[near])) if near.any() else 1.0
