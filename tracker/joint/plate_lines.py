"""The scan lines about a gap between two plates: which of them show a plate, and where the plates end."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL
from noise_model.arrays import Bool, Float64, Int64
from noise_model.median import known_median, median
from tracker.joint.evidence import gap_evidence_nats
from tracker.joint.measured import OnFace
from tracker.profile import Profile
from tracker.stripe.edge import WINDOW_SIGMAS, clear_of_an_edge, stripe_end

OUTSIDE_MM = 1.0
"""How much of what is beyond an edge joint is looked at to place it."""

SLACK_MM = 1.5
"""How far an end of a plate may lie off its stated place."""

MIN_LINES = 2
"""Scan lines that a gap must be wide to be seen."""

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

MIN_AGREEMENT = 0.6
"""By what share of the scan lines those that show what the joint would must outnumber the others."""


class OnPlates(NamedTuple):
    """Which points (n,) lie on either plate's line, and where their rays meet it."""

    are_on: Bool
    face: OnFace


class PlateEnd(NamedTuple):
    """Where a plate ends, mm, its variance, mm^2, and the last line that shows it."""

    y_mm: float
    variance_mm2: float
    line: int


class PlateLines:
    """The scan lines in order of y: 1 where a plate is seen, -1 where it is not; y of each (n,), mm.

    Where nothing is seen it is UNREAD, and HIDDEN where saturated pixels lie over the plates' stripe, a
    glint's. `beyond` the profile's ends no plate is seen either if the plates end there, as an edge joint's
    do. A line's y is where the plate is met in it.
    """

    def __init__(self, profile: Profile, on_plates: OnPlates, beyond: bool) -> None:
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
        plates = np.flatnonzero(self.sees > 0.0)
        if self.light is None or self.image_dn is None or not len(plates):
            return
        scans = self.away * (self.first_scan + plates)
        width_px = known_median(self.light.width_px[scans])
        brightness = self._brightness(scans, self.light.position_px[scans], width_px)
        self.sees[plates[brightness < DIM_SHARE * median(brightness)]] = UNREAD

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
        if self.light is None or self.image_dn is None:
            return False
        between = np.arange(first, last + 1)
        plates = np.flatnonzero(self.sees > 0.0)
        plates = plates[np.argsort(np.minimum(abs(plates - first), abs(plates - last)))[: 2 * BRIGHT_LINES]]
        scans = self.away * (self.first_scan + np.sort(plates))
        path_px = np.interp(between, np.sort(plates), self.light.position_px[scans])
        width_px = known_median(self.light.width_px[scans])
        held = self._brightness(self.away * (self.first_scan + between), path_px, width_px)
        whole = self._brightness(scans, self.light.position_px[scans], width_px)
        return median(held) > HELD_SHARE * median(whole)

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
