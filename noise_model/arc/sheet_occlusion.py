"""What of the arc a lap hides that no plane through P describes, chord by chord.

The upper sheet's edge follows a corrugation, or the seam's bend, so from the lower sheet it is no straight
line; and where the torch stands on a ridge's flank, the sheets themselves cut into the arc.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.chords import MAX_NODES_P, Axes, Shape, chords, insert
from noise_model.arrays import Float64, Int64
from noise_model.kernel import kernel
from noise_model.surface.faces import raised

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

ROOT_STEPS, ROOT_MM = 16, 1e-4
"""At the most so many steps to a border, and how near to it in clearance is near enough."""

_RIM = tuple(math.cos(math.pi * i / RIM_STEPS) for i in range(RIM_STEPS + 1))

TURNED_AWAY_MM = 1e6
"""A larger clearance is of a ray that never comes to the edge."""

Edge = tuple[float, float, float, float]
"""The upper sheet's edge in plan, y = y_P + slope (x - x_P) + curve (x - x_P)^2 / 2: y_P, slope and curve;
and its height over the lower sheet."""

Metal = tuple[float, float, float, Edge, float, bool, bool, bool]
"""Height, width and pitch of the corrugation; the upper sheet's edge; a station `crest_x` at which that sheet
may hide more than at its edge; whether the edge may hide a part of the arc from P, whether the sheets may cut
into the arc, and whether P is on the upper sheet."""

Rays = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float, float]
"""P, e_w, tan(beta) e_u, tan(beta) e_v, distance and radius: what a chord's rays need."""


@kernel(inline=True)
def _wave(x: float, metal: Metal) -> float:
    """Return the corrugation's height at station x."""
    return raised(x, metal[0], metal[1], metal[2])[0]


@kernel(inline=True)
def clearance(p: float, q: float, rays: Rays, metal: Metal) -> float:
    """Return by how much the ray to the arc's point at (p, q) passes over the metal, mm.

    Looked at are the upper sheet's edge and, where the ray is over that sheet by then, the station `crest_x`;
    and the arc's point itself. Huge where neither can hide it. Written without branches that differ from ray
    to ray, so that `clearances` runs several at a time.
    """
    Px, Py, Pz, wx, wy, wz, ux, uy, uz, vx, vy, vz, distance, radius = rays
    _, _, _, edge, crest_x, edge_hides, cuts, from_upper = metal
    edge_y, slope, curve, edge_step = edge
    over = Py - edge_y
    ox, oy, oz = wx + p * ux + q * vx, wy + p * uy + q * vy, wz + p * uz + q * vz
    across, square = oy - slope * ox, ox * ox + oy * oy + oz * oz
    # t^2 square - 2 t d + d^2 - R^2 = 0, the nearer root.
    root = math.sqrt(max(0.0, distance * distance - square * (distance * distance - radius * radius)))
    t_arc = (distance - root) / square
    bend = curve * ox * ox
    free = 1e9
    if cuts:
        is_lower = over + t_arc * (across - 0.5 * bend * t_arc) < 0.0
        level = _wave(Px + t_arc * ox, metal) + (edge_step if is_lower else 0.0)
        free = Pz + t_arc * oz - level
    if edge_hides:
        # Over the upper sheet the ray is before it comes to the edge (`visibility.first_crossing`), or after.
        leaves = (across > 0.0) == from_upper and across != 0.0
        rest = across * across + 2.0 * bend * over
        half = across + math.copysign(math.sqrt(max(rest, 0.0)), across)
        t_1, t_2 = half / bend, -2.0 * over / half
        t_1 = t_1 if t_1 > 0.0 and rest >= 0.0 else math.inf
        t_2 = t_2 if t_2 > 0.0 and rest >= 0.0 else math.inf
        on_line = -over / across if leaves else math.inf
        t = on_line if bend == 0.0 or (over == 0.0 and leaves) else min(t_1, t_2)
        # A point on the edge itself hides nothing from itself.
        meets = t < t_arc and (t > 0.0 or not from_upper)
        t_edge = t if meets else 0.0
        at_edge = Pz + t_edge * oz - _wave(Px + t_edge * ox, metal) - edge_step
        free = min(free, at_edge if meets else 1e9)
        first, last = (0.0 if from_upper else t), (min(t, t_arc) if from_upper else t_arc)
        way = (crest_x - Px) * ox
        comes_by = first * ox * ox < way and way < last * ox * ox
        at_crest = Pz + way / (ox * ox) * oz - _wave(crest_x, metal) - edge_step
        free = min(free, at_crest if comes_by else 1e9)
    is_turned = not cuts and not from_upper and across >= 0.0 and curve <= 0.0
    return 1e9 if is_turned else free


@kernel(fastmath={"contract"})
def clearances(ways: Float64, n: int, rays: Rays, metal: Metal) -> None:
    """Write into ways[2] (n,) the `clearance` of n rays, whose p and q are ways[0] and ways[1]."""
    for i in range(n):
        ways[2, i] = clearance(ways[0, i], ways[1, i], rays, metal)


class Crossings(NamedTuple):
    """Ways on which the clearance changes its sign, (n,), and where.

    A way goes from `p` and `q` by `p_way` and `q_way`. The sign changes between the shares `low` and `high`
    of it, whose clearances are `below` and `above`; `share` is the last that was looked at, by `looked`
    (3, n). `is_flat` and `is_known` are 0 or 1. `place` says which pair of rays looked at began the way.
    """

    p: Float64
    p_way: Float64
    q: Float64
    q_way: Float64
    low: Float64
    high: Float64
    below: Float64
    above: Float64
    share: Float64
    is_flat: Float64
    is_known: Float64
    looked: Float64
    place: Int64


@kernel(allocates=True)
def crossings_room() -> Crossings:
    """Return room for the crossings of the rays that are looked at together."""
    n = MAX_WAYS
    return Crossings(
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty((3, n)),
        np.empty(n, dtype=np.int64),
    )


@kernel
def add_way(on: Crossings, n: int, before: int, ways: Float64) -> int:
    """Add to n ways that from one ray looked at to the next if the sign changes on it; return how many."""
    behind = before + 1
    if (ways[2, behind] < 0.0) == (ways[2, before] < 0.0):
        return n
    on.p[n], on.p_way[n] = ways[0, before], ways[0, behind] - ways[0, before]
    on.q[n], on.q_way[n] = ways[1, before], ways[1, behind] - ways[1, before]
    on.below[n], on.above[n], on.place[n] = ways[2, before], ways[2, behind], before
    return n + 1


@kernel(fastmath={"contract"})
def find_crossings(on: Crossings, n: int, on_rim: bool, rays: Rays, metal: Metal) -> None:
    """Find at which share of each of n ways the clearance changes its sign.

    Regula falsi with halved weights (Illinois), for the clearance is nearly straight; all ways at once, so
    that several rays run at a time. `on_rim` goes along the upper rim of the disc instead.
    """
    for i in range(n):
        on.low[i], on.high[i], on.share[i], on.is_known[i] = 0.0, 1.0, 0.5, 0.0
        # Beside an edge rays skim the metal, however they turn, until one meets it: what is near 0 tells
        # nothing.
        on.is_flat[i] = 1.0 if min(abs(on.below[i]), abs(on.above[i])) < ROOT_MM else 0.0
    looked = on.looked
    for step in range(ROOT_STEPS):
        for i in range(n):
            low, high, below, above = on.low[i], on.high[i], on.below[i], on.above[i]
            by_halves = step % 4 == 3 or on.is_flat[i] > 0.0 or max(abs(below), abs(above)) > TURNED_AWAY_MM
            share = 0.5 * (low + high) if by_halves else (low * above - high * below) / (above - below)
            share = on.share[i] if on.is_known[i] > 0.0 else share
            p = on.p[i] + share * on.p_way[i]
            on.share[i], looked[0, i] = share, p
            looked[1, i] = math.sqrt(max(0.0, 1.0 - p * p)) if on_rim else on.q[i] + share * on.q_way[i]
        clearances(looked, n, rays, metal)
        n_known = 0
        for i in range(n):
            free, below = looked[2, i], on.below[i]
            if on.is_known[i] > 0.0 or (abs(free) < ROOT_MM and on.is_flat[i] == 0.0):
                on.is_known[i] = 1.0
                n_known += 1
            elif (free < 0.0) == (below < 0.0):
                on.low[i], on.below[i] = on.share[i], free
                on.above[i] *= 0.5
            else:
                on.high[i], on.above[i] = on.share[i], free
                on.below[i] = 0.5 * below
        if n_known == n:
            return


@kernel
def look_along(spans: Float64, n: int, rays: Rays, metal: Metal, ways: Float64, on: Crossings) -> None:
    """Write p, q and clearance of CHORD_STEPS + 1 places on each of n `chords` into `ways`.

    Written too is, behind the clearance of a place before a border, where that is.
    """
    for i in range(n):
        low, length = spans[1, i], max(spans[2, i] - spans[1, i], 0.0)
        for j in range(CHORD_STEPS + 1):
            ways[0, (CHORD_STEPS + 1) * i + j] = spans[0, i]
            ways[1, (CHORD_STEPS + 1) * i + j] = low + length * j / CHORD_STEPS
    clearances(ways, (CHORD_STEPS + 1) * n, rays, metal)
    count = 0
    for i in range(n):
        for j in range(CHORD_STEPS):
            count = add_way(on, count, (CHORD_STEPS + 1) * i + j, ways)
    find_crossings(on, count, False, rays, metal)
    for i in range(count):
        ways[3, on.place[i]] = on.q[i] + on.share[i] * on.q_way[i]


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
    on: Crossings,
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
    clearances(ways, n, rays, metal)
    first, last = open_tops
    count = 0
    for i in range(n):
        if spans[2, i] > spans[1, i] and ways[2, i] >= 0.0:
            first, last = min(first, ways[0, i]), max(last, ways[0, i])
        if i > 0:
            # From one looked at to the next the lower ends lie nearly on a straight line.
            count = add_way(on, count, i - 1, ways)
    find_crossings(on, count, False, rays, metal)
    for k in range(count):
        i, place = on.place[k], on.p[k] + on.share[k] * on.p_way[k]
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
    on: Crossings,
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
    clearances(ways, RIM_STEPS + 1, rays, metal)
    first, last, count = p_high, p_low, 0
    for i in range(RIM_STEPS + 1):
        if ways[2, i] >= 0.0:
            first, last = min(first, ways[0, i]), max(last, ways[0, i])
        if i > 0:
            count = add_way(on, count, i - 1, ways)
    find_crossings(on, count, True, rays, metal)
    for k in range(count):
        place = on.p[k] + on.share[k] * on.p_way[k]
        n_breaks = insert(breaks, n_breaks, place)
        first, last = min(first, place), max(last, place)
    return first, last, n_breaks


@kernel
def _add_knee(rays: Rays, metal: Metal, ways: Float64, on: Crossings, breaks: Float64, n_breaks: int) -> int:
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
    clearances(ways, CHORD_STEPS + 1, rays, metal)
    count = 0
    for j in range(CHORD_STEPS):
        count = add_way(on, count, j, ways)
    find_crossings(on, count, False, rays, metal)
    for k in range(count):
        n_breaks = insert(breaks, n_breaks, on.p[k] + on.share[k] * on.p_way[k])
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
    on: Crossings,
) -> tuple[float, float, int]:
    """Add to the sorted `breaks` the p at which the metal's border turns.

    Returns between which p the disc is open, an empty range where nowhere, and how many breaks there are.
    `spans`, `ways` and `on` are scratch.
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
    p_first, p_last, n_breaks = _add_tops(p_low, p_high, rays, metal, ways, on, breaks, n_breaks)
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
        on,
        breaks,
        n_breaks,
    )
    if metal[7] and not math.isnan(metal[4]):
        n_breaks = _add_knee(rays, metal, ways, on, breaks, n_breaks)
    edge_y, slope, curve, _ = metal[3]
    square = 2.0 * curve * (edge_y - rays[1])
    if square > 0.0:
        # Ways that touch a bent edge: those on one side of them miss it.
        for sign in (-1.0, 1.0):
            along = slope + sign * math.sqrt(square)
            n_breaks = insert(breaks, n_breaks, -(wy - along * wx) / (arc[2] * (uy - along * ux)))
    return p_first, p_last, n_breaks
