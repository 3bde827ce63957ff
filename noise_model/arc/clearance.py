"""By how much rays past the arc clear a lap's metal, and where they come to it.

Computed in float32, so that eight rays run at a time: at 100 mm it still tells 1e-5 mm apart.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Float32, Int64
from noise_model.kernel import kernel
from noise_model.surface.faces import RAISED_COSINE, raised

ZERO, HALF, UNIT, DOUBLE = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
INFINITE = np.float32(np.inf)
_RAISED = tuple(np.float32(coefficient) for coefficient in RAISED_COSINE)
"""A literal is float64, and what meets it is too."""

ROOT_STEPS, ROOT_MM, ROOT_SHARE = 16, np.float32(1e-4), np.float32(1.0 / 1024.0)
"""At the most so many steps to a border; what is near enough to it, in clearance and in shares of a way."""

TOGETHER = 8
"""So many rays run at a time: what is left of n would run one by one."""

HUGE_MM, TURNED_AWAY_MM = np.float32(1e9), np.float32(1e6)
"""The clearance of a ray that never comes to the edge, and what only such a one has."""

Edge = tuple[float, float, float, float]
"""The upper sheet's edge in plan, y = y_P + slope (x - x_P) + curve (x - x_P)^2 / 2: y_P, slope and curve;
and its height over the lower sheet."""

Metal = tuple[float, float, float, Edge, float, bool, bool, bool]
"""Height, width and pitch of the corrugation; the upper sheet's edge; a station `crest_x` at which that sheet
may hide more than at its edge; whether the edge may hide a part of the arc from P, whether the sheets may cut
into the arc, and whether P is on the upper sheet."""

STRAIGHT, ON_RIM, LAST = np.float32(0.0), np.float32(1.0), np.float32(2.0)
"""How a way goes on from a ray to the next: straight, along the disc's upper rim, or not at all."""

Rays = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float, float]
"""P, e_w, tan(beta) e_u, tan(beta) e_v, distance and radius: what a chord's rays need."""


class Passing(NamedTuple):
    """What `clearance` needs of `Rays` and `Metal`, float32.

    P is at `x` from a ridge's middle, at `z`, and `over` beyond the edge, mm; `w`, `u` and `v` are the axes.
    The corrugation has `height` and `pitch`, mm, the number of pitches in 1 mm and of half widths. The edge
    has slope, curve and step; the crest is `crest_way` along x from P, at `crest_z`.
    """

    x: np.float32
    z: np.float32
    over: np.float32
    w_x: np.float32
    w_y: np.float32
    w_z: np.float32
    u_x: np.float32
    u_y: np.float32
    u_z: np.float32
    v_x: np.float32
    v_y: np.float32
    v_z: np.float32
    distance: np.float32
    radius: np.float32
    height: np.float32
    pitch: np.float32
    pitches: np.float32
    half_widths: np.float32
    slope: np.float32
    curve: np.float32
    step: np.float32
    crest_way: np.float32
    crest_z: np.float32
    edge_hides: bool
    cuts: bool
    from_upper: bool


@kernel
def passing(rays: Rays, metal: Metal) -> Passing:
    """Return the numbers of rays from a point past the metal."""
    Px, Py, Pz, w_x, w_y, w_z, u_x, u_y, u_z, v_x, v_y, v_z, distance, radius = rays
    height, width, pitch, (edge_y, slope, curve, step), crest_x, edge_hides, cuts, from_upper = metal
    pitches, half_widths, x, crest_z = 0.0, 0.0, 0.0, math.nan
    if height > 0.0:
        pitches, half_widths = 1.0 / pitch, 2.0 / width
        # Far along the seam float32 knows a station to no more than 1e-5 mm.
        x = Px - pitch * math.floor(Px / pitch + 0.5)
        crest_z = raised(crest_x, height, width, pitch)[0] + step
    return Passing(
        np.float32(x),
        np.float32(Pz),
        np.float32(Py - edge_y),
        np.float32(w_x),
        np.float32(w_y),
        np.float32(w_z),
        np.float32(u_x),
        np.float32(u_y),
        np.float32(u_z),
        np.float32(v_x),
        np.float32(v_y),
        np.float32(v_z),
        np.float32(distance),
        np.float32(radius),
        np.float32(height),
        np.float32(pitch),
        np.float32(pitches),
        np.float32(half_widths),
        np.float32(slope),
        np.float32(curve),
        np.float32(step),
        np.float32(crest_x - Px),
        np.float32(crest_z),
        edge_hides,
        cuts,
        from_upper,
    )


@kernel(inline=True)
def _wave(x: np.float32, past: Passing) -> np.float32:
    """Return the corrugation's height x from a ridge's middle: `faces.raised` in float32."""
    share = past.half_widths * (x - past.pitch * np.floor(x * past.pitches + HALF))
    v = share * share
    rest = max(UNIT - v, ZERO)
    g = _RAISED[5] + v * (_RAISED[6] + v * _RAISED[7])
    g = _RAISED[0] + v * (_RAISED[1] + v * (_RAISED[2] + v * (_RAISED[3] + v * (_RAISED[4] + v * g))))
    return np.float32(past.height * (rest * rest * g))


@kernel(inline=True)
def clearance(p: np.float32, q: np.float32, past: Passing) -> np.float32:
    """Return by how much the ray to the arc's point at (p, q) passes over the metal, mm.

    Looked at are the upper sheet's edge and, where the ray is over that sheet by then, the crest; and the
    arc's point itself. Huge where neither can hide it. Written without branches that differ from ray to ray,
    so that `clearances` runs several at a time.
    """
    over = past.over
    ox = past.w_x + p * past.u_x + q * past.v_x
    oy = past.w_y + p * past.u_y + q * past.v_y
    oz = past.w_z + p * past.u_z + q * past.v_z
    across, square = oy - past.slope * ox, ox * ox + oy * oy + oz * oz
    # The nearer root of t^2 square - 2 t d + d^2 - R^2 = 0, for tan(beta) = R / sqrt(d^2 - R^2).
    root = past.radius * math.sqrt(max(ZERO, UNIT - p * p - q * q))
    t_arc = (past.distance - root) / square
    bend = past.curve * ox * ox
    free = HUGE_MM
    if past.cuts:
        is_lower = over + t_arc * (across - HALF * bend * t_arc) < ZERO
        level = _wave(past.x + t_arc * ox, past) + (past.step if is_lower else ZERO)
        free = past.z + t_arc * oz - level
    if past.edge_hides:
        # Over the upper sheet the ray is before it comes to the edge (`visibility.first_crossing`), or after.
        leaves = (across > ZERO) == past.from_upper and across != ZERO
        rest = across * across + DOUBLE * bend * over
        half = across + math.copysign(math.sqrt(max(rest, ZERO)), across)
        t_1, t_2 = half / bend, -DOUBLE * over / half
        t_1 = t_1 if t_1 > ZERO and rest >= ZERO else INFINITE
        t_2 = t_2 if t_2 > ZERO and rest >= ZERO else INFINITE
        on_line = -over / across if leaves else INFINITE
        t = on_line if bend == ZERO or (over == ZERO and leaves) else min(t_1, t_2)
        # A point on the edge itself hides nothing from itself.
        meets = t < t_arc and (t > ZERO or not past.from_upper)
        t_edge = t if meets else ZERO
        edge_mm = past.z + t_edge * oz - _wave(past.x + t_edge * ox, past) - past.step
        free = min(free, edge_mm if meets else HUGE_MM)
        first, last = (ZERO if past.from_upper else t), (min(t, t_arc) if past.from_upper else t_arc)
        way = past.crest_way * ox
        comes_by = first * ox * ox < way and way < last * ox * ox
        crest_mm = past.z + way / (ox * ox) * oz - past.crest_z
        free = min(free, crest_mm if comes_by else HUGE_MM)
    is_turned = not past.cuts and not past.from_upper and across >= ZERO and past.curve <= ZERO
    return HUGE_MM if is_turned else free


@kernel(fastmath={"contract", "arcp"})
def clearances(p: Float32, q: Float32, free: Float32, n: int, past: Passing) -> None:
    """Write into `free` (n,) the `clearance` of n rays, and what is not asked for up to whole TOGETHER."""
    for i in range((n + TOGETHER - 1) // TOGETHER * TOGETHER):
        free[i] = clearance(p[i], q[i], past)


class Ways(NamedTuple):
    """Rays (n,) that are looked at together: `p`, `q`, and by how much they are `free` of the metal, mm.

    `goes_on` says how the way goes on to the next ray, and `border_q` where the clearance changes its sign on
    that way, where it does.
    """

    p: Float32
    q: Float32
    free: Float32
    goes_on: Float32
    border_q: Float32


class Crossings(NamedTuple):
    """Where the clearance changes its sign, (n,): at `p` and `q`, behind the ray whose number is `place`.

    While that is sought a way begins at `p` and `q` and goes by `p_way` and `q_way`, or `on_rim` by `p_way`
    alone. The sign changes between the shares `low` and `high` of it, whose clearances are `below` and
    `above`; `share` is the last that was looked at, at `p_now` and `q_now`, where the ray is `free` by so
    much. `on_rim`, `is_flat` and `is_known` are 0 or 1.
    """

    p: Float32
    p_way: Float32
    q: Float32
    q_way: Float32
    on_rim: Float32
    low: Float32
    high: Float32
    below: Float32
    above: Float32
    share: Float32
    is_flat: Float32
    is_known: Float32
    p_now: Float32
    q_now: Float32
    free: Float32
    place: Int64


@kernel(allocates=True)
def ways_room(n: int) -> tuple[Ways, Crossings]:
    """Return room for n rays that are looked at together, and for their crossings; n is whole TOGETHER."""
    w, c = np.zeros((5, n), dtype=np.float32), np.zeros((15, n), dtype=np.float32)
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
def look(ways: Ways, n: int, past: Passing, crossings: Crossings) -> int:
    """Write the clearances of n rays, and where these cross 0 on their ways; return how often they do.

    A crossing on the rim knows its p alone.
    """
    p, q, free, goes_on, border_q = ways
    clearances(p, q, free, n, past)
    count = 0
    for i in range(n - 1):
        if goes_on[i] != LAST and (free[i + 1] < ZERO) != (free[i] < ZERO):
            crossings.p[count], crossings.p_way[count] = p[i], p[i + 1] - p[i]
            crossings.q[count], crossings.q_way[count] = q[i], q[i + 1] - q[i]
            crossings.on_rim[count] = UNIT if goes_on[i] == ON_RIM else ZERO
            crossings.below[count], crossings.above[count] = free[i], free[i + 1]
            crossings.place[count] = i
            count += 1
    _narrow(crossings, count, past)
    for k in range(count):
        crossings.p[k] += crossings.share[k] * crossings.p_way[k]
        crossings.q[k] += crossings.share[k] * crossings.q_way[k]
        border_q[crossings.place[k]] = crossings.q[k]
    return count


@kernel(fastmath={"contract"})
def _narrow(crossings: Crossings, n: int, past: Passing) -> None:
    """Find at which share of each of n ways the clearance changes its sign.

    Regula falsi with the weights of Anderson and Björck (1973), for the clearance is nearly straight; all
    ways at once, so that several rays run at a time.
    """
    p, p_way, q, q_way, on_rim, low, high, below, above, share, is_flat, is_known, p_now, q_now, free, _ = (
        crossings
    )
    for i in range(n):
        low[i], high[i], share[i], is_known[i] = ZERO, UNIT, HALF, ZERO
        # Beside an edge rays skim the metal, however they turn, until one meets it: what is near 0 tells
        # nothing.
        is_flat[i] = UNIT if min(abs(below[i]), abs(above[i])) < ROOT_MM else ZERO
    for step in range(ROOT_STEPS):
        for i in range(n):
            a, b, f_a, f_b = low[i], high[i], below[i], above[i]
            by_halves = step % 4 == 3 or is_flat[i] > ZERO or max(abs(f_a), abs(f_b)) > TURNED_AWAY_MM
            way = HALF * (a + b) if by_halves else (a * f_b - b * f_a) / (f_b - f_a)
            way = share[i] if is_known[i] > ZERO else way
            p_i = p[i] + way * p_way[i]
            rim_q = math.sqrt(max(ZERO, UNIT - p_i * p_i))
            share[i], p_now[i] = way, p_i
            q_now[i] = rim_q if on_rim[i] > ZERO else q[i] + way * q_way[i]
        clearances(p_now, q_now, free, n, past)
        n_known = 0
        for i in range(n):
            if is_known[i] > ZERO or (abs(free[i]) < ROOT_MM and is_flat[i] == ZERO):
                is_known[i] = UNIT
                n_known += 1
                continue
            if (free[i] < ZERO) == (below[i] < ZERO):
                weight = UNIT - free[i] / below[i]
                low[i], below[i] = share[i], free[i]
                above[i] *= weight if weight > ZERO else HALF
            else:
                weight = UNIT - free[i] / above[i]
                high[i], above[i] = share[i], free[i]
                below[i] *= weight if weight > ZERO else HALF
            if high[i] - low[i] < ROOT_SHARE:
                share[i], is_known[i] = HALF * (low[i] + high[i]), UNIT
                n_known += 1
        if n_known == n:
            return
