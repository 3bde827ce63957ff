"""By how much rays past the arc clear a lap's metal, and where they come to it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Float64, Int64
from noise_model.kernel import kernel
from noise_model.surface.faces import raised

ROOT_STEPS, ROOT_MM, ROOT_SHARE = 16, 1e-4, 1.0 / 1024.0
"""At the most so many steps to a border; what is near enough to it, in clearance and in shares of a way."""

TOGETHER = 8
"""So many rays run at a time, where registers hold four in two halves. What is left would run one by one."""

TURNED_AWAY_MM = 1e6
"""A larger clearance is of a ray that never comes to the edge."""

Edge = tuple[float, float, float, float]
"""The upper sheet's edge in plan, y = y_P + slope (x - x_P) + curve (x - x_P)^2 / 2: y_P, slope and curve;
and its height over the lower sheet."""

Metal = tuple[float, float, float, Edge, float, bool, bool, bool]
"""Height, width and pitch of the corrugation; the upper sheet's edge; a station `crest_x` at which that sheet
may hide more than at its edge; whether the edge may hide a part of the arc from P, whether the sheets may cut
into the arc, and whether P is on the upper sheet."""

STRAIGHT, ON_RIM, LAST = 0.0, 1.0, 2.0
"""How a way goes on from a ray to the next: straight, along the disc's upper rim, or not at all."""

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
    root = radius * math.sqrt(max(0.0, 1.0 - p * p - q * q))
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


@kernel(fastmath={"contract", "arcp"})
def clearances(p: Float64, q: Float64, free: Float64, n: int, rays: Rays, metal: Metal) -> None:
    """Write into `free` (n,) the `clearance` of n rays, and what is not asked for up to whole TOGETHER."""
    for i in range((n + TOGETHER - 1) // TOGETHER * TOGETHER):
        free[i] = clearance(p[i], q[i], rays, metal)


class Ways(NamedTuple):
    """Rays (n,) that are looked at together: `p`, `q`, and by how much they are `free` of the metal, mm.

    `goes_on` says how the way goes on to the next ray, and `border_q` where the clearance changes its sign on
    that way, where it does.
    """

    p: Float64
    q: Float64
    free: Float64
    goes_on: Float64
    border_q: Float64


class Crossings(NamedTuple):
    """Where the clearance changes its sign, (n,): at `p` and `q`, behind the ray whose number is `place`.

    While that is sought a way begins at `p` and `q` and goes by `p_way` and `q_way`, or `on_rim` by `p_way`
    alone. The sign changes between the shares `low` and `high` of it, whose clearances are `below` and
    `above`; `share` is the last that was looked at, at `p_now` and `q_now`, where the ray is `free` by so
    much. `on_rim`, `is_flat` and `is_known` are 0 or 1.
    """

    p: Float64
    p_way: Float64
    q: Float64
    q_way: Float64
    on_rim: Float64
    low: Float64
    high: Float64
    below: Float64
    above: Float64
    share: Float64
    is_flat: Float64
    is_known: Float64
    p_now: Float64
    q_now: Float64
    free: Float64
    place: Int64


@kernel(allocates=True)
def ways_room(n: int) -> tuple[Ways, Crossings]:
    """Return room for n rays that are looked at together, and for their crossings; n is whole TOGETHER."""
    w, c = np.zeros((5, n)), np.zeros((15, n))
    return Ways(w[0], w[1], w[2], w[3], w[4]), Crossings(
        c[0],
        c[1],
        c[2],
        c[3],
        c[4],
        c[5],
        c[6],
        c[7],
        c[8],
        c[9],
        c[10],
        c[11],
        c[12],
        c[13],
        c[14],
        np.empty(n, dtype=np.int64),
    )


@kernel
def look(ways: Ways, n: int, rays: Rays, metal: Metal, crossings: Crossings) -> int:
    """Write the clearances of n rays, and where these cross 0 on their ways; return how often they do.

    A crossing on the rim knows its p alone.
    """
    p, q, free, goes_on, border_q = ways
    clearances(p, q, free, n, rays, metal)
    count = 0
    for i in range(n - 1):
        if goes_on[i] != LAST and (free[i + 1] < 0.0) != (free[i] < 0.0):
            crossings.p[count], crossings.p_way[count] = p[i], p[i + 1] - p[i]
            crossings.q[count], crossings.q_way[count] = q[i], q[i + 1] - q[i]
            crossings.on_rim[count] = 1.0 if goes_on[i] == ON_RIM else 0.0
            crossings.below[count], crossings.above[count] = free[i], free[i + 1]
            crossings.place[count] = i
            count += 1
    _narrow(crossings, count, rays, metal)
    for k in range(count):
        crossings.p[k] += crossings.share[k] * crossings.p_way[k]
        crossings.q[k] += crossings.share[k] * crossings.q_way[k]
        border_q[crossings.place[k]] = crossings.q[k]
    return count


@kernel(fastmath={"contract"})
def _narrow(crossings: Crossings, n: int, rays: Rays, metal: Metal) -> None:
    """Find at which share of each of n ways the clearance changes its sign.

    Regula falsi with the weights of Anderson and Björck (1973), for the clearance is nearly straight; all
    ways at once, so that several rays run at a time.
    """
    p, p_way, q, q_way, on_rim, low, high, below, above, share, is_flat, is_known, p_now, q_now, free, _ = (
        crossings
    )
    for i in range(n):
        low[i], high[i], share[i], is_known[i] = 0.0, 1.0, 0.5, 0.0
        # Beside an edge rays skim the metal, however they turn, until one meets it: what is near 0 tells
        # nothing.
        is_flat[i] = 1.0 if min(abs(below[i]), abs(above[i])) < ROOT_MM else 0.0
    for step in range(ROOT_STEPS):
        for i in range(n):
            a, b, f_a, f_b = low[i], high[i], below[i], above[i]
            by_halves = step % 4 == 3 or is_flat[i] > 0.0 or max(abs(f_a), abs(f_b)) > TURNED_AWAY_MM
            way = 0.5 * (a + b) if by_halves else (a * f_b - b * f_a) / (f_b - f_a)
            way = share[i] if is_known[i] > 0.0 else way
            p_i = p[i] + way * p_way[i]
            rim_q = math.sqrt(max(0.0, 1.0 - p_i * p_i))
            share[i], p_now[i] = way, p_i
            q_now[i] = rim_q if on_rim[i] > 0.0 else q[i] + way * q_way[i]
        clearances(p_now, q_now, free, n, rays, metal)
        n_known = 0
        for i in range(n):
            if is_known[i] > 0.0 or (abs(free[i]) < ROOT_MM and is_flat[i] == 0.0):
                is_known[i] = 1.0
                n_known += 1
                continue
            if (free[i] < 0.0) == (below[i] < 0.0):
                weight = 1.0 - free[i] / below[i]
                low[i], below[i] = share[i], free[i]
                above[i] *= weight if weight > 0.0 else 0.5
            else:
                weight = 1.0 - free[i] / above[i]
                high[i], above[i] = share[i], free[i]
                below[i] *= weight if weight > 0.0 else 0.5
            if high[i] - low[i] < ROOT_SHARE:
                share[i], is_known[i] = 0.5 * (low[i] + high[i]), 1.0
                n_known += 1
        if n_known == n:
            return
