"""The arc's light on one surface point: the integral over the part of the luminous half-sphere it sees.

From a point P the sphere's outline is a circle. With e_w towards the centre, e_u level and e_v upright,
directions are omega = e_w + tan(beta) (p e_u + q e_v), (p, q) in the unit disc, and
d(omega) = tan(beta)^2 (1 + tan(beta)^2 (p^2 + q^2))^(-3/2) dp dq, sin(beta) = R / distance. The luminous
upper half ends at the near arc of the equator, an ellipse q_0(p) in closed form; whatever hides the arc cuts
the disc along straight lines (`visibility.sky_planes`). Where two of these borders cross, the open chord
changes its form: the disc is cut there (`crossings`), in each piece the chord's ends are smooth, and
Gauss-Legendre in the angle s of p = cos(s) and in q converges fast; a disc that nothing cuts has a rule of
its own across (`_outline_rule`).
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from noise_model.arc.chords import (
    MAX_CHORDS,
    MAX_NODES_P,
    MAX_PARTS,
    Axes,
    Shape,
    chords,
    corner_p,
    crossings,
    disc,
    disc_lines,
    ledge_crossings,
    wall_parts,
)
from noise_model.compiled.arrays import Float64, Point, Vector
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.surface.brdf import LobeNumbers, reflected

MAX_NODES_Q = 16
"""The most nodes up one chord."""

MAX_POINTS = 2048
"""Room for the nodes of one point's integral; what would not fit is not summed in one go."""

CURVED_FACTOR = 2.0
"""Factor on the nodes across where borders turn at places that are not looked for."""

PIECE_BEGINS = 0.0
"""The weight of a chord that is looked at alone."""

EXP_LIMIT = 40.0
"""Beyond exp(-40) a lobe is dark."""


def _outline_rule(n: int) -> tuple[Float64, Float64]:
    """Return nodes and weights (n,), n even, on [-1, 1] for u times a polynomial of u = sqrt(1 - p^2).

    The integral of a polynomial in p and q over chords that begin and end on the outline is such. It is
    twice that of u^2 / sqrt(1 - u^2) times a polynomial on [0, 1], whose Gaussian rule is found by
    Stieltjes' recurrence and Golub and Welsch (1969): exact up to u^n.
    """
    x, weight = np.polynomial.legendre.leggauss(64)
    u = np.sin(np.pi / 4.0 * (x + 1.0))
    weight = np.pi / 4.0 * weight * u * u
    middle, off_diagonal = np.zeros(n // 2), np.zeros(n // 2)
    before, now = np.zeros_like(u), np.full_like(u, 1.0 / np.sqrt(weight.sum()))
    for k in range(n // 2):
        middle[k] = weight @ (u * now * now)
        after = (u - middle[k]) * now - off_diagonal[k - 1] * before
        off_diagonal[k] = np.sqrt(weight @ (after * after))
        before, now = now, after / off_diagonal[k]
    nodes, vectors = np.linalg.eigh(
        np.diag(middle) + np.diag(off_diagonal[:-1], 1) + np.diag(off_diagonal[:-1], -1)
    )
    p, half = np.sqrt(1.0 - nodes**2), weight.sum() * vectors[0] ** 2 / nodes
    return np.concatenate([-p, p[::-1]]), np.concatenate([half, half[::-1]])


@functools.lru_cache(maxsize=1)
def gauss_nodes() -> Float64:
    """Return rules by number of nodes: (6, MAX_NODES_P + 1, MAX_NODES_P), Gauss-Legendre's but for the last.

    Row 0 and 1 are p = cos(s) on [-1, 1] and its weights with dp/ds, row 2 and 3 nodes and weights on [0, 1],
    row 4 and 5, for even numbers, `_outline_rule`.
    """
    rules = np.zeros((6, MAX_NODES_P + 1, MAX_NODES_P))
    for n in range(1, MAX_NODES_P + 1):
        x, weight = np.polynomial.legendre.leggauss(n)
        angle = np.pi / 2.0 * (x + 1.0)
        rules[0, n, :n], rules[1, n, :n] = np.cos(angle), np.pi / 2.0 * weight * np.sin(angle)
        rules[2, n, :n], rules[3, n, :n] = 0.5 * (x + 1.0), 0.5 * weight
        if n % 2 == 0:
            rules[4, n, :n], rules[5, n, :n] = _outline_rule(n)
    return rules


@kernel(inline=True)
def disc_in_lobes(tan_b: float, towards: Vector, omega_r: Vector, material: LobeNumbers) -> float:
    """Return the radius of the arc's disc over the lobe's width where that is least.

    A direction that leaves `towards`, the arc's centre, by an angle d out of the plane of omega_r moves the
    half vector h = (omega_i + omega_r) / |omega_i + omega_r| by d / (2 cos(beta)), cos(beta) = omega_i.h, in
    that plane by d / 2. So exp(-c2 alpha^2) has the width 2 cos(beta) / sqrt(c2).
    """
    hx, hy, hz = towards[0] + omega_r[0], towards[1] + omega_r[1], towards[2] + omega_r[2]
    cos_beta = 0.5 * math.sqrt(hx * hx + hy * hy + hz * hz)
    c2 = material[2] * math.exp(abs(material[4]))
    return 0.5 * tan_b * math.sqrt(c2) / max(cos_beta, 1e-9)


@kernel(inline=True)
def more_nodes(sin_b: float, tan_b: float, towards: Vector, omega_r: Vector, material: LobeNumbers) -> float:
    """Return the factor on the nodes for an arc that is near, or wide against the lobe; at least 1."""
    # From this sine of the arc's half-angle on there are more nodes, the more the nearer the point.
    near = 1.0 + 2.0 * max(0.0, sin_b - 0.35)
    # The nodes hold a disc of so many lobe's widths, to 0.25 %; a larger one has more in proportion.
    return max(near, disc_in_lobes(tan_b, towards, omega_r, material) / 2.0)


@kernel(fastmath=REDUCTION)
def _sum_round(
    points: Float64,
    n: int,
    tan_b: float,
    n_w: float,
    n_u: float,
    n_v: float,
    r_w: float,
    r_u: float,
    r_v: float,
    cos_r: float,
    kappa_diff: float,
    kappa_spec: float,
    c2: float,
) -> float:
    """Return the weighted sum of f_r cos(theta_i) (1 + tan^2 (p^2 + q^2))^(-3/2) for a round Gaussian lobe.

    Written without branches or calls so that it runs four nodes at a time: alpha^2 is `brdf.alpha_squared`'s
    series, exp(-y) is its Taylor polynomial at y / 64, squared six times (2e-8 relative at y = 5).
    """
    total = 0.0
    inverse_cos_r = 1.0 / cos_r
    for i in range(n):
        p, q = tan_b * points[0, i], tan_b * points[1, i]
        inverse = 1.0 / math.sqrt(1.0 + p * p + q * q)
        cos_i = max(0.0, (n_w + p * n_u + q * n_v) * inverse)
        inverse_h = 1.0 / math.sqrt(2.0 + 2.0 * (r_w + p * r_u + q * r_v) * inverse)
        cos_alpha = min(1.0, (cos_i + cos_r) * inverse_h)
        x = 1.0 - cos_alpha
        tail = 8.0 / 1575.0 + x * (4.0 / 2079.0 + x * (16.0 / 21021.0 + x * (2.0 / 6435.0)))
        alpha_2 = 2.0 * x * (1.0 + x * (1.0 / 6.0 + x * (2.0 / 45.0 + x * (1.0 / 70.0 + x * tail))))
        y = min(c2 * alpha_2, EXP_LIMIT) * (-1.0 / 64.0)
        fall = 1.0 + y * (1.0 + y * (0.5 + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y * (1.0 / 120.0)))))
        fall *= fall
        fall *= fall
        fall *= fall
        fall *= fall
        fall *= fall
        fall *= fall
        # G with cos(beta) = |h| / 2.
        attenuation = min(1.0, 4.0 * cos_alpha * min(cos_i, cos_r) * inverse_h)
        f_r = kappa_diff + kappa_spec * attenuation * inverse_cos_r * fall
        total += points[2, i] * f_r * cos_i * inverse * inverse * inverse
    return total


@kernel
def _sum_any(
    points: Float64,
    n: int,
    tan_b: float,
    axes: Axes,
    normal: tuple[float, float, float],
    omega_r: tuple[float, float, float],
    material: LobeNumbers,
) -> float:
    """Return the same for a lobe of any shape."""
    wx, wy, wz, ux, uy, vx, vy, vz = axes
    nx, ny, nz = normal
    total = 0.0
    for i in range(n):
        p, q = tan_b * points[0, i], tan_b * points[1, i]
        inverse = 1.0 / math.sqrt(1.0 + p * p + q * q)
        ox, oy, oz = (
            inverse * (wx + p * ux + q * vx),
            inverse * (wy + p * uy + q * vy),
            inverse * (wz + q * vz),
        )
        f_r = reflected(material, (ox, oy, oz), omega_r, normal)
        cos_i = ox * nx + oy * ny + oz * nz
        total += points[2, i] * f_r * cos_i * inverse * inverse * inverse
    return total


@kernel
def _sum(
    points: Float64,
    n: int,
    tan_b: float,
    axes: Axes,
    normal: tuple[float, float, float],
    omega_r: tuple[float, float, float],
    material: LobeNumbers,
) -> float:
    """Return the weighted sum over n nodes: `points` rows 0 to 2 are p, q and weight."""
    if n == 0:
        return 0.0
    if material[3] != 0.0 or material[4] != 0.0:
        return _sum_any(points, n, tan_b, axes, normal, omega_r, material)
    wx, wy, wz, ux, uy, vx, vy, vz = axes
    nx, ny, nz = normal
    rx, ry, rz = omega_r
    return _sum_round(
        points=points,
        n=n,
        tan_b=tan_b,
        n_w=nx * wx + ny * wy + nz * wz,
        n_u=nx * ux + ny * uy,
        n_v=nx * vx + ny * vy + nz * vz,
        r_w=rx * wx + ry * wy + rz * wz,
        r_u=rx * ux + ry * uy,
        r_v=rx * vx + ry * vy + rz * vz,
        cos_r=nx * rx + ny * ry + nz * rz,
        kappa_diff=material[0],
        kappa_spec=material[1],
        c2=material[2],
    )


class Patch(NamedTuple):
    """A surface point, mm, its unit normal, and the unit direction to the camera."""

    P: Point
    normal: Point
    omega_r: Point


class Hiding(NamedTuple):
    """Obstacles between a point and the arc.

    The first `n_planes` of `planes` are the half-spaces m.omega > 0 that are open, the first `n_ledges` pairs
    of `ledges` cut into the arc (`visibility.sky_planes`).
    """

    planes: Float64
    n_planes: int
    ledges: Float64
    n_ledges: int


class DiscRule(NamedTuple):
    """`n_p` nodes across the disc and `n_q` up a chord, of `rules` (`gauss_nodes`)."""

    rules: Float64
    n_p: int
    n_q: int


@kernel
def arc_light(
    patch: Patch,
    center: Point,
    radius: float,
    hiding: Hiding,
    material: LobeNumbers,
    rule: DiscRule,
    room: Any,
) -> float:
    """Return integral f_r cos(theta_i) d(omega) over the part of the luminous half-sphere that P sees."""
    P, normal, omega_r = patch
    planes, n_planes, ledges, n_ledges = hiding
    cuts, breaks = room.cuts[:], room.breaks[:]
    nx, ny, nz = normal
    rx, ry, rz = omega_r
    distance, axes, arc = disc(P, center, radius)
    if distance <= radius * (1.0 + 1e-9) or nx * rx + ny * ry + nz * rz <= 0.0:
        return 0.0
    corner = corner_p(arc)
    if corner < 0.0:
        return 0.0
    _, _, tan_b, _, wz = arc
    below = wz > 0.0
    p_max = corner if below else 1.0

    n_cuts = disc_lines(planes, n_planes, axes, tan_b, cuts)
    if n_cuts < 0:
        return 0.0
    n_breaks = crossings(cuts, n_cuts, p_max, corner, arc, breaks)
    for j in range(n_ledges):
        n_breaks = ledge_crossings(
            rim=ledges[2 * j],
            wall=ledges[2 * j + 1],
            P=P,
            axes=axes,
            center=center,
            radius=radius,
            arc=arc,
            breaks=breaks,
            n=n_breaks,
        )
    total = _integrate(
        patch=patch,
        axes=axes,
        arc=arc,
        distance=distance,
        radius=radius,
        p_max=p_max,
        n_cuts=n_cuts,
        n_breaks=n_breaks,
        hiding=hiding,
        material=material,
        rule=rule,
        room=room,
    )
    return total * tan_b * tan_b


@kernel(inline=True)
def _integrate(
    patch: Patch,
    axes: Axes,
    arc: Shape,
    distance: float,
    radius: float,
    p_max: float,
    n_cuts: int,
    n_breaks: int,
    hiding: Hiding,
    material: LobeNumbers,
    rule: DiscRule,
    room: Any,
) -> float:
    """Return the integral over p and q, without d(omega)'s tan(beta)^2, piece by piece between `breaks`.

    The disc reaches from -`p_max` to `p_max`.
    """
    _, _, omega_r = patch
    n_ledges = hiding.n_ledges
    rules, n_p, n_q = rule
    cuts, breaks, spans = room.cuts[:], room.breaks[:], room.spans[:]
    wx, wy, wz, _, _, _, _, _ = axes
    sin_b, _, tan_b, _, _ = arc
    below = wz > 0.0
    more = more_nodes(sin_b, tan_b, (wx, wy, wz), omega_r, material)
    n_q = math.ceil(min(float(MAX_NODES_Q), n_q * more))
    # Walls' borders have crossings that are not looked for.
    n_p = math.ceil(CURVED_FACTOR * n_p) if n_ledges > 0 else n_p
    total = 0.0
    n = 0
    for piece in range(n_breaks - 1):
        low_p, high_p = breaks[piece], breaks[piece + 1]
        middle, half = 0.5 * (low_p + high_p), 0.5 * (high_p - low_p)
        if half < 1e-9:
            continue
        share = half / p_max
        # A narrow piece of the disc still gets this share of the whole disc's nodes across.
        m = math.ceil(min(float(MAX_NODES_P), n_p * more * (share + 0.5 * (1.0 - share))))
        row = 0
        if n_breaks == 2 and n_ledges == 0:
            # Share of the nodes across that suffices where nothing cuts the disc.
            row, m = 4, 2 * math.ceil(0.5 * 0.75 * m)
        if n + m + 1 > MAX_CHORDS:
            n = _open_chords(n, arc, below, cuts, n_cuts, spans)
            total += _sum_chords(
                patch=patch,
                axes=axes,
                tan_b=tan_b,
                distance=distance,
                radius=radius,
                n_chords=n,
                n_q=n_q,
                hiding=hiding,
                material=material,
                rules=rules,
                room=room,
            )
            n = 0
        spans[0, n], spans[3, n] = middle, PIECE_BEGINS
        for i in range(m):
            spans[0, n + 1 + i] = middle + half * rules[row, m, i]
            spans[3, n + 1 + i] = half * rules[row + 1, m, i]
        n += m + 1
    n = _open_chords(n, arc, below, cuts, n_cuts, spans)
    return total + _sum_chords(
        patch=patch,
        axes=axes,
        tan_b=tan_b,
        distance=distance,
        radius=radius,
        n_chords=n,
        n_q=n_q,
        hiding=hiding,
        material=material,
        rules=rules,
        room=room,
    )


@kernel(inline=True)
def _open_chords(n: int, arc: Shape, below: bool, cuts: Float64, n_cuts: int, spans: Float64) -> int:
    """Write the ends of n chords, and leave out pieces that are dark; return how many are left.

    Nothing crosses within a piece: it is open or dark as a whole, as the chord is at its middle, which comes
    before its others and has the weight `PIECE_BEGINS`.
    """
    chords(spans, 0, n, arc, below, cuts, n_cuts)
    n_open, is_open = 0, False
    for i in range(n):
        if spans[3, i] == PIECE_BEGINS:
            is_open = spans[2, i] > spans[1, i]
        elif is_open:
            for row in range(4):
                spans[row, n_open] = spans[row, i]
            n_open += 1
    return n_open


@kernel
def _sum_chords(
    patch: Patch,
    axes: Axes,
    tan_b: float,
    distance: float,
    radius: float,
    n_chords: int,
    n_q: int,
    hiding: Hiding,
    material: LobeNumbers,
    rules: Float64,
    room: Any,
) -> float:
    """Return the integral along some chords (n_chords,), with their weights, of `n_q` nodes an open part.

    `spans` hold their p, begins, ends and weights.
    """
    P, normal, omega_r = patch
    ledges, n_ledges = hiding.ledges, hiding.n_ledges
    nodes, parts, spans = room.nodes[:], room.parts[:], room.spans[:]
    total = 0.0
    n = 0
    for i in range(n_chords):
        p, low, high = spans[0, i], spans[1, i], spans[2, i]
        if high <= low:
            continue
        parts[0, 0], parts[0, 1] = low, high
        n_parts = 1
        if n_ledges > 0:
            n_parts = wall_parts(
                p=p,
                low=low,
                high=high,
                P=P,
                axes=axes,
                tan_b=tan_b,
                distance=distance,
                radius=radius,
                ledges=ledges,
                n_ledges=n_ledges,
                parts=parts,
            )
        for k in range(n_parts):
            begin, length = parts[k, 0], parts[k, 1] - parts[k, 0]
            for j in range(n_q):
                nodes[0, n], nodes[1, n] = p, begin + length * rules[2, n_q, j]
                nodes[2, n] = spans[3, i] * length * rules[3, n_q, j]
                n += 1
        if n > MAX_POINTS - MAX_PARTS * MAX_NODES_Q:
            total += _sum(nodes, n, tan_b, axes, normal, omega_r, material)
            n = 0
    return total + _sum(nodes, n, tan_b, axes, normal, omega_r, material)
