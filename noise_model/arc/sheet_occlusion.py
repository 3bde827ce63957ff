"""What of the arc a lap hides that no plane through P describes, chord by chord.

The upper sheet's edge follows a corrugation, or the seam's bend, so from the lower sheet it is no straight
line; and where the torch stands on a ridge's flank, the sheets themselves cut into the arc.
"""

from __future__ import annotations

import math

from noise_model.arc.chords import MAX_NODES_P, Axes, Shape, chords, insert
from noise_model.arc.clearance import Crossings, Metal, Rays, clearances, look
from noise_model.arrays import Float64
from noise_model.kernel import kernel

RIM_STEPS = 8
"""In how many steps the disc's rims are searched for where the open part begins and ends."""

CLEAR_STEPS = 4
"""In how many steps to either side an arc is looked at that may be clear of the metal."""

CHORD_STEPS = 2
"""In how many steps a chord is searched for where it leaves the metal."""

MAX_WAYS = (CHORD_STEPS + 1) * MAX_NODES_P
"""Room for the rays that are looked at together: a piece's chords are most."""

LOWER_END = 1e-3
"""So far up a chord its lower end is looked at: beside the border that it lies on."""

_RIM = tuple(math.cos(math.pi * i / RIM_STEPS) for i in range(RIM_STEPS + 1))


@kernel
def look_along(spans: Float64, n: int, rays: Rays, metal: Metal, ways: Float64, crossings: Crossings) -> None:
    """Write p, q and clearance of CHORD_STEPS + 1 places on each of n `chords` into `ways`.

    Written too is, behind the clearance of a place before a border, where that is.
    """
    for i in range(n):
        low, length = spans[1, i], max(spans[2, i] - spans[1, i], 0.0)
        for j in range(CHORD_STEPS + 1):
            ways[0, (CHORD_STEPS + 1) * i + j] = spans[0, i]
            ways[1, (CHORD_STEPS + 1) * i + j] = low + length * j / CHORD_STEPS
    together = CHORD_STEPS + 1
    for k in range(look(ways, together * n, together, False, rays, metal, crossings)):
        ways[3, crossings.place[k]] = crossings.q[k]


@kernel
def chord_parts(i: int, ways: Float64, parts: Float64) -> int:
    """Write the parts (n, 2) of the i-th chord on which the arc passes over the metal; return how many.

    The chord has been looked at, see `look_along`.
    """
    count, first = 0, (CHORD_STEPS + 1) * i
    begin = ways[1, first]
    for j in range(first, first + CHORD_STEPS):
        before, free = ways[2, j], ways[2, j + 1]
        if (free < 0.0) != (before < 0.0):
            if free < 0.0:
                parts[count, 0], parts[count, 1] = begin, ways[3, j]
                count += 1
            begin = ways[3, j]
    last = first + CHORD_STEPS
    if ways[2, last] >= 0.0 and ways[1, last] > begin:
        parts[count, 0], parts[count, 1] = begin, ways[1, last]
        count += 1
    return count


@kernel
def is_clear(
    p_max: float, arc: Shape, cuts: Float64, rays: Rays, metal: Metal, spans: Float64, ways: Float64
) -> bool:
    """Say whether the whole arc passes over the metal: looked at are its lower rim and its top.

    No `cuts` are looked at; `spans` and `ways` are scratch.
    """
    n = 2 * CLEAR_STEPS + 1
    for i in range(n):
        spans[0, i] = p_max * (i - CLEAR_STEPS) / CLEAR_STEPS
    chords(spans, n, arc, False, cuts, 0)
    for i in range(n):
        low, high = spans[1, i], spans[2, i]
        ways[0, i], ways[1, i] = spans[0, i], low
        ways[0, n + i], ways[1, n + i] = spans[0, i], 0.5 * (low + high)
    clearances(ways, 2 * n, rays, metal)
    least = 0.0
    for i in range(2 * n):
        least = min(least, ways[2, i])
    return least >= 0.0


@kernel
def _add_lower_ends(
    p_low: float,
    p_high: float,
    open_tops: tuple[float, float],
    arc: Shape,
    below: bool,
    cuts: Float64,
    n_cuts: int,
    rays: Rays,
    metal: Metal,
    spans: Float64,
    ways: Float64,
    crossings: Crossings,
    breaks: Float64,
    n_breaks: int,
) -> tuple[float, float, int]:
    """Add to the sorted `breaks` the p at which the metal's border meets the chords' lower ends.

    Returns a range of p that holds `open_tops` and all chords whose lower ends are open, and how many breaks
    there are. An upright edge that stands higher than the arc's top cuts it aslant: chords end at the metal,
    not begin.
    """
    middle, half = 0.5 * (p_low + p_high), 0.5 * (p_high - p_low)
    n = RIM_STEPS + 1
    for i in range(n):
        spans[0, i] = middle - half * _RIM[i]
    chords(spans, n, arc, below, cuts, n_cuts)
    for i in range(n):
        ways[0, i], ways[1, i] = spans[0, i], spans[1, i] + LOWER_END * (spans[2, i] - spans[1, i])
    # From one looked at to the next the lower ends lie nearly on a straight line.
    count = look(ways, n, n, False, rays, metal, crossings)
    first, last = open_tops
    for i in range(n):
        if spans[2, i] > spans[1, i] and ways[2, i] >= 0.0:
            first, last = min(first, ways[0, i]), max(last, ways[0, i])
    for k in range(count):
        i, place = crossings.place[k], crossings.p[k]
        n_breaks = insert(breaks, n_breaks, place)
        if spans[2, i] > spans[1, i] or spans[2, i + 1] > spans[1, i + 1]:
            first, last = min(first, place), max(last, place)
    return first, last, n_breaks


@kernel
def _add_tops(
    p_low: float,
    p_high: float,
    rays: Rays,
    metal: Metal,
    ways: Float64,
    crossings: Crossings,
    breaks: Float64,
    n_breaks: int,
) -> tuple[float, float, int]:
    """Add to the sorted `breaks` the p at which the metal's border meets the tops of the chords.

    Returns between which p the tops are open, an empty range where none is, and how many breaks there are.
    """
    middle, half = 0.5 * (p_low + p_high), 0.5 * (p_high - p_low)
    for i in range(RIM_STEPS + 1):
        # Even in the angle: a sliver of the arc that is left to see lies at one end, where chords are short.
        p = middle - half * _RIM[i]
        ways[0, i], ways[1, i] = p, math.sqrt(max(0.0, 1.0 - p * p))
    count = look(ways, RIM_STEPS + 1, RIM_STEPS + 1, True, rays, metal, crossings)
    first, last = p_high, p_low
    for i in range(RIM_STEPS + 1):
        if ways[2, i] >= 0.0:
            first, last = min(first, ways[0, i]), max(last, ways[0, i])
    for k in range(count):
        n_breaks = insert(breaks, n_breaks, crossings.p[k])
        first, last = min(first, crossings.p[k]), max(last, crossings.p[k])
    return first, last, n_breaks


@kernel
def _add_knee(
    rays: Rays, metal: Metal, ways: Float64, crossings: Crossings, breaks: Float64, n_breaks: int
) -> int:
    """Add to the sorted `breaks` the p of the metal's knee; return how many breaks there are.

    Rays to one side of it leave the upper sheet before they come to the crest, and meet its edge; those to
    the other side meet the crest. At the knee a ray leaves the sheet at the crest: in plan it goes there.
    """
    Px, Py, _, wx, wy, _, ux, uy, _, vx, vy, _, _, _ = rays
    edge_y, slope, curve, _ = metal[3]
    dx = metal[4] - Px
    dy = edge_y - Py + dx * (slope + 0.5 * curve * dx)
    turned = ux * dy - uy * dx
    if turned == 0.0:
        return n_breaks
    # Those rays lie on a line p = p_0 + m q of the disc.
    p_0, m = (wy * dx - wx * dy) / turned, (vy * dx - vx * dy) / turned
    square, half = 1.0 + m * m, m * p_0
    rest = half * half - square * (p_0 * p_0 - 1.0)
    if rest <= 0.0:
        return n_breaks
    root = math.sqrt(rest)
    for j in range(CHORD_STEPS + 1):
        q = (-half + root * (2.0 * j / CHORD_STEPS - 1.0)) / square
        ways[0, j], ways[1, j] = p_0 + m * q, q
    for k in range(look(ways, CHORD_STEPS + 1, CHORD_STEPS + 1, False, rays, metal, crossings)):
        n_breaks = insert(breaks, n_breaks, crossings.p[k])
    return n_breaks


@kernel
def clip(
    axes: Axes,
    arc: Shape,
    cuts: Float64,
    n_cuts: int,
    rays: Rays,
    metal: Metal,
    breaks: Float64,
    n_breaks: int,
    spans: Float64,
    ways: Float64,
    crossings: Crossings,
) -> tuple[float, float, int]:
    """Add to the sorted `breaks` the p at which the metal's border turns.

    Returns between which p the disc is open, an empty range where nowhere, and how many breaks there are.
    `spans`, `ways` and `crossings` are scratch.
    """
    wx, wy, wz, ux, uy, _, _, _ = axes
    below = wz > 0.0
    # Searched is what the planes leave open: a sliver is narrow against the whole disc.
    n_pieces = n_breaks - 1
    p_low, p_high = breaks[n_pieces], breaks[0]
    for piece in range(n_pieces):
        spans[0, piece] = 0.5 * (breaks[piece] + breaks[piece + 1])
    chords(spans, n_pieces, arc, below, cuts, n_cuts)
    for piece in range(n_pieces):
        if spans[2, piece] > spans[1, piece]:
            p_low, p_high = min(p_low, breaks[piece]), max(p_high, breaks[piece + 1])
    if p_high <= p_low:
        return p_low, p_high, n_breaks
    p_first, p_last, n_breaks = _add_tops(p_low, p_high, rays, metal, ways, crossings, breaks, n_breaks)
    p_first, p_last, n_breaks = _add_lower_ends(
        p_low,
        p_high,
        (p_first, p_last),
        arc,
        below,
        cuts,
        n_cuts,
        rays,
        metal,
        spans,
        ways,
        crossings,
        breaks,
        n_breaks,
    )
    if metal[7] and not math.isnan(metal[4]):
        n_breaks = _add_knee(rays, metal, ways, crossings, breaks, n_breaks)
    edge_y, slope, curve, _ = metal[3]
    square = 2.0 * curve * (edge_y - rays[1])
    if square > 0.0:
        # Ways that touch a bent edge: those on one side of them miss it.
        for sign in (-1.0, 1.0):
            along = slope + sign * math.sqrt(square)
            n_breaks = insert(breaks, n_breaks, -(wy - along * wx) / (arc[2] * (uy - along * ux)))
    return p_first, p_last, n_breaks
