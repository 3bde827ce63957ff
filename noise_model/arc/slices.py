"""Part of the arc that a point of a lap sees whose edge is no straight line, slice by slice.

An upright plane through P, at an offset d from the arc's centre in plan, cuts the sphere in a circle of
radius rho, rho^2 = R^2 - d^2. Its centre lies D ahead, D^2 = D_0^2 - d^2, and as high as the arc's. In it the
luminous half is seen from its near end, D - rho ahead, up to where the tangent from P touches it. That
tangent is as long in each slice. Metal hides what lies below a slope, and that slope is explicit: a slice
meets the sheet's edge at one known place. So nothing is sought, but where a sheet itself cuts into the arc.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float32, Float64, Point
from noise_model.compiled.kernel import kernel
from noise_model.compiled.lanes import (
    N_LANES,
    Lanes,
    Mask,
    all_lanes,
    any_lane,
    greater,
    lesser,
    load,
    root,
    spread,
    store,
    where,
)
from noise_model.surface.wave import Corrugation, from_crest, wave

MAX_SLICES = 128
"""Room for the slices of one point's integral."""

UPRIGHT = 1e-9
"""A half-space whose border is steeper than this is upright."""

FAR = 1e9
"""A slope, or a way in mm, beyond all others."""


def _fejer_rules() -> tuple[Float32, Float32]:
    """Return Chebyshev's nodes on [-1, 1] and Fejer's weights, of 16, 32 ... MAX_SLICES nodes in a row.

    The rule is exact for polynomials of a degree less than the number of nodes, and dense at both ends.
    """
    nodes, weights = [], []
    for n in range(N_LANES, MAX_SLICES + 1, N_LANES):
        angle = np.pi * (np.arange(n) + 0.5) / n
        j = np.arange(1, n // 2 + 1)
        nodes.append(-np.cos(angle))
        weights.append(
            2.0 / n * (1.0 - 2.0 * (np.cos(2.0 * np.outer(angle, j)) / (4.0 * j * j - 1.0)).sum(1))
        )
    return np.concatenate(nodes).astype(np.float32), np.concatenate(weights).astype(np.float32)


_NODES, _WEIGHTS = _fejer_rules()

SAME_MM = 1e-6
"""A point nearer to the edge in plan stands on it."""

Edge = tuple[float, float, float, float]
"""The upper sheet's edge in plan, y = y_P + slope (x - x_P) + curve (x - x_P)^2 / 2: y_P, slope and curve;
and its height over the lower sheet."""


class SlicedSheets(NamedTuple):
    """A lap's sheets, as a point P sees them on its way to the arc.

    At the station `crest_x` the upper sheet may hide more than at its `edge`. `edge_hides` says whether the
    edge may hide a part of the arc from P, `cut` whether the sheets may cut into the arc, and `from_upper`
    whether P is on the upper sheet.
    """

    corrugation: Corrugation
    edge: Edge
    crest_x: float
    edge_hides: bool
    cut: bool
    from_upper: bool


N_NUMBERS = 7
"""Number of values of a slice."""

AZIMUTH_X, AZIMUTH_Y, WEIGHT, LOW, HIGH, NEAR_LOW, NEAR_HIGH = (MAX_SLICES * row for row in range(N_NUMBERS))
"""Start of each value in the room for slices.

The azimuth's cosine and sine; d(phi); the sines of the elevations between which the arc is open; and of those
between which it is, too, where an edge stands within the arc.
"""


@kernel(inline=True)
def _rule_at(n: int) -> int:
    """Return the start of the rule of n nodes."""
    return n * (n // N_LANES - 1) // 2


@kernel(inline=True)
def _sine(slope: Lanes) -> Lanes:
    """Return the sine of an elevation from its slope."""
    return slope / root(spread(1.0) + slope * slope)


@kernel(inline=True)
def _over_edge(P: Point, edge_y: float) -> float:
    """Return the distance of P to the left of the edge at its station, mm; 0 on the edge itself."""
    over = P[1] - edge_y
    return over if abs(over) > SAME_MM else 0.0


@kernel(inline=True)
def _crossings(over: float, x: Lanes, y: Lanes, sheets: SlicedSheets) -> tuple[Lanes, Lanes]:
    """Return the ways, mm, on which slices cross the upper sheet's edge, and cross it again; FAR for never.

    P stands `over` beyond the edge; see `visibility.first_crossings`.
    """
    _, slope, curve, _ = sheets.edge
    zero, far = spread(0.0), spread(FAR)
    across = y - spread(slope) * x
    leaves = across > zero if sheets.from_upper else across < zero
    straight = where(leaves, spread(-over) / across, far)
    if curve == 0.0:
        return straight, far
    bend = spread(curve) * x * x
    rest = across * across + spread(2.0 * over) * bend
    sqrt = root(greater(rest, zero))
    half = across + where(across > zero, sqrt, zero - sqrt)
    first, second = half / bend, spread(-2.0 * over) / half
    first = where((first > zero) & (rest >= zero), first, far)
    second = where((second > zero) & (rest >= zero), second, far)
    if over == 0.0:
        return where(leaves, straight, first), where(leaves, first, far)
    return lesser(first, second), greater(first, second)


@kernel(inline=True)
def _circle(r: Lanes, ahead: Lanes, rho: Lanes, up: float) -> Lanes:
    """Return the height over P, mm, of the arc's near side at a way r in a slice."""
    off = ahead - r
    return spread(up) + root(greater(rho * rho - off * off, spread(0.0)))


@kernel(inline=True)
def _cut(
    x_0: float,
    x: Lanes,
    near: Lanes,
    end: Lanes,
    ahead: Lanes,
    rho: Lanes,
    up: float,
    lift: Lanes,
    asked: Mask,
    sheets: SlicedSheets,
) -> Lanes:
    """Return the slope at which the arc's near side rises out of a sheet, -FAR where it does all the way.

    From P, at station `x_0`, the sheet lies `lift` higher than the corrugation. Sought is between the ways
    `near` and `end`; FAR where the arc is below the sheet up to there. Slices that are not `asked` get any.
    """
    zero, unity, half = spread(0.0), spread(1.0), spread(0.5)
    length = end - near
    low, high = zero, unity
    below = _circle(near, ahead, rho, up) - wave(spread(x_0) + near * x, sheets.corrugation) - lift
    above = _circle(end, ahead, rho, up) - wave(spread(x_0) + end * x, sheets.corrugation) - lift
    is_open, is_shut = below >= zero, above < zero
    if not any_lane(asked & (below < zero)):
        return spread(-FAR)
    f_low, f_high = below, above
    share = zero
    # Steps of regula falsi in which it is found where a sheet cuts into the arc.
    for _ in range(4):
        # The near side rises with the root of the way.
        share = (low * f_high - high * f_low) / (f_high - f_low)
        r = near + length * share * share
        free = _circle(r, ahead, rho, up) - wave(spread(x_0) + r * x, sheets.corrugation) - lift
        is_below = free < zero
        # Illinois: the end that stays counts half.
        f_high = where(is_below, f_high * half, free)
        f_low = where(is_below, free, f_low * half)
        low, high = where(is_below, share, low), where(is_below, high, share)
    share = (low * f_high - high * f_low) / (f_high - f_low)
    r = near + length * share * share
    slope = _circle(r, ahead, rho, up) / r
    return where(is_open, spread(-FAR), where(is_shut, spread(FAR), slope))


@kernel(inline=True)
def _past_edge(
    P: Point,
    x_0: float,
    x: Lanes,
    crossings: tuple[Lanes, Lanes],
    hidden: Lanes,
    low: Lanes,
    near: Lanes,
    end: Lanes,
    ahead: Lanes,
    rho: Lanes,
    up: float,
    sheets: SlicedSheets,
) -> tuple[Lanes, Lanes, Lanes, Mask]:
    """Return the visible part of the arc in slices that may cross the upper sheet's edge, at two ways.

    `hidden` is the slope below which all of a slice is hidden, `low` that below which P's own sheet hides the
    arc. Returned are the slope from which the arc is seen before the edge, that up to which it is, the slope
    from which it is seen, and in which slices the edge stands within the arc and parts the two.
    """
    lift, crest = sheets.edge[3] - P[2], sheets.crest_x - P[0]
    r = greater(crossings[0], spread(SAME_MM))
    meets, behind = r < end, hidden
    if any_lane(meets):
        at_edge = (wave(spread(x_0) + r * x, sheets.corrugation) + spread(lift)) / r
        if sheets.from_upper:
            # An edge that leaves P's own sheet so near to P hides no more than P's own horizon.
            at_edge = where(r > spread(0.02), at_edge, spread(-FAR))
        behind = greater(hidden, at_edge)
        if sheets.cut:
            begin, lower, upper = lesser(greater(r, near), end), spread(-P[2]), spread(lift)
            own, other = (upper, lower) if sheets.from_upper else (lower, upper)
            # Under the arc lies P's own sheet again where the edge was crossed twice.
            under = where(crossings[1] < near, own, other)
            behind = greater(
                behind,
                _cut(
                    x_0=x_0,
                    x=x,
                    near=begin,
                    end=end,
                    ahead=ahead,
                    rho=rho,
                    up=up,
                    lift=under,
                    asked=meets,
                    sheets=sheets,
                ),
            )
    if not math.isnan(crest):
        way = spread(crest) / x
        if sheets.from_upper:
            comes_by = (way > spread(0.0)) & (way < lesser(r, end))
        else:
            comes_by = (way > r) & (way < end)
        rise = wave(spread(x_0 + crest), sheets.corrugation) + spread(lift)
        at_crest = where(comes_by, rise / way, spread(-FAR))
        behind = greater(behind, at_crest)
        if sheets.from_upper:
            low = greater(low, at_crest)
    splits = meets & (r > near)
    rim = where(splits, _circle(r, ahead, rho, up) / r, spread(0.0))
    apart = splits & (behind > rim) & (rim > low)
    after = splits & (apart | (rim <= low))
    seen = where(after, greater(behind, rim), where(meets & (r <= near), behind, low))
    return low, rim, seen, apart


@kernel(inline=True)
def lay(
    P: Point,
    center: Point,
    radius: float,
    between: tuple[float, float],
    n: int,
    planes: Float64,
    n_planes: int,
    sheets: SlicedSheets,
    room: Float32,
) -> tuple[bool, bool, bool]:
    """Lay n slices between two offsets, and write what of the arc is open there.

    Returned is whether all are open, whether one is, and whether one of them is open in two parts.
    """
    to_x, to_y, up = center[0] - P[0], center[1] - P[1], center[2] - P[2]
    plan_2 = to_x * to_x + to_y * to_y
    plan = math.sqrt(plan_2)
    to_x, to_y = to_x / plan, to_y / plan
    tangent = math.sqrt(plan_2 + up * up - radius * radius)
    edge_y, _, _, step = sheets.edge
    over = _over_edge(P, edge_y)
    x_0 = from_crest(P[0], sheets.corrugation)
    own = spread(step - P[2] if sheets.from_upper else -P[2])
    middle, half = 0.5 * (between[0] + between[1]), 0.5 * (between[1] - between[0])
    zero = spread(0.0)
    all_open, any_open, has_near, rule = True, False, False, _rule_at(n)
    for first in range(0, n, N_LANES):
        d = spread(middle) + spread(half) * load(_NODES, rule + first)
        rho = root(greater(spread(radius * radius) - d * d, zero))
        ahead = root(spread(plan_2) - d * d)
        inverse = spread(1.0 / plan)
        x = (spread(to_x) * ahead - spread(to_y) * d) * inverse
        y = (spread(to_y) * ahead + spread(to_x) * d) * inverse
        square = ahead * ahead + spread(up * up)
        high = (spread(up * tangent) + ahead * rho) / square
        near, end = ahead - rho, spread(tangent) * (ahead * spread(tangent) - spread(up) * rho) / square
        # What is hidden all the way, whichever sheet a slice is over.
        hidden = spread(up) / near
        for j in range(n_planes):
            if abs(planes[j, 2]) > UPRIGHT:
                slope = spread(-planes[j, 0]) * x - spread(planes[j, 1]) * y
                hidden = greater(hidden, slope / spread(planes[j, 2]))
        low, near_low, near_high = hidden, zero, zero
        if sheets.cut:
            low = greater(
                hidden,
                _cut(
                    x_0=x_0,
                    x=x,
                    near=near,
                    end=end,
                    ahead=ahead,
                    rho=rho,
                    up=up,
                    lift=own,
                    asked=rho >= zero,
                    sheets=sheets,
                ),
            )
        if sheets.edge_hides:
            ways = _crossings(over, x, y, sheets)
            before, rim, low, apart = _past_edge(
                P=P,
                x_0=x_0,
                x=x,
                crossings=ways,
                hidden=hidden,
                low=low,
                near=near,
                end=end,
                ahead=ahead,
                rho=rho,
                up=up,
                sheets=sheets,
            )
            if any_lane(apart):
                has_near = True
                near_low, near_high = where(apart, _sine(before), zero), where(apart, _sine(rim), zero)
        low = _sine(low)
        weight = spread(half) * load(_WEIGHTS, rule + first) / ahead
        store(room, AZIMUTH_X + first, x)
        store(room, AZIMUTH_Y + first, y)
        store(room, WEIGHT + first, weight)
        store(room, LOW + first, low)
        store(room, HIGH + first, high)
        store(room, NEAR_LOW + first, near_low)
        store(room, NEAR_HIGH + first, near_high)
        is_open = (high > low) | (near_high > near_low)
        all_open = all_open and all_lanes(is_open)
        any_open = any_open or any_lane(is_open)
    return all_open, any_open, has_near


@kernel(inline=True)
def _is_open(i: int, room: Float32) -> bool:
    """Return True if a slice is open."""
    return bool(room[HIGH + i] > room[LOW + i] or room[NEAR_HIGH + i] > room[NEAR_LOW + i])


@kernel(inline=True)
def open_ends(n: int, room: Float32) -> tuple[int, int]:
    """Return the first and the last of n slices that are open; one is."""
    first, last = 0, n - 1
    while not _is_open(first, room):
        first += 1
    while not _is_open(last, room):
        last -= 1
    return first, last


@kernel
def open_range(
    first: int, last: int, n: int, between: tuple[float, float], room: Float32
) -> tuple[float, float]:
    """Return between which offsets slices are open, at each end by a straight line to the shut neighbour."""
    return (
        between[0] if first == 0 else _border(first, first - 1, n, between, room),
        between[1] if last == n - 1 else _border(last, last + 1, n, between, room),
    )


@kernel(inline=True)
def _slope_left(i: int, room: Float32) -> float:
    """Return the open range of a slice's slope, less than 0 where it is shut."""
    low, high = room[LOW + i], room[HIGH + i]
    return float(high / math.sqrt(1.0 - high * high) - low / math.sqrt(max(1e-12, 1.0 - low * low)))


@kernel(inline=True)
def _border(i: int, j: int, n: int, between: tuple[float, float], room: Float32) -> float:
    """Return the offset at which the arc is shut, between an open slice i and its shut neighbour j.

    Beside the edge slopes rise on a straight line from where a slice comes to it first, so that the shut
    slices tell the border too. The farther of both borders is taken: shut slices cost only their lanes.
    """
    rule, k = _rule_at(n), 2 * j - i
    u_i, u_j = _NODES[rule + i], _NODES[rule + j]
    here, there = max(_slope_left(i, room), 0.0), _slope_left(j, room)
    share = here / (here - there) if here > 0.0 else 1.0
    if share < 1.0 and 0 <= k < n:
        beyond = _slope_left(k, room)
        if beyond < there:
            back = -(_NODES[rule + k] - u_j) * there / ((there - beyond) * (u_j - u_i))
            share = max(share, 1.0 - min(max(back, 0.0), 1.0))
    middle, half = 0.5 * (between[0] + between[1]), 0.5 * (between[1] - between[0])
    return float(middle + half * (u_i + share * (u_j - u_i)))


@kernel(inline=True)
def upright_range(
    radius: float, plan: float, to_x: float, to_y: float, planes: Float64, n_planes: int
) -> tuple[float, float]:
    """Return between which offsets upright half-spaces leave the arc open."""
    low, high = -radius, radius
    for j in range(n_planes):
        if abs(planes[j, 2]) > UPRIGHT:
            continue
        size = math.hypot(planes[j, 0], planes[j, 1])
        ahead = (planes[j, 0] * to_x + planes[j, 1] * to_y) / size
        aside = (planes[j, 1] * to_x - planes[j, 0] * to_y) / size
        if aside > 0.0:
            low = max(low, -ahead * plan)
        elif aside < 0.0:
            high = min(high, ahead * plan)
        elif ahead <= 0.0:
            high = low
    return low, high


@kernel(inline=True)
def parting_offset(P: Point, center: Point, radius: float, sheets: SlicedSheets) -> float:
    """Return the offset of the slice on one side of which the edge begins to hide, or to leave open.

    A slice y = (slope + m) x meets the edge, `over` mm to the right of P, at stations x with
    m(x) = curve x / 2 - over / x. From the lower sheet the edge hides where it is met before the arc, from
    the upper one it leaves open where it is met before the crest: the border is m there. On an edge that
    bends away from P, m(x) turns about at x_t = sqrt(-2 over / curve), where the slice is a tangent. Slices
    beyond m(x_t) never meet the edge, all others meet it before x_t: the border is m at the nearer of both.
    """
    edge_y, slope, curve, _ = sheets.edge
    over = _over_edge(P, edge_y)
    to_x, to_y = center[0] - P[0], center[1] - P[1]
    x = math.copysign(max(abs(to_x) - radius, radius), to_x)
    if sheets.from_upper and not math.isnan(sheets.crest_x):
        x = sheets.crest_x - P[0]
    if curve > 0.0 if sheets.from_upper else curve < 0.0:
        # On the edge itself the tangent is P's own.
        x = math.copysign(min(abs(x), math.sqrt(max(-2.0 * over / curve, SAME_MM * SAME_MM))), x)
    y = x * (slope + 0.5 * curve * x) - over
    return (to_x * y - to_y * x) / math.sqrt(x * x + y * y)
