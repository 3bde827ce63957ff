"""What of the arc a lap hides that no plane through P describes, chord by chord.

The upper sheet's edge follows a corrugation, or the seam's bend, so from the lower sheet it is no straight
line; and where the torch stands on a ridge's flank, the sheets themselves cut into the arc.
"""

from __future__ import annotations

import math

from noise_model.arc_disc import Shape, equator_q
from noise_model.faces import raised
from noise_model.frames import Float64
from noise_model.kernel import kernel
from noise_model.visibility import first_crossing

RIM_STEPS = 8
"""In how many steps the disc's rims are searched for where the open part begins and ends."""

CLEAR_STEPS = 4
"""In how many steps to either side an arc is looked at that may be clear of the metal."""

CHORD_STEPS = 2
"""In how many steps a chord is searched for where it leaves the metal."""

ROOT_STEPS, ROOT_MM = 16, 1e-4
"""At the most so many steps to a border, and how near to it in clearance is near enough."""

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


@kernel
def clearance(p: float, q: float, rays: Rays, metal: Metal) -> float:
    """Return by how much the ray to the arc's point at (p, q) passes over the metal, mm.

    Looked at are the upper sheet's edge and, where the ray is over that sheet by then, the station `crest_x`;
    and the arc's point itself. Huge where neither can hide it.
    """
    Px, Py, Pz, wx, wy, wz, ux, uy, uz, vx, vy, vz, distance, radius = rays
    _, _, _, edge, crest_x, edge_hides, cuts, from_upper = metal
    edge_y, slope, curve, edge_step = edge
    ox, oy = wx + p * ux + q * vx, wy + p * uy + q * vy
    across = oy - slope * ox
    if not cuts and not from_upper and across >= 0.0 and curve <= 0.0:
        return 1e9
    oz = wz + p * uz + q * vz
    square = ox * ox + oy * oy + oz * oz
    # t^2 square - 2 t d + d^2 - R^2 = 0, the nearer root.
    root = math.sqrt(max(0.0, distance * distance - square * (distance * distance - radius * radius)))
    t_arc = (distance - root) / square
    free = 1e9
    if cuts:
        over = Py - edge_y + t_arc * (across - 0.5 * curve * ox * ox * t_arc)
        level = _wave(Px + t_arc * ox, metal) + (edge_step if over < 0.0 else 0.0)
        free = Pz + t_arc * oz - level
    if edge_hides:
        # Over the upper sheet the ray is before it comes to the edge, or after.
        t = first_crossing(Py - edge_y, across, curve * ox * ox, from_upper)
        first, last = (0.0, min(t, t_arc)) if from_upper else (t, t_arc)
        # A point on the edge itself hides nothing from itself.
        if t < t_arc and (t > 0.0 or not from_upper):
            free = min(free, Pz + t * oz - _wave(Px + t * ox, metal) - edge_step)
        way = (crest_x - Px) * ox
        if first * ox * ox < way < last * ox * ox:
            free = min(free, Pz + way / (ox * ox) * oz - _wave(crest_x, metal) - edge_step)
    return free


@kernel
def border(
    p: tuple[float, float],
    q: tuple[float, float],
    on_rim: bool,
    at_ends: tuple[float, float],
    rays: Rays,
    metal: Metal,
) -> float:
    """Return at which share of the way from (p[0], q[0]) to (p[1], q[1]) the clearance changes its sign.

    `at_ends` are the clearances there, of unlike signs. `on_rim` goes from p[0] to p[1] along the upper rim
    of the disc instead.
    """
    low, high = 0.0, 1.0
    below, above = at_ends
    share = 0.5
    for i in range(ROOT_STEPS):
        if max(abs(below), abs(above)) > TURNED_AWAY_MM or i % 4 == 3:
            share = 0.5 * (low + high)
        else:
            # Regula falsi with halved weights (Illinois): the clearance is nearly straight.
            share = (low * above - high * below) / (above - below)
        p_i = p[0] + share * (p[1] - p[0])
        q_i = math.sqrt(max(0.0, 1.0 - p_i * p_i)) if on_rim else q[0] + share * (q[1] - q[0])
        free = clearance(p_i, q_i, rays, metal)
        if abs(free) < ROOT_MM:
            break
        if (free < 0.0) == (below < 0.0):
            low, below = share, free
            above *= 0.5
        else:
            high, above = share, free
            below *= 0.5
    return share


@kernel
def chord_parts(p: float, low: float, high: float, rays: Rays, metal: Metal, parts: Float64) -> int:
    """Write the parts (n, 2) of a chord on which the arc passes over the metal; return how many."""
    count = 0
    before = clearance(p, low, rays, metal)
    begin, q_before = low, low
    for i in range(CHORD_STEPS):
        q = low + (high - low) * (i + 1) / CHORD_STEPS
        free = clearance(p, q, rays, metal)
        if (free < 0.0) != (before < 0.0):
            share = border((p, p), (q_before, q), False, (before, free), rays, metal)
            at = q_before + share * (q - q_before)
            if free < 0.0:
                parts[count, 0], parts[count, 1] = begin, at
                count += 1
            begin = at
        before, q_before = free, q
    if before >= 0.0 and high > begin:
        parts[count, 0], parts[count, 1] = begin, high
        count += 1
    return count


@kernel
def is_clear(p_max: float, arc: Shape, rays: Rays, metal: Metal) -> bool:
    """Say whether the whole arc passes over the metal: looked at are its lower rim and its top."""
    for i in range(-CLEAR_STEPS, CLEAR_STEPS + 1):
        p = p_max * i / CLEAR_STEPS
        high = math.sqrt(max(0.0, 1.0 - p * p))
        low = max(-high, equator_q(p, arc, -high))
        if clearance(p, low, rays, metal) < 0.0 or clearance(p, 0.5 * (low + high), rays, metal) < 0.0:
            return False
    return True


@kernel
def open_range(p_low: float, p_high: float, rays: Rays, metal: Metal) -> tuple[float, float]:
    """Return between which p the tops of the chords are open; an empty range where none is."""
    first, last = RIM_STEPS + 1, -1
    middle, half = 0.5 * (p_low + p_high), 0.5 * (p_high - p_low)
    for i in range(RIM_STEPS + 1):
        # Even in the angle: a sliver of the arc that is left to see lies at one end, where chords are short.
        p = middle - half * math.cos(math.pi * i / RIM_STEPS)
        if clearance(p, math.sqrt(max(0.0, 1.0 - p * p)), rays, metal) >= 0.0:
            first, last = min(first, i), i
    if last < 0:
        return p_high, p_low
    for i_open, i_hidden in ((first, first - 1), (last, last + 1)):
        if not 0 <= i_hidden <= RIM_STEPS:
            continue
        p_hidden = middle - half * math.cos(math.pi * i_hidden / RIM_STEPS)
        p_open = middle - half * math.cos(math.pi * i_open / RIM_STEPS)
        ends = (
            clearance(p_hidden, math.sqrt(max(0.0, 1.0 - p_hidden * p_hidden)), rays, metal),
            clearance(p_open, math.sqrt(max(0.0, 1.0 - p_open * p_open)), rays, metal),
        )
        p = p_hidden + border((p_hidden, p_open), (0.0, 0.0), True, ends, rays, metal) * (p_open - p_hidden)
        p_low, p_high = (p, p_high) if i_hidden < i_open else (p_low, p)
    return p_low, p_high
