"""Light that leaves a point of the joint after one reflection, and the sight between two points of it."""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.arc.chords import chords, corner_p, disc, disc_lines
from noise_model.arc.quadrature import gauss_nodes
from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Float64, Point
from noise_model.compiled.kernel import kernel
from noise_model.instrument.laser import SHEET_REACH, Sheet, sheet_of, sheet_reflected
from noise_model.setup import Setup
from noise_model.surface.brdf import LobeNumbers, lobe_numbers, reflected
from noise_model.surface.faces import ridge

DiscNodes = tuple[Float64, Float64, Float64, Float64]

DISC_FAR, DISC_NEAR = (6, 4), (8, 6)
"""Nodes across and up the arc's disc: where it looks small, and from closer than `NEAR_RADII`.

With 4 across a level plate would send 1.2 % too little: cos(theta_i) times a chord is u^2, u = sqrt(1 - p^2).
"""

MAX_CHORDS = max(DISC_FAR[0], DISC_NEAR[0])
"""Room for the chords across the arc's disc."""

NEAR_RADII = 4.0


class Place(NamedTuple):
    """A pose's surface and sources in the joint frame, as the kernels take them; mm.

    `center` (3,) is the arc's, `far` and `near` the nodes on its disc.
    """

    vertices: Float64
    corrugation: Float64
    material: LobeNumbers
    center: Float64
    radius: float
    sheet: Sheet
    far: DiscNodes
    near: DiscNodes


def place(setup: Setup, scene: Scene) -> Place:
    """Gather a scene for the kernels."""
    return Place(
        vertices=scene.shape.vertices,
        corrugation=scene.shape.corrugation,
        material=lobe_numbers(setup.material),
        center=scene.center_mm,
        radius=setup.arc.radius_mm,
        sheet=sheet_of(setup.laser, scene.T_joint_tool),
        far=_disc_nodes(*DISC_FAR),
        near=_disc_nodes(*DISC_NEAR),
    )


def _disc_nodes(n_p: int, n_q: int) -> DiscNodes:
    """Return Gauss-Legendre nodes and weights: p on [-1, 1] in the angle of p = cos(s), q on [0, 1]."""
    rules = gauss_nodes()
    return rules[0, n_p, :n_p], rules[1, n_p, :n_p], rules[2, n_q, :n_q], rules[3, n_q, :n_q]


@kernel
def sees(P: Point, Q: Point, vertices: Float64, corrugation: Float64) -> bool:
    """Return True if nothing stands between P and Q, neither of which lies below the surface.

    A polyline is highest over a straight way at its vertices. A corrugation is highest over it at the ends,
    at a sheet's edge, or where its bumps' convex upper halves run parallel to it, a closed form: exact.
    """
    (px, py, pz), (qx, qy, _) = P, Q
    dx, dy, dz = qx - px, qy - py, Q[2] - pz
    for k in range(1, vertices.shape[0] - 1):
        y_k = vertices[k, 0]
        if not min(py, qy) < y_k < max(py, qy):
            continue
        t = (y_k - py) / dy
        c, _ = ridge(px + t * dx, corrugation)
        if pz + t * dz < vertices[k, 1] + c - 1e-9:
            return False
    height, width, pitch = corrugation[0], corrugation[1], corrugation[2]
    if height == 0.0 or abs(dx) < 1e-12:
        return True
    omega = 2.0 * math.pi / width
    # The bump's slope is -height omega/2 sin(omega u): where it is the way's.
    sine = -2.0 * dz / dx / (height * omega)
    if abs(sine) >= 1.0:
        return True
    u = math.asin(sine) / omega
    crest = 0.5 * height * (1.0 + math.sqrt(1.0 - sine * sine))
    first, last = math.ceil((min(px, qx) - u) / pitch), math.floor((max(px, qx) - u) / pitch)
    for bump in range(first, last + 1):
        t = (bump * pitch + u - px) / dx
        if not 1e-9 < t < 1.0 - 1e-9:
            continue
        # Only a lap is corrugated: its upper sheet ends at vertex 1.
        y = py + t * dy
        sheet = vertices[1, 1] if y < vertices[1, 0] - 1e-12 else vertices[2, 1]
        if pz + t * dz < sheet + crest - 1e-9:
            return False
    return True


@kernel(inline=True)
def below_surface(x: float, y: float, z: float, vertices: Float64, corrugation: Float64) -> bool:
    """Return True if a point lies in the workpiece."""
    c, _ = ridge(x, corrugation)
    for k in range(vertices.shape[0] - 1):
        width = vertices[k + 1, 0] - vertices[k, 0]
        if width > 0.0 and vertices[k, 0] <= y <= vertices[k + 1, 0]:
            share = (y - vertices[k, 0]) / width
            return bool(z < vertices[k, 1] + share * (vertices[k + 1, 1] - vertices[k, 1]) + c - 1e-9)
    return False


@kernel
def _borders(k: Place, Q: Float64, normal: Float64, borders: Float64) -> int:
    """Write the half-spaces m.omega > 0 in which Q sees the arc, as far as they are exact; return how many.

    They are Q's own horizon and the planes through those vertices of a straight section that stand between Q
    and the arc and are no higher than its foot (`visibility.sky_planes`).
    """
    borders[0, 0], borders[0, 1], borders[0, 2] = normal[0], normal[1], normal[2]
    count = 1
    if k.corrugation[0] > 0.0:
        return count
    for i in range(1, k.vertices.shape[0] - 1):
        dy, dz = k.vertices[i, 0] - Q[1], k.vertices[i, 1] - Q[2]
        if k.vertices[i, 1] > k.center[2] + 1e-9 or dz <= 1e-9 or dy * normal[1] + dz * normal[2] <= 1e-9:
            continue
        side = 1.0 if dy > 0.0 else -1.0
        if (k.center[1] - k.vertices[i, 0]) * side + k.radius > 0.0:
            borders[count, 0], borders[count, 1], borders[count, 2] = 0.0, -side * dz, side * dy
            count += 1
    return count


@kernel
def arc_leaving(
    k: Place, Q: Float64, normal: Float64, omega_r: Point, borders: Float64, spans: Float64
) -> float:
    """Return the arc's light that Q reflects along `omega_r`: integral f_r cos(theta_i) d(omega).

    In units of the arc's radiance, over what Q sees of the luminous half, by the disc of `quadrature`.
    What hides it otherwise than along a straight border is looked up node by node. `borders` (n_vertices, 3)
    and `spans` (3, `MAX_CHORDS`) are room for the lines and the chords of the disc.
    """
    nx, ny, nz = normal[0], normal[1], normal[2]
    if omega_r[0] * nx + omega_r[1] * ny + omega_r[2] * nz <= 0.0:
        return 0.0
    radius = k.radius
    distance, axes, arc = disc(Q, k.center, radius)
    wx, wy, wz, ux, uy, vx, vy, vz = axes
    if distance <= radius * (1.0 + 1e-9) or (nx * wx + ny * wy + nz * wz) * distance <= -radius:
        return 0.0
    p_nodes, p_weights, q_nodes, q_weights = k.near if distance < NEAR_RADII * radius else k.far
    corner = corner_p(arc)
    if corner < 0.0:
        return 0.0
    below, tan_b = wz > 0.0, arc[2]
    p_high = corner if below else 1.0
    p_low = -p_high
    n_borders = disc_lines(borders, _borders(k, Q, normal, borders), axes, tan_b, borders)
    if n_borders < 0:
        return 0.0
    # Chords that lie beyond one of the lines as a whole are left out.
    for j in range(n_borders):
        m_w, m_u, m_v = borders[j, 0], borders[j, 1], borders[j, 2]
        square = m_u * m_u + m_v * m_v
        middle = -m_w * m_u / square
        half = math.sqrt(square - m_w * m_w) * abs(m_v) / square
        if m_w + m_u <= 0.0:
            p_high = min(p_high, middle + half)
        if m_w - m_u <= 0.0:
            p_low = max(p_low, middle - half)
    if p_high <= p_low:
        return 0.0
    total = 0.0
    n_chords = p_nodes.shape[0]
    for i in range(n_chords):
        spans[0, i] = 0.5 * (p_low + p_high + (p_high - p_low) * p_nodes[i])
    chords(spans, 0, n_chords, arc, below, borders, n_borders)
    for i in range(n_chords):
        p, low, high = spans[0, i], spans[1, i], spans[2, i]
        if high <= low:
            continue
        column = 0.0
        for j in range(q_nodes.shape[0]):
            q = low + (high - low) * q_nodes[j]
            ox = wx + tan_b * (p * ux + q * vx)
            oy = wy + tan_b * (p * uy + q * vy)
            oz = wz + tan_b * q * vz
            square = 1.0 + tan_b * tan_b * (p * p + q * q)
            length = math.sqrt(square)
            cos_i = (ox * nx + oy * ny + oz * nz) / length
            if cos_i <= 0.0:
                continue
            root = math.sqrt(max(0.0, distance * distance - square * (distance * distance - radius * radius)))
            t = (distance - root) / square
            ax, ay, az = Q[0] + t * ox, Q[1] + t * oy, Q[2] + t * oz
            if below_surface(ax, ay, az, k.vertices, k.corrugation):
                continue
            if not sees((Q[0], Q[1], Q[2]), (ax, ay, az), k.vertices, k.corrugation):
                continue
            f_r = reflected(k.material, (ox / length, oy / length, oz / length), omega_r, normal)
            column += q_weights[j] * f_r * cos_i / (square * length)
        total += 0.5 * (p_high - p_low) * p_weights[i] * (high - low) * column
    return total * tan_b * tan_b


@kernel
def laser_leaving(k: Place, Q: Float64, normal: Float64, omega_r: Point) -> float:
    """Return the laser's light that Q reflects along `omega_r`: `laser.irradiance` times f_r."""
    light: float = sheet_reflected(k.sheet, k.material, Q, normal, omega_r, SHEET_REACH)
    if light == 0.0:
        return 0.0
    x, y, z = k.sheet.origin
    return light if sees((Q[0], Q[1], Q[2]), (x, y, z), k.vertices, k.corrugation) else 0.0
