"""The borders of what a surface point sees of the arc, in the disc that the arc's sphere makes there.

See `quadrature` for the disc's coordinates (p, q). Borders are the outline (the unit circle), the equator's
near arc (an ellipse), the lines of half-spaces, and the circles that walls cut the sphere in.
"""

from __future__ import annotations

import math

from noise_model.compiled.arrays import Float64, Vector
from noise_model.compiled.kernel import kernel
from noise_model.surface.visibility import MAX_LEDGES

MAX_NODES_P = 32
"""The most nodes across one piece of the disc."""

MAX_PIECES = 256
"""Room for the borders' crossings."""

MAX_CHORDS = 96
"""Room for the chords of several pieces: of one at least, and the chord at its middle."""

MAX_PARTS = 2 * MAX_LEDGES + 2
"""Room for the open parts of one chord."""

Axes = tuple[float, float, float, float, float, float, float, float]
"""e_w, the two level components of e_u, and e_v."""

Shape = tuple[float, float, float, float, float]
"""sin(beta), cos(beta), tan(beta), and of e_w the level part and the upright one."""


@kernel(inline=True)
def disc(P: Vector, center: Vector, radius: float) -> tuple[float, Axes, Shape]:
    """Return the arc's distance, mm, and axes and shape of the disc that P sees; NaN inside the sphere."""
    wx, wy, wz = center[0] - P[0], center[1] - P[1], center[2] - P[2]
    distance = math.sqrt(wx * wx + wy * wy + wz * wz)
    wx, wy, wz = wx / distance, wy / distance, wz / distance
    cos_e = math.sqrt(wx * wx + wy * wy)
    if cos_e > 1e-9:
        ux, uy = -wy / cos_e, wx / cos_e
    else:
        ux, uy, cos_e = 1.0, 0.0, 1e-9
    sin_b = radius / distance
    cos_b = math.sqrt(1.0 - sin_b * sin_b)
    axes = (wx, wy, wz, ux, uy, -wz * uy, wz * ux, wx * uy - wy * ux)
    return distance, axes, (sin_b, cos_b, sin_b / cos_b, cos_e, wz)


@kernel(inline=True)
def corner_p(arc: Shape) -> float:
    """Return the p at which the equator leaves the outline, -1 where none of the luminous half is seen.

    Beyond it the chord is whole (P above the equator) or dark (P below).
    """
    _, _, tan_b, cos_e, wz = arc
    sin_corner = tan_b * wz / cos_e
    if sin_corner >= 1.0:
        return -1.0
    return math.sqrt(max(0.0, 1.0 - sin_corner * sin_corner))


@kernel
def insert(breaks: Float64, n: int, p: float) -> int:
    """Put a crossing in its place among the n sorted ones (the last of them is the range's end)."""
    if n >= breaks.shape[0] or not breaks[0] < p < breaks[n - 1]:
        return n
    i = n
    while breaks[i - 1] > p:
        breaks[i] = breaks[i - 1]
        i -= 1
    breaks[i] = p
    return n + 1


@kernel(inline=True)
def equator_q(p: float, arc: Shape, whole: float) -> float:
    """Return q_0(p) of the equator's near arc, `whole` where the chord does not cross it.

    Without branches, so that `chords` finds several at a time.
    """
    sin_b, _, tan_b, cos_e, wz = arc
    # R sin(psi) = p tan(beta) (d - R cos(psi) cos(e)), solved for cos(psi).
    b, k = p * (tan_b * cos_e), p * (tan_b / sin_b)
    rest = 1.0 + b * b - k * k
    cos_psi = (k * b + math.sqrt(max(rest, 0.0))) / (1.0 + b * b)
    q = sin_b * cos_psi * wz / ((1.0 - sin_b * cos_psi * cos_e) * tan_b)
    return whole if rest < 0.0 or cos_psi * cos_e < sin_b - 1e-12 else q


@kernel
def _on_equator(a: float, b: float, c: float, arc: Shape, breaks: Float64, n: int) -> int:
    """Add the p at which the line a + b p + c q = 0 crosses the equator's near arc."""
    sin_b, cos_b, tan_b, cos_e, wz = arc
    # On the equator the line reads a_0 + a_1 cos(psi) + b sin(psi) = 0.
    a_0, a_1 = a / cos_b, c * wz - a * tan_b * cos_e
    square = a_1 * a_1 + b * b
    rest = square - a_0 * a_0
    if rest <= 0.0:
        return n
    root = math.sqrt(rest)
    for sign in (-1.0, 1.0):
        cos_psi = (-a_0 * a_1 - sign * b * root) / square
        if cos_psi * cos_e > sin_b:
            sin_psi = (-a_0 * b + sign * a_1 * root) / square
            n = insert(breaks, n, sin_b * sin_psi / ((1.0 - sin_b * cos_psi * cos_e) * tan_b))
    return n


@kernel
def on_outline(a: float, b: float, c: float, arc: Shape, breaks: Float64, n: int) -> int:
    """Add the p at which the line a + b p + c q = 0 crosses the unit circle where it shines."""
    square = b * b + c * c
    rest = square - a * a
    if rest > 0.0:
        root = math.sqrt(rest)
        for sign in (-1.0, 1.0):
            p, q = (-a * b - sign * root * c) / square, (-a * c + sign * root * b) / square
            if q > 0.0 or q > equator_q(p, arc, -1.0) + 1e-9:
                n = insert(breaks, n, p)
    return n


@kernel
def crossings(cuts: Float64, n_cuts: int, p_max: float, corner: float, arc: Shape, breaks: Float64) -> int:
    """Write the sorted p at which the borders of the open part cross, ends included; return how many.

    `cuts` (n, 3) are lines a + b p + c q = 0, `corner` is where the equator leaves the outline.
    """
    breaks[0], breaks[1] = -p_max, p_max
    n = 2
    if corner < p_max:
        n = insert(breaks, n, -corner)
        n = insert(breaks, n, corner)
    for i in range(n_cuts):
        a, b, c = cuts[i, 0], cuts[i, 1], cuts[i, 2]
        n = on_outline(a, b, c, arc, breaks, n)
        n = _on_equator(a, b, c, arc, breaks, n)
        for j in range(i):
            # Two lines: q is eliminated.
            across = b * cuts[j, 2] - cuts[j, 1] * c
            if across == 0.0:
                continue
            p = (cuts[j, 0] * c - a * cuts[j, 2]) / across
            q = (a * cuts[j, 1] - cuts[j, 0] * b) / across
            if p * p + q * q < 1.0 and q > equator_q(p, arc, -1.0):
                n = insert(breaks, n, p)
    return n


@kernel
def _project(
    x: float, y: float, z: float, P: tuple[float, float, float], axes: Axes, tan_b: float
) -> tuple[float, float]:
    """Return the (p, q) in which P sees a point."""
    wx, wy, wz, ux, uy, vx, vy, vz = axes
    dx, dy, dz = x - P[0], y - P[1], z - P[2]
    along = tan_b * (dx * wx + dy * wy + dz * wz)
    return (dx * ux + dy * uy) / along, (dx * vx + dy * vy + dz * vz) / along


@kernel(inline=True)
def sheared(axes: Axes, shear: float) -> Axes:
    """Return axes in coordinates y - shear x."""
    wx, wy, wz, ux, uy, vx, vy, vz = axes
    return wx, wy - shear * wx, wz, ux, uy - shear * ux, vx, vy - shear * vx, vz


@kernel
def ledge_crossings(
    rim: Float64,
    wall: Float64,
    P: tuple[float, float, float],
    axes: Axes,
    center: tuple[float, float, float],
    radius: float,
    arc: Shape,
    breaks: Float64,
    n: int,
) -> int:
    """Add the p at which the circle that a wall cuts the arc in ends, or meets equator, rim or outline."""
    n_y, n_z, c = wall[0], wall[1], wall[2]
    axes = sheared(axes, rim[0])
    cx, cy, cz = center[0], center[1] - rim[0] * (center[0] - P[0]), center[2]
    _, wy, wz, _, uy, _, vy, vz = axes
    sin_b, cos_b, tan_b, _, _ = arc
    # The rim's own line.
    a_rim, c_rim = (rim[1] * wy + rim[2] * wz) / tan_b, rim[1] * vy + rim[2] * vz
    n = on_outline(a_rim, rim[1] * uy, c_rim, arc, breaks, n)
    n = _on_equator(a_rim, rim[1] * uy, c_rim, arc, breaks, n)
    # The rim's vertex, on the side of P on which it lies in the wall.
    side = 1.0
    if abs(n_y * (P[1] - rim[2]) + n_z * (P[2] + rim[1]) - c) < abs(
        n_y * (P[1] + rim[2]) + n_z * (P[2] - rim[1]) - c
    ):
        side = -1.0
    for which in range(2):
        y = P[1] + side * rim[2] if which == 0 else (c - n_z * cz) / (n_y if n_y != 0.0 else 1e-300)
        z = P[2] - side * rim[1] if which == 0 else cz
        rest = radius * radius - (y - cy) ** 2 - (z - cz) ** 2
        if rest > 0.0:
            for sign in (-1.0, 1.0):
                p, _ = _project(cx + sign * math.sqrt(rest), y, z, P, axes, tan_b)
                n = insert(breaks, n, p)
    # The outermost chords that meet the circle: `wall_parts`' discriminant, over k^2, is a quadratic of p.
    distance = radius / sin_b
    tangent_2, s_2 = distance * distance - radius * radius, tan_b * tan_b
    k = c - n_y * P[1] - n_z * P[2]
    m_0, m_1, n_1 = n_y * wy + n_z * wz, tan_b * n_y * uy, tan_b * (n_y * vy + n_z * vz)
    a = k * k * s_2 + tangent_2 * n_1 * n_1
    square = s_2 * (tangent_2 * m_1 * m_1 + a)
    half = s_2 * m_1 * (distance * k - tangent_2 * m_0)
    rest = half * half + square * (
        s_2 * m_0 * (2.0 * distance * k - tangent_2 * m_0) + n_1 * n_1 * distance * distance - a
    )
    if rest > 0.0 and square > 0.0:
        for sign in (-1.0, 1.0):
            n = insert(breaks, n, (half + sign * math.sqrt(rest)) / square)
    # Points of the outline are C + R (-sin(beta) e_w + cos(beta) (cos(f) e_u + sin(f) e_v)).
    a = n_y * cy + n_z * cz - radius * sin_b * (n_y * wy + n_z * wz) - c
    return on_outline(a, radius * cos_b * n_y * uy, radius * cos_b * (n_y * vy + n_z * vz), arc, breaks, n)


@kernel
def wall_parts(
    p: float,
    low: float,
    high: float,
    P: tuple[float, float, float],
    axes: Axes,
    tan_b: float,
    distance: float,
    radius: float,
    ledges: Float64,
    n_ledges: int,
    parts: Float64,
) -> int:
    """Split a chord where it passes behind a ledge's wall; write the open parts, return how many.

    `parts` (MAX_PARTS, 3) gets begin and end of each; its third column is scratch.
    """
    # The chord's crossings with the walls go into the third column, sorted.
    parts[0, 2], parts[1, 2] = low, high
    n = 1
    tangent_2 = distance * distance - radius * radius
    s_0, s_2 = 1.0 + tan_b * tan_b * p * p, tan_b * tan_b
    for j in range(n_ledges):
        n_y, n_z, c = ledges[2 * j + 1, 0], ledges[2 * j + 1, 1], ledges[2 * j + 1, 2]
        _, wy, wz, _, uy, _, vy, vz = sheared(axes, ledges[2 * j, 0])
        # omega meets the wall at t = k / (n_0 + n_1 q), the sphere at t^2 |omega|^2 - 2 t d + d^2 - R^2 = 0.
        k = c - n_y * P[1] - n_z * P[2]
        n_0 = n_y * (wy + tan_b * p * uy) + n_z * wz
        n_1 = tan_b * (n_y * vy + n_z * vz)
        a = k * k * s_2 + tangent_2 * n_1 * n_1
        b = tangent_2 * n_0 * n_1 - distance * k * n_1
        c_0 = k * k * s_0 - 2.0 * distance * k * n_0 + tangent_2 * n_0 * n_0
        rest = b * b - a * c_0
        if a <= 0.0 or rest <= 0.0:
            continue
        for sign in (-1.0, 1.0):
            q = (-b + sign * math.sqrt(rest)) / a
            if low < q < high:
                i = n
                while parts[i - 1, 2] > q:
                    parts[i, 2] = parts[i - 1, 2]
                    i -= 1
                parts[i, 2] = q
                n += 1
                parts[n, 2] = high
    count = 0
    for i in range(n):
        begin, end = parts[i, 2], parts[i + 1, 2]
        q = 0.5 * (begin + end)
        square = s_0 + s_2 * q * q
        t = (distance - math.sqrt(max(0.0, distance * distance - square * tangent_2))) / square
        for j in range(n_ledges):
            _, wy, wz, _, uy, _, vy, vz = sheared(axes, ledges[2 * j, 0])
            y = P[1] + t * (wy + tan_b * (p * uy + q * vy))
            z = P[2] + t * (wz + tan_b * q * vz)
            if ledges[2 * j + 1, 0] * y + ledges[2 * j + 1, 1] * z < ledges[2 * j + 1, 2]:
                # Behind the wall the arc is seen above its rim alone.
                m_y, m_z = ledges[2 * j, 1], ledges[2 * j, 2]
                at_p = m_y * (wy + tan_b * p * uy) + m_z * wz
                m_v = tan_b * (m_y * vy + m_z * vz)
                if m_v > 1e-12:
                    begin = max(begin, -at_p / m_v)
                elif m_v < -1e-12:
                    end = min(end, -at_p / m_v)
                elif at_p <= 0.0:
                    begin = end
        if end > begin:
            parts[count, 0], parts[count, 1] = begin, end
            count += 1
    return count


@kernel
def disc_lines(planes: Float64, n_planes: int, axes: Axes, tan_b: float, cuts: Float64) -> int:
    """Write half-spaces as lines a + b p + c q > 0 of the disc; those it lies within are left out.

    Returns how many are left, -1 where one of them hides the whole disc.
    """
    wx, wy, wz, ux, uy, vx, vy, vz = axes
    n = 0
    for j in range(n_planes):
        mx, my, mz = planes[j, 0], planes[j, 1], planes[j, 2]
        a = (mx * wx + my * wy + mz * wz) / tan_b
        b = mx * ux + my * uy
        c = mx * vx + my * vy + mz * vz
        square = b * b + c * c
        if a * a >= square:
            if a <= 0.0:
                return -1
            continue
        cuts[n, 0], cuts[n, 1], cuts[n, 2] = a, b, c
        n += 1
    return n


@kernel(fastmath={"contract"})
def chords(
    spans: Float64, first: int, last: int, arc: Shape, below: bool, cuts: Float64, n_cuts: int
) -> None:
    """Write between which q, spans[1] and spans[2], the chords spans[0, first : last] of the disc are open.

    But for ledges and metal; the first is no less than the second where nothing is open.
    """
    for i in range(first, last):
        p = spans[0, i]
        high = math.sqrt(max(0.0, 1.0 - p * p))
        spans[1, i] = max(-high, equator_q(p, arc, high if below else -high))
        spans[2, i] = high
    for j in range(n_cuts):
        a, b, c = cuts[j, 0], cuts[j, 1], cuts[j, 2]
        if c > 1e-12:
            for i in range(first, last):
                spans[1, i] = max(spans[1, i], -(a + b * spans[0, i]) / c)
        elif c < -1e-12:
            for i in range(first, last):
                spans[2, i] = min(spans[2, i], -(a + b * spans[0, i]) / c)
        else:
            for i in range(first, last):
                spans[2, i] = spans[2, i] if a + b * spans[0, i] > 0.0 else spans[1, i]
