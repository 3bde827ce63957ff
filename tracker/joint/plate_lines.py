"""The scan lines about a gap between two plates: which of them show a plate, and where the plates end."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Bool, Float64, Integers
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median
from noise_model.compiled.ordering import stable_order
from tracker.joint.evidence import gap_evidence_nats
from tracker.joint.measured import OnFace
from tracker.profile import Section
from tracker.state import N_LINES, SCAN
from tracker.stripe.edge import clear_of_an_edge, stripe_end
from tracker.stripe.light import WINDOW_SIGMAS, StripeLight

OUTSIDE_MM = 1.0
"""Width beyond an edge joint that is used to place it."""

SLACK_MM = 1.5
"""Largest distance of a plate's end from its stated place."""

MIN_LINES = 2
"""Scan lines that a gap must be wide to be seen."""

BLURRED_LINES = 4
"""A gap of fewer scan lines seems up to one wider than it is, for its ends blur into one; or is not seen."""

UNREAD = -0.5
"""Vote of a scan line without a stripe for a plate, 1 being that it is there: spatter hides one, too."""

BRIGHT_LINES, HELD_SHARE = 12, 0.5
"""Lines of either plate that say how bright its stripe is; the share of it at which a gap's lines hold it."""

HIDDEN = 0.0
"""Vote of a scan line for a plate whose stripe would run over saturated pixels."""


class OnPlates(NamedTuple):
    """Points (n,) on either plate's line, and the intersections of their rays with it."""

    are_on: Bool
    face: OnFace


class PlateEnd(NamedTuple):
    """End of a plate, mm, its variance, mm^2, and the last line that shows it."""

    y_mm: float
    variance_mm2: float
    line: int


class PlateLines(NamedTuple):
    """The scan lines (n,) in order of y: what each `sees`, and the y, mm, where the plates are met in it.

    That is 1 where a plate is seen and -1 where it is not; UNREAD where nothing is seen, and HIDDEN where
    saturated pixels lie over the plates' stripe, a glint's. `y_per_z` is by how much a line's y goes with the
    plates' height. The line i is scan line `away` (`first_scan` + i).
    """

    sees: Float64
    y_mm: Float64
    y_per_z: Float64
    away: int
    first_scan: int
    column_mm: float


class PlateStripe(NamedTuple):
    """The lines (n,) that show a plate, and where its stripe runs there and how wide it is, px."""

    lines: Float64
    position_px: Float64
    width_px: Float64


@kernel(allocates=True)
def plate_lines(
    section: Section, on_plates: OnPlates, beyond: bool, image_dn: Integers, along_rows: bool
) -> PlateLines:
    """Return the scan lines of a section whose points (n,) are said to lie on plates or not.

    `beyond` the section's ends no plate is seen either if the plates end there, as an edge joint's do.
    """
    lines = lines_read(section, on_plates, beyond)
    if section.light.position_px.shape[0] > 0:
        leave_out_dim(lines, section.light, image_dn, along_rows)
        leave_out_hidden(lines, section.light)
    return lines


@kernel(allocates=True)
def lines_read(section: Section, on_plates: OnPlates, beyond: bool) -> PlateLines:
    """Return `plate_lines` as the points alone say: each speaks for all lines that were read as it."""
    scan, column_mm, are_on = section.points[SCAN], section.column_mm, on_plates.are_on
    n_lines = section.points[N_LINES]
    n_points, away = scan.shape[0], 1 if scan[-1] > scan[0] else -1
    pad = math.ceil((OUTSIDE_MM + SLACK_MM) / column_mm) if beyond else 0
    first, last, n_on = math.inf, -math.inf, 0
    for i in range(n_points):
        half = 0.5 * (n_lines[i] - 1.0)
        first, last = min(first, away * scan[i] - half), max(last, away * scan[i] + half)
        n_on += are_on[i]
    n = int(last - first) + 1 + 2 * pad
    places, sees = np.empty(n_points), np.full(n, UNREAD)
    for i in range(n_points):
        places[i] = away * scan[i] - first + pad
        line = int(places[i] - 0.5 * (n_lines[i] - 1.0))
        for k in range(int(n_lines[i])):
            sees[line + k] = 1.0 if are_on[i] else -1.0
    # Where the plates would be seen: what lies deep in the gap looks shifted against them.
    count = n_on if n_on > 0 else n_points
    shown, face_mm, face_per_z, k = np.empty(count), np.empty(count), np.empty(count), 0
    for i in stable_order(places):
        if are_on[i] or n_on == 0:
            shown[k], face_mm[k], face_per_z[k] = places[i], on_plates.face.y_mm[i], on_plates.face.y_per_z[i]
            k += 1
    y_mm, y_per_z = np.empty(n), np.empty(n)
    for line in range(n):
        outside = min(line - shown[0], 0.0) + max(line - shown[-1], 0.0)
        y_mm[line] = interpolated(float(line), shown, face_mm) + column_mm * outside
        y_per_z[line] = interpolated(float(line), shown, face_per_z)
    return PlateLines(sees, y_mm, y_per_z, away, int(first) - pad, column_mm)


@kernel
def interpolated(x: float, places: Float64, values: Float64) -> float:
    """Return the value at a place amid places (n,), rising, that have values (n,); beyond them the last."""
    low, high = 0, places.shape[0] - 1
    if x < places[0]:
        return float(values[0])
    if x >= places[high]:
        return float(values[high])
    while high - low > 1:
        middle = (low + high) // 2
        if places[middle] <= x:
            low = middle
        else:
            high = middle
    slope = (values[high] - values[low]) / (places[high] - places[low])
    return float(slope * (x - places[low]) + values[low])


@kernel(allocates=True)
def stripe_on_plates(lines: PlateLines, light: StripeLight) -> PlateStripe:
    """Return the stripe in the lines that show a plate."""
    n, k = 0, 0
    for line in range(lines.sees.shape[0]):
        n += lines.sees[line] > 0.0
    stripe = PlateStripe(np.empty(n), np.empty(n), np.empty(n))
    for line in range(lines.sees.shape[0]):
        if lines.sees[line] > 0.0:
            scan = lines.away * (lines.first_scan + line)
            stripe.lines[k] = line
            stripe.position_px[k], stripe.width_px[k] = light.position_px[scan], light.width_px[scan]
            k += 1
    return stripe


@kernel(allocates=True)
def usual_width(width_px: Float64) -> float:
    """Return the median of the widths (n,) that are known."""
    known, count = np.empty(width_px.shape[0]), 0
    for i in range(width_px.shape[0]):
        if not math.isnan(width_px[i]):
            known[count] = width_px[i]
            count += 1
    return exact_median(known[:count])


@kernel(allocates=True)
def leave_out_dim(lines: PlateLines, light: StripeLight, image_dn: Integers, along_rows: bool) -> None:
    """Take lines as unread that hold a stripe where the plates' is, but hardly any of its light."""
    plates = stripe_on_plates(lines, light)
    n = plates.lines.shape[0]
    if image_dn.shape[0] == 0 or n == 0:
        return
    width_px, bright = usual_width(plates.width_px), np.empty(n)
    for i in range(n):
        scan = lines.away * (lines.first_scan + int(plates.lines[i]))
        bright[i] = brightness(image_dn, along_rows, scan, plates.position_px[i], width_px)
    usual = exact_median(bright)
    for i in range(n):
        # A line with less of the plates' brightness holds what the optics throw into a gap, and no plate.
        if bright[i] < 0.25 * usual:
            lines.sees[int(plates.lines[i])] = UNREAD


@kernel(allocates=True)
def leave_out_hidden(lines: PlateLines, light: StripeLight) -> None:
    """Let lines say nothing that hold saturated pixels where the plates' stripe would be read."""
    plates = stripe_on_plates(lines, light)
    if plates.lines.shape[0] == 0:
        return
    for line in range(lines.sees.shape[0]):
        scan = lines.away * (lines.first_scan + line)
        if lines.sees[line] > 0.0 or not 0 <= scan < light.censored.shape[0]:
            continue
        path_px = interpolated(float(line), plates.lines, plates.position_px) - light.lows[scan // CELL]
        half_px = WINDOW_SIGMAS * interpolated(float(line), plates.lines, plates.width_px)
        first, last = math.floor(path_px - half_px), math.ceil(path_px + half_px)
        for v in range(max(first, 0), min(last + 1, light.censored.shape[1])):
            if light.censored[scan, v]:
                lines.sees[line] = HIDDEN


@kernel
def brightness(image_dn: Integers, along_rows: bool, scan: int, path_px: float, width_px: float) -> float:
    """Return the contrast of a scan line about a path over its surroundings, DN.

    `along_rows` says that scan lines are the frame's columns.
    """
    n_pos = image_dn.shape[0] if along_rows else image_dn.shape[1]
    middle = 0 if math.isnan(path_px) else int(np.rint(path_px))
    # Half-width of the stripe window, in stripe sigmas.
    half, far = math.ceil(width_px), math.ceil(4.0 * width_px)
    within, below, above = 0.0, 0.0, 0.0
    for v in range(middle - half, middle + half + 1):
        within += pixel(image_dn, along_rows, scan, min(max(v, 0), n_pos - 1))
        below += pixel(image_dn, along_rows, scan, min(max(v - far, 0), n_pos - 1))
        above += pixel(image_dn, along_rows, scan, min(max(v + far, 0), n_pos - 1))
    n = 2 * half + 1
    return within / n - min(below / n, above / n)


@kernel
def pixel(image_dn: Integers, along_rows: bool, scan: int, position: int) -> float:
    """Return the code of a frame's pixel of a scan line, DN."""
    return float(image_dn[position, scan] if along_rows else image_dn[scan, position])


@kernel
def best_place(lines: PlateLines, plate_mm: float, gap_mm: float, ends: bool) -> float:
    """Return the place at which two plates of a width with a gap agree best, NaN if nowhere enough."""
    plate = max(round(plate_mm / lines.column_mm), 0)
    gap = max(round(gap_mm / lines.column_mm), 0)
    outside = round(OUTSIDE_MM / lines.column_mm) if ends else 0
    n = 2 * (outside + plate) + gap
    best, highest = -1, -math.inf
    for k in range(lines.sees.shape[0] - n + 1):
        votes, agreed = 0.0, 0.0
        for i in range(n):
            from_end = min(i, n - 1 - i)
            is_plate = outside <= from_end < outside + plate
            votes += abs(lines.sees[k + i])
            agreed += lines.sees[k + i] if is_plate else -lines.sees[k + i]
        agreement = agreed / max(votes, 1.0)
        if agreement > highest:
            best, highest = k, agreement
    # By what share of the scan lines those that show what the joint would must outnumber the others.
    if highest < 0.6:
        return math.nan
    first = best + n // 2 - gap // 2
    if gap > 0 and others_between(lines, first - 1, first + gap) < MIN_LINES:
        return math.nan
    return float(lines.y_mm[best] + 0.5 * (n - 1) * lines.column_mm)


@kernel
def others_between(lines: PlateLines, first: int, last: int) -> int:
    """Return the number of scan lines between two lines that show no plate."""
    others = 0
    for line in range(first + 1, last):
        others += lines.sees[line] < 0.0
    return others


@kernel
def end_between(
    lines: PlateLines, light: StripeLight, low_mm: float, high_mm: float, plate_first: bool
) -> PlateEnd:
    """Return the end of a plate between two places: where most lines agree.

    Lines that a blurred end leaves unread before what is seen beyond may be the plate's as well.
    """
    n, first = lines.y_mm.shape[0], 0
    while first < n and lines.y_mm[first] < low_mm:
        first += 1
    last, votes, highest, earliest, latest = first, 0.0, 0.0, first, first
    while last < n and lines.y_mm[last] < high_mm:
        votes += lines.sees[last] if plate_first else -lines.sees[last]
        last += 1
        if votes > highest:
            highest, earliest = votes, last
        if votes == highest:
            latest = last
    before, behind = max(earliest - 1, 0), min(latest, n - 1)
    plate = before if plate_first else behind
    max_unread = 0 if light.position_px.shape[0] == 0 else clear_of_an_edge(light)
    unread = unread_from(lines, behind, 1) if plate_first else unread_from(lines, before, -1)
    if unread < max_unread:
        behind += unread if plate_first else 0
        before -= 0 if plate_first else unread
    low, high = lines.y_mm[max(before, 0)], lines.y_mm[min(behind, n - 1)]
    spread = max(high - low, lines.column_mm)
    return PlateEnd(0.5 * (low + high), spread**2 / 12.0, plate)


@kernel
def unread_from(lines: PlateLines, first: int, towards: int) -> int:
    """Return the number of unread lines from one on, in a direction."""
    line = first
    while 0 <= line < lines.sees.shape[0] and lines.sees[line] == UNREAD:
        line += towards
    return abs(line - first)


@kernel(allocates=True)
def end_by_shares(
    lines: PlateLines, light: StripeLight, end: PlateEnd, plate_first: bool, gap_lines: int
) -> PlateEnd:
    """Return an end at a gap of some lines as the shares say that lines hold of the plate's stripe.

    Its y is NaN where they do not tell it as well, or tell what lines that were read deny.
    """
    unresolved, n = PlateEnd(math.nan, math.nan, end.line), lines.y_mm.shape[0]
    if light.position_px.shape[0] == 0:
        return unresolved
    towards = 1 if plate_first else -1
    scan, next_one = lines.away * (lines.first_scan + end.line), end.line + towards
    if 0 <= next_one < n and lines.sees[next_one] == HIDDEN:
        return unresolved
    unread = unread_from(lines, next_one, towards)
    if not 0 <= next_one + towards * unread < n:
        unread = 0
    seen_end = stripe_end(light, scan, lines.away * towards, gap_lines, unread)
    off = lines.away * towards * (seen_end.line - scan)
    variance, blurred = (seen_end.sigma * lines.column_mm) ** 2, clear_of_an_edge(light)
    if not (variance < end.variance_mm2 and -blurred < off < unread + blurred):
        return unresolved
    line = min(max(end.line + towards * off, 0.0), n - 1.0)
    k = min(int(line), n - 2)
    y_mm = lines.y_mm[k] + (line - k) * (lines.y_mm[k + 1] - lines.y_mm[k])
    return PlateEnd(y_mm, variance, end.line)


@kernel(allocates=True)
def hold_plates(
    lines: PlateLines, light: StripeLight, image_dn: Integers, along_rows: bool, first: int, last: int
) -> bool:
    """Return True if the lines from `first` to `last` hold the plates' stripe all the same.

    Where a gap is expected the stripe is sought on what is below it, and not where the plates have it.
    """
    if light.position_px.shape[0] == 0 or image_dn.shape[0] == 0:
        return False
    plates = stripe_on_plates(lines, light)
    away = np.empty(plates.lines.shape[0])
    for i in range(away.shape[0]):
        away[i] = min(abs(plates.lines[i] - first), abs(plates.lines[i] - last))
    nearest = stable_order(away)[: 2 * BRIGHT_LINES]
    nearest = nearest[stable_order(nearest.astype(np.float64))]
    n = nearest.shape[0]
    near = PlateStripe(np.empty(n), np.empty(n), np.empty(n))
    for i in range(n):
        k = nearest[i]
        near.lines[i], near.position_px[i] = plates.lines[k], plates.position_px[k]
        near.width_px[i] = plates.width_px[k]
    width_px = usual_width(near.width_px)
    whole, held = np.empty(n), np.empty(max(last - first + 1, 0))
    for i in range(n):
        scan = lines.away * (lines.first_scan + int(near.lines[i]))
        whole[i] = brightness(image_dn, along_rows, scan, near.position_px[i], width_px)
    for i in range(held.shape[0]):
        path_px = interpolated(float(first + i), near.lines, near.position_px)
        scan = lines.away * (lines.first_scan + first + i)
        held[i] = brightness(image_dn, along_rows, scan, path_px, width_px)
    return exact_median(held) > HELD_SHARE * exact_median(whole)


@kernel
def blurred_lines(light: StripeLight) -> int:
    """Return the scan lines of a gap whose ends blur into one."""
    if light.position_px.shape[0] == 0:
        return BLURRED_LINES
    return max(BLURRED_LINES, 2 * (clear_of_an_edge(light) - 1))


@kernel(allocates=True)
def evidence_of_gap(lines: PlateLines, first: int, last: int, places: float) -> float:
    """Return the evidence, nats, that lines from `first` to `last` are a gap's and not lost by chance.

    Beyond the last line that shows a plate nothing is lost: the stripe has ended, or leaves its reach.
    """
    start, end = 0, lines.sees.shape[0]
    while not lines.sees[start] > 0.0:
        start += 1
    while not lines.sees[end - 1] > 0.0:
        end -= 1
    is_lost = np.empty(end - start, np.bool_)
    for i in range(end - start):
        is_lost[i] = lines.sees[start + i] < 0.0
    nats: float = gap_evidence_nats(is_lost, first - start, last - start, places)
    return nats
