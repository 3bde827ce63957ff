"""What of the arc a lap hides that no plane through P describes, chord by chord.

The upper sheet's edge follows a corrugation, or the seam's bend, so from the lower sheet it is no straight
line; and where the torch stands on a ridge's flank, the sheets themselves cut into the arc.
"""

from __future__ import annotations

import math

from noise_model.arc.chords import MAX_CHORDS, Axes, Shape, chords, insert
from noise_model.arc.clearance import (
    LAST,
    ON_RIM,
    STRAIGHT,
    Crossings,
    Metal,
    Rays,
    Ways,
    clearances,
    look,
)
from noise_model.arrays import Float64
from noise_model.kernel import kernel

RIM_STEPS = 8
"""In how many steps the disc's rims are searched for where the open part begins and ends."""

CLEAR_STEPS = 4
"""In how many steps to either side an arc is looked at that may be clear of the metal."""

CHORD_STEPS = 2
"""In how many steps a chord is searched for where it leaves the metal."""

MAX_WAYS = (CHORD_STEPS + 1) * MAX_CHORDS
"""Room for the rays that are looked at together."""

LOWER_END = 1e-3
"""So far up a chord its lower end is looked at: beside the border that it lies on."""

_RIM = tuple(math.cos(math.pi * i / RIM_STEPS) for i in range(RIM_STEPS + 1))


@kernel
def look_along(spans: Float64, n: int, rays: Rays, metal: Metal, ways: Ways, crossings: Crossings) -> None:
    """Look at CHORD_STEPS + 1 places on each of n `chords`, and for the borders between them."""
    for i in range(n):
        low, length = spans[1, i], max(spans[2, i] - spans[1, i], 0.0)
        for j in range(CHORD_STEPS + 1):
            way = (CHORD_STEPS + 1) * i + j
            share = j / CHORD_STEPS if j > 0 else LOWER_END
            ways.p[way], ways.q[way] = spans[0, i], low + share * length
            ways.goes_on[way] = STRAIGHT if j < CHORD_STEPS else LAST
    look(ways, (CHORD_STEPS + 1) * n, rays, metal, crossings)


@kernel
def chord_parts(i: int, low: float, high: float, ways: Ways, parts: Float64) -> int:
    """Write the parts (n, 2) of the i-th chord on which the arc passes over the metal; return how many.

    The chord, from q = `low` to `high`, has been looked at, see `look_along`.
    """
    count, first = 0, (CHORD_STEPS + 1) * i
    begin = low
    for j in range(first, first + CHORD_STEPS):
        before, free = ways.free[j], ways.free[j + 1]
        if (free < 0.0) != (before < 0.0):
            if free < 0.0:
                parts[count, 0], parts[count, 1] = begin, ways.border_q[j]
                count += 1
            begin = ways.border_q[j]
    last = first + CHORD_STEPS
    if ways.free[last] >= 0.0 and high > begin:
        parts[count, 0], parts[count, 1] = begin, high
        count += 1
    return count


@kernel
def is_clear(
    p_max: float, arc: Shape, cuts: Float64, rays: Rays, metal: Metal, spans: Float64, ways: Ways
) -> bool:
    """Say whether the whole arc passes over the metal: looked at are its lower rim and its top.

    No `cuts` are looked at; `spans` and `ways` are scratch.
    """
    n = 2 * CLEAR_STEPS + 1
    for i in range(n):
        spans[0, i] = p_max * (i - CLEAR_STEPS) / CLEAR_STEPS
    chords(spans, 0, n, arc, False, cuts, 0)
    for i in range(n):
        low, high = spans[1, i], spans[2, i]
        ways.p[i], ways.q[i] = spans[0, i], low
        ways.p[n + i], ways.q[n + i] = spans[0, i], 0.5 * (low + high)
    clearances(ways.p, ways.q, ways.free, 2 * n, rays, metal)
    least = 0.0
    for i in range(2 * n):
        least = min(least, ways.free[i])
    return least >= 0.0


@kernel
def _open_range(
    arc: Shape, below: bool, cuts: Float64, n_cuts: int, breaks: Float64, n_breaks: int, spans: Float64
) -> tuple[float, float]:
    """Return between which p the planes leave the disc open: a sliver is narrow against the whole of it."""
    n_pieces = n_breaks - 1
    p_low, p_high = breaks[n_pieces], breaks[0]
    for piece in range(n_pieces):
        spans[0, piece] = 0.5 * (breaks[piece] + breaks[piece + 1])
    chords(spans, 0, n_pieces, arc, below, cuts, n_cuts)
    for piece in range(n_pieces):
        if spans[2, piece] > spans[1, piece]:
            p_low, p_high = min(p_low, breaks[piece]), max(p_high, breaks[piece + 1])
    return p_low, p_high


@kernel
def _write_rims(spans: Float64, ways: Ways) -> None:
    """Write where the chords' tops and their lower ends are to be looked at: RIM_STEPS + 1 rays each.

    From one chord to the next the lower ends lie nearly on a straight line. `spans` are the chords.
    """
    n = RIM_STEPS + 1
    for i in range(n):
        p, low, high = spans[0, i], spans[1, i], spans[2, i]
        ways.p[i], ways.q[i] = p, math.sqrt(max(0.0, 1.0 - p * p))
        ways.p[n + i], ways.q[n + i] = p, low + LOWER_END * (high - low)
        ways.goes_on[i], ways.goes_on[n + i] = ON_RIM, STRAIGHT
    ways.goes_on[n - 1] = ways.goes_on[2 * n - 1] = LAST


@kernel
def _write_knee(rays: Rays, metal: Metal, ways: Ways, n: int) -> int:
    """Write behind n rays those along the metal's knee, if it has one; return how many there are then.

    Rays to one side of it leave the upper sheet before they come to the crest, and meet its edge; those to
    the other side meet the crest. At the knee a ray leaves the sheet at the crest: in plan it goes there.
    """
    Px, Py, _, wx, wy, _, ux, uy, _, vx, vy, _, _, _ = rays
    edge_y, slope, curve, _ = metal[3]
    dx = metal[4] - Px
    dy = edge_y - Py + dx * (slope + 0.5 * curve * dx)
    turned = ux * dy - uy * dx
    if not metal[7] or math.isnan(turned) or turned == 0.0:
        return n
    # Those rays lie on a line p = p_0 + m q of the disc.
    p_0, m = (wy * dx - wx * dy) / turned, (vy * dx - vx * dy) / turned
    square, half = 1.0 + m * m, m * p_0
    rest = half * half - square * (p_0 * p_0 - 1.0)
    if rest <= 0.0:
        return n
    root = math.sqrt(rest)
    for j in range(CHORD_STEPS + 1):
        q = (-half + root * (2.0 * j / CHORD_STEPS - 1.0)) / square
        ways.p[n + j], ways.q[n + j] = p_0 + m * q, q
        ways.goes_on[n + j] = STRAIGHT if j < CHORD_STEPS else LAST
    return n + CHORD_STEPS + 1


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
    ways: Ways,
    crossings: Crossings,
) -> tuple[float, float, int]:
    """Add to the sorted `breaks` the p at which the metal's border turns, or meets the chords' ends.

    Returns between which p the disc is open, an empty range where nowhere, and how many breaks there are. An
    upright edge that stands higher than the arc's top cuts it aslant: chords end at the metal, not begin.
    `spans`, `ways` and `crossings` are scratch.
    """
    wx, wy, wz, ux, uy, _, _, _ = axes
    below = wz > 0.0
    p_low, p_high = _open_range(arc, below, cuts, n_cuts, breaks, n_breaks, spans)
    if p_high <= p_low:
        return p_low, p_high, n_breaks
    n, middle, half = RIM_STEPS + 1, 0.5 * (p_low + p_high), 0.5 * (p_high - p_low)
    for i in range(n):
        # Even in the angle: a sliver of the arc that is left to see lies at one end, where chords are short.
        spans[0, i] = middle - half * _RIM[i]
    chords(spans, 0, n, arc, below, cuts, n_cuts)
    _write_rims(spans, ways)
    count = look(ways, _write_knee(rays, metal, ways, 2 * n), rays, metal, crossings)
    first, last = p_high, p_low
    for i in range(n):
        if ways.free[i] >= 0.0 or (spans[2, i] > spans[1, i] and ways.free[n + i] >= 0.0):
            first, last = min(first, spans[0, i]), max(last, spans[0, i])
    for k in range(count):
        p, i = crossings.p[k], crossings.place[k] - n
        n_breaks = insert(breaks, n_breaks, p)
        # A lower end counts where there is a chord; a knee ends nothing.
        if i < 0 or (i < n and (spans[2, i] > spans[1, i] or spans[2, i + 1] > spans[1, i + 1])):
            first, last = min(first, p), max(last, p)
    edge_y, slope, curve, _ = metal[3]
    square = 2.0 * curve * (edge_y - rays[1])
    if square > 0.0:
        # Ways that touch a bent edge: those on one side of them miss it.
        for sign in (-1.0, 1.0):
            along = slope + sign * math.sqrt(square)
            n_breaks = insert(breaks, n_breaks, -(wy - along * wx) / (arc[2] * (uy - along * ux)))
    return first, last, n_breaks
