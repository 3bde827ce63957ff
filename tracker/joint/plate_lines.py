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
from noise_model.robust import MAD_SIGMA
from tracker.joint.evidence import RUN_PRIOR, gap_evidence_nats
from tracker.joint.face_change import Columns, change_of_faces, transition_nats
from tracker.joint.measured import OFF_SIGMAS, OnFace
from tracker.profile import Section
from tracker.state import N_LINES, SCAN
from tracker.stripe.edge import MIN_CONTRAST, clear_of_an_edge, stripe_end
from tracker.stripe.light import OUTSHINES, WINDOW_SIGMAS, StripeLight

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

HIDDEN = 0.0
"""Vote of a scan line whose light does not tell whether it holds the plates' stripe."""

THROWN_SHARE, HELD_SHARE = 0.25, 0.5
"""Largest share of the plates' light that optics throw into a gap, and that of a line that is half plate."""

SHARE_SIGMAS = 2.0
"""A share is told from these two by so many of its sigmas."""

BRIGHT_SIGMAS = 4.0
"""By so many of their scatter a line may be brighter than most of a plate's: beyond, it is another light."""

MERGED_SIGMAS = 2.0
"""Two stripes have one peak if they lie no more of their sigmas apart: which is lit how much is in doubt."""

CODE_VARIANCE = 1.0 / 12.0
"""Variance of a code's rounding, DN^2."""


class StripeImage(NamedTuple):
    """A frame (H, W), DN, whose stripe runs `along_rows`; pixels from `saturation_dn` on tell no light.

    It has no pixels where the frame is not at hand.
    """

    image_dn: Integers
    along_rows: bool
    saturation_dn: int


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
    another light lies over the plates' stripe, a glint's or a streak's. `y_per_z` is by how much a line's y
    goes with the plates' height. The line i is scan line `away` (`first_scan` + i).
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
def plate_lines(section: Section, on_plates: OnPlates, beyond: bool, image: StripeImage) -> PlateLines:
    """Return the scan lines of a section whose points (n,) are said to lie on plates or not.

    `beyond` the section's ends no plate is seen either if the plates end there, as an edge joint's do.
    """
    lines = lines_read(section, on_plates, beyond)
    if section.light.position_px.shape[0] > 0:
        weigh_by_light(lines, section.light, image)
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
def weigh_by_light(lines: PlateLines, light: StripeLight, image: StripeImage) -> None:
    """Vote by what the image shows where the plates' stripe would run, whatever was read of a line.

    A streak or a glint beside the stripe keeps a line from being read, and one on a gap is read as a plate.
    So a plate has lost its light only where that is missing, and shows it only where there is about as much.
    Light adds: beside saturated pixels a plate's stripe may lie beneath as much light of another.
    """
    plates = stripe_on_plates(lines, light)
    n = lines.sees.shape[0]
    if image.image_dn.shape[0] == 0 or plates.lines.shape[0] == 0:
        return
    width_px = usual_width(plates.width_px)
    path_px, share, off, of_plates, n_known = np.empty(n), np.empty(n), np.empty(n), np.empty(n), 0
    excess, of_lit = np.empty(n), np.empty(n)
    for line in range(n):
        scan, other_px = lines.away * (lines.first_scan + line), math.nan
        path_px[line] = interpolated(float(line), plates.lines, plates.position_px)
        if lines.sees[line] == -1.0 and light.position_px[scan] != path_px[line]:
            other_px = light.position_px[scan]
        share[line], off[line] = stripe_dn(image, scan, path_px[line], width_px, other_px)
        if abs(other_px - path_px[line]) > MERGED_SIGMAS * width_px:
            off[line] = 0.0
        excess[line] = excess_e(light, scan, path_px[line])
        if lines.sees[line] > 0.0 and not math.isnan(share[line]):
            of_plates[n_known], of_lit[n_known] = share[line], excess[line]
            n_known += 1
    usual_e = exact_median(of_lit[:n_known]) if n_known > 0 else math.nan
    usual = exact_median(of_plates[:n_known]) if n_known > 0 else math.nan
    scatter = exact_median(np.abs(of_plates[:n_known] / usual - 1.0)) if n_known > 0 else math.nan
    max_share = 1.0 + BRIGHT_SIGMAS * max(MAD_SIGMA * scatter, MIN_CONTRAST)
    outshone, reach = np.zeros(n, np.bool_), clear_of_an_edge(light)
    for line in range(n):
        if is_outshone(light, lines.away * (lines.first_scan + line), path_px[line], width_px, usual_e):
            outshone[max(line - reach, 0) : line + reach + 1] = True
    for line in range(n):
        lines.sees[line] = vote(
            lines.sees[line], share[line] / usual, SHARE_SIGMAS * off[line] / usual, max_share
        )
        if lines.sees[line] < 0.0 and outshone[line] and excess[line] > THROWN_SHARE * usual_e:
            lines.sees[line] = HIDDEN


@kernel
def excess_e(light: StripeLight, scan: int, path_px: float) -> float:
    """Return the light over the background at a place of a scan line, e-, the mean of three pixels.

    NaN outside the band: lines beyond the image are asked, too.
    """
    if not 0 <= scan < light.charge_e.shape[0]:
        return math.nan
    i = round(path_px) - light.lows[scan // CELL]
    if not 1 <= i < light.charge_e.shape[1] - 1:
        return math.nan
    total = 0.0
    for j in range(i - 1, i + 2):
        total += light.charge_e[scan, j] - light.background_e[scan, j]
    return total / 3.0


@kernel
def is_outshone(light: StripeLight, scan: int, path_px: float, width_px: float, usual_e: float) -> bool:
    """Return True if a pixel is saturated that a stripe there, of so much light, would not light half."""
    if not 0 <= scan < light.charge_e.shape[0]:
        return False
    low, half = light.lows[scan // CELL], WINDOW_SIGMAS * width_px
    begin = max(math.floor(path_px - half) - low, 0)
    for j in range(begin, min(math.ceil(path_px + half) - low + 1, light.charge_e.shape[1])):
        t = (j + low - path_px) / width_px
        lit_e = light.charge_e[scan, j] - light.background_e[scan, j]
        if light.censored[scan, j] and lit_e > OUTSHINES * usual_e * math.exp(-0.5 * t * t):
            return True
    return False


@kernel
def vote(read: float, share: float, off: float, max_share: float) -> float:
    """Return a line's vote from what was `read` and the share of the plates' light, known to within `off`."""
    if math.isnan(share) or share > max_share:
        return HIDDEN
    if read > 0.0:
        # What the optics throw into a gap is no plate.
        if share < THROWN_SHARE:
            return UNREAD
        return read if share - off > THROWN_SHARE else HIDDEN
    if read == UNREAD:
        if share - off > HELD_SHARE:
            return 1.0
        return UNREAD if share + off < HELD_SHARE else HIDDEN
    return read if share + off < HELD_SHARE else HIDDEN


@kernel
def stripe_dn(
    image: StripeImage, scan: int, path_px: float, width_px: float, other_px: float
) -> tuple[float, float]:
    """Return the peak of a stripe of a width at a place of a scan line, and its 1 sigma, DN.

    They are of the least-squares bell over a sloping level, the sigma by what that leaves, beside the bell of
    another stripe, unless its place is NaN. NaN outside the image, and where half of the pixels are
    saturated.
    """
    n_scan, n_pos = image.image_dn.shape[1], image.image_dn.shape[0]
    if not image.along_rows:
        n_scan, n_pos = n_pos, n_scan
    half, middle = math.ceil(WINDOW_SIGMAS * width_px) + 1, round(path_px)
    has_other = not math.isnan(other_px)
    n, t_1, t_2, g_0, g_1, g_2 = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    h_0, h_1, h_2, g_h, v_0, v_1, v_g, v_h, v_2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    first, end = max(middle - half, 0), min(middle + half + 1, n_pos) if 0 <= scan < n_scan else 0
    # A bell's ratio from pixel to pixel goes by a constant ratio.
    inverse, t = 1.0 / width_px**2, first - path_px
    next_g, falls, by = math.exp(-0.5 * t * t * inverse), math.exp(-(t + 0.5) * inverse), math.exp(-inverse)
    for p in range(first, end):
        g, next_g = next_g, next_g * falls
        falls *= by
        v = float(image.image_dn[p, scan] if image.along_rows else image.image_dn[scan, p])
        if v >= image.saturation_dn:
            continue
        t = p - path_px
        n += 1
        t_1 += t
        t_2 += t * t
        g_0 += g
        g_1 += g * t
        g_2 += g * g
        v_0 += v
        v_1 += v * t
        v_g += v * g
        v_2 += v * v
        if has_other:
            h = math.exp(-0.5 * (p - other_px) ** 2 * inverse)
            h_0 += h
            h_1 += h * t
            h_2 += h * h
            g_h += g * h
            v_h += v * h
    spread = t_2 - t_1 * t_1 / max(n, 1)
    if n <= half or not spread > 0.0:
        return math.nan, math.nan
    # Level and slope are solved for first, the peaks with what they leave.
    tilt, rise = (g_1 - g_0 * t_1 / n) / spread, (v_1 - v_0 * t_1 / n) / spread
    own = g_2 - g_0 * g_0 / n - tilt * tilt * spread
    common = v_g - v_0 * g_0 / n - tilt * rise * spread
    residual_2, free = v_2 - v_0 * v_0 / n - rise * rise * spread, n - 3.0
    if has_other:
        other_tilt = (h_1 - h_0 * t_1 / n) / spread
        others = h_2 - h_0 * h_0 / n - other_tilt * other_tilt * spread
        if others > 0.0:
            both = g_h - g_0 * h_0 / n - tilt * other_tilt * spread
            of_other = v_h - v_0 * h_0 / n - other_tilt * rise * spread
            own, common = own - both * both / others, common - both * of_other / others
            residual_2, free = residual_2 - of_other * of_other / others, n - 4.0
    if not own > 0.0:
        return math.nan, math.nan
    residual_2 -= common * common / own
    return common / own, math.sqrt(max(residual_2 / free, CODE_VARIANCE) / own)


@kernel(allocates=True)
def best_place(lines: PlateLines, plate_mm: float, gap_mm: float, ends: bool) -> float:
    """Return the place at which two plates of a width with a gap agree best, NaN if nowhere enough."""
    plate = max(round(plate_mm / lines.column_mm), 0)
    gap = max(round(gap_mm / lines.column_mm), 0)
    outside = round(OUTSIDE_MM / lines.column_mm) if ends else 0
    n, n_lines = 2 * (outside + plate) + gap, lines.sees.shape[0]
    # Of the first k lines.
    votes, cast = np.zeros(n_lines + 1), np.zeros(n_lines + 1)
    for k in range(n_lines):
        votes[k + 1], cast[k + 1] = votes[k] + lines.sees[k], cast[k] + abs(lines.sees[k])
    best, highest = -1, -math.inf
    for k in range(n_lines - n + 1):
        right, left = k + outside, k + n - outside
        for_plates = votes[right + plate] - votes[right] + votes[left] - votes[left - plate]
        agreed = 2.0 * for_plates - (votes[k + n] - votes[k])
        agreement = agreed / max(cast[k + n] - cast[k], 1.0)
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


@kernel(allocates=True)
def end_between(
    lines: PlateLines, light: StripeLight, low_mm: float, high_mm: float, plate_first: bool
) -> PlateEnd:
    """Return the end of a plate between two places: where most lines agree.

    Lines that a blurred end leaves unread before what is seen beyond may be the plate's as well. Without
    light columns alone tell.
    """
    if light.position_px.shape[0] == 0:
        by_columns: PlateEnd = end_by_columns(lines, low_mm, high_mm, plate_first)
        return by_columns
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
    max_unread = clear_of_an_edge(light)
    unread = unread_from(lines, behind, 1) if plate_first else unread_from(lines, before, -1)
    if unread < max_unread:
        behind += unread if plate_first else 0
        before -= 0 if plate_first else unread
    low, high = lines.y_mm[max(before, 0)], lines.y_mm[min(behind, n - 1)]
    spread = max(high - low, lines.column_mm)
    return PlateEnd(0.5 * (low + high), spread**2 / 12.0, plate)


@kernel(allocates=True)
def end_by_columns(lines: PlateLines, low_mm: float, high_mm: float, plate_first: bool) -> PlateEnd:
    """Return the end of a plate between two places by which columns show it, or another surface."""
    n, first = lines.y_mm.shape[0], 0
    while first < n - 2 and lines.y_mm[first] < low_mm:
        first += 1
    end = first + 2
    while end < n and lines.y_mm[end] < high_mm:
        end += 1
    m, start, step = end - first, first if plate_first else end - 1, 1 if plate_first else -1
    seen, off_plate, on_plate, into_mm = np.empty(m, np.bool_), np.zeros(m), np.zeros(m), np.empty(m)
    # From the plate into the gap: what is missed there is no run that began on the plate.
    for k in range(m):
        sees = lines.sees[start + step * k]
        seen[k], into_mm[k] = abs(sees) == 1.0, step * lines.y_mm[start + step * k]
        if sees < 0.0:
            off_plate[k] = OFF_SIGMAS * OFF_SIGMAS
        else:
            on_plate[k] = OFF_SIGMAS * OFF_SIGMAS
    columns = Columns(seen, into_mm, into_mm, off_plate, on_plate, lines.column_mm)
    change = change_of_faces(columns, 0.0, 0.0)
    line = 0
    while line < m - 1 and into_mm[line + 1] <= change.y_mm:
        line += 1
    return PlateEnd(step * change.y_mm, change.variance_mm2, start + step * line)


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


@kernel
def blurred_lines(light: StripeLight) -> int:
    """Return the scan lines of a gap whose ends blur into one."""
    if light.position_px.shape[0] == 0:
        return BLURRED_LINES
    return max(BLURRED_LINES, 2 * (clear_of_an_edge(light) - 1))


@kernel(allocates=True)
def evidence_of_gap(lines: PlateLines, light: StripeLight, first: int, last: int, places: float) -> float:
    """Return the evidence, nats, that lines from `first` to `last` are a gap's and not lost by chance.

    Without light a gap also shows by what lies in it: a face in the place of a plate is rarer than none. Of
    both the stronger counts.
    """
    by_lost: float = evidence_of_lost(lines, -UNREAD, first, last, places)
    if light.position_px.shape[0] > 0:
        return by_lost
    by_others: float = evidence_of_lost(lines, 1.0, first, last, places)
    return max(by_lost, by_others) - math.log(2.0)


@kernel(allocates=True)
def evidence_of_lost(lines: PlateLines, votes: float, first: int, last: int, places: float) -> float:
    """Return `evidence_of_gap` of the lines that vote by so much against a plate.

    Beyond the last line that shows a plate nothing is lost: the stripe has ended, or leaves its reach.
    """
    start, end = 0, lines.sees.shape[0]
    while not lines.sees[start] > 0.0:
        start += 1
    while not lines.sees[end - 1] > 0.0:
        end -= 1
    is_lost = np.empty(end - start, np.bool_)
    for i in range(end - start):
        is_lost[i] = -lines.sees[start + i] >= votes
    nats: float = gap_evidence_nats(is_lost, first - start, last - start, places)
    return nats


@kernel(allocates=True)
def evidence_of_sheets(
    lines: PlateLines,
    n_columns: int,
    gap: tuple[int, int],
    middle_mm: float,
    outer_mm: float,
    slack_mm: float,
) -> float:
    """Return the evidence, nats, that a profile shows two upright sheets and not a plate, at one place.

    A plate would have gone on, as it does where the sheets are: between them, in the lines from the first to
    the last of the gap, and beyond their outer ends, that lie `outer_mm` off the middle, to so much slack.
    What is the plate's there against all odds is an echo.
    """
    n, nats = lines.sees.shape[0], 0.0
    seen = lines.sees > 0.0
    of_sheets, of_all = np.zeros((2, 2)), np.zeros((2, 2))
    of_sheets[0], of_all[0] = RUN_PRIOR, RUN_PRIOR
    last = -1
    for i in range(n):
        scan, off_mm = lines.away * (lines.first_scan + i), abs(lines.y_mm[i] - middle_mm)
        is_gap = gap[0] <= i <= gap[1]
        is_sheet = not is_gap and off_mm < outer_mm - slack_mm
        is_outside = outer_mm + slack_mm < off_mm < outer_mm + slack_mm + OUTSIDE_MM
        is_asked = (is_gap or is_sheet or is_outside) and 0 <= scan < n_columns
        if is_asked and (is_gap or is_outside) and seen[i]:
            nats -= 0.5 * OFF_SIGMAS * OFF_SIGMAS
        # Over the slack at an outer end nothing is asked.
        if is_asked and last >= 0:
            nats -= transition_nats(of_all, seen[last], seen[i])
            if is_sheet:
                nats += transition_nats(of_sheets, seen[last], seen[i])
        last = i if is_asked else last
    return nats
