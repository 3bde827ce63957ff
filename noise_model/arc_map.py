"""The arc map: per pixel the mean of the arc's light for the robot's present pose (Eq. 8-14, 18).

The arc is a Lambertian emitter, so L cos(phi) dA / r^2 is L d(omega) and a pixel receives

    radiance_e cos^4 * integral over the visible directions of f_r(omega, omega_r) cos(theta_i) d(omega).

From a surface point P the sphere's outline is a circle. With e_w towards the centre, e_u level and e_v
upright, directions are omega = e_w + tan(beta) (p e_u + q e_v), (p, q) in the unit disc, and
d(omega) = tan(beta)^2 (1 + tan(beta)^2 (p^2 + q^2))^(-3/2) dp dq, sin(beta) = R / distance. The luminous
upper half ends at the near arc of the equator, an ellipse q_0(p) in closed form; whatever hides the arc cuts
the disc along straight lines (`visibility.sky_planes`). So for each p the open range of q is known exactly
and what is left is a smooth integral: Gauss-Legendre in the angle s of p = cos(s) and in q.

Over the image the map is smooth on each face, so a band or a whole frame is filled cell by cell: corners and
centre are computed, and where they agree with a bilinear surface the rest is read off it (`arc_band`).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from noise_model.brdf import LobeNumbers, lobe_fall, lobe_numbers
from noise_model.frames import Float64, invert
from noise_model.setup import Setup
from noise_model.surface import NOMINAL_SEAM, SeamLine, Section, corrugation_height, seam_frame, section
from noise_model.visibility import (
    MAX_LEDGES,
    MAX_PLANES,
    MISS,
    face_normal,
    first_hit,
    horizon_tables,
    ridge,
    sky_planes,
    touch,
)

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
Nodes = tuple[Float64, Float64, Float64, Float64]
Axes = tuple[float, float, float, float, float, float, float, float]
"""e_w, the two level components of e_u, and e_v."""

NODES_P, NODES_Q = 6, 4
"""Nodes across and up; where something cuts the disc, `CUT_FACTOR` times as many across."""

CUT_FACTOR = 2

CELL, CELL_DEPTH, SMALLEST = 8, 24, 4
"""The cells that a band is filled by, px: scan lines and depth at first, and the size that is not halved."""

EDGE_STEPS, TURNED_AWAY_MM = 8, 1e6
"""Steps of the search for an edge's shadow; a larger clearance is of a ray that never comes to the edge."""

RIM_STEPS = 8
"""In how many steps the outline is searched for where a corrugated edge crosses it."""

SCRATCH_ROWS = MAX_PLANES + 2 * MAX_LEDGES + 4
"""What `arc_at_ray` needs: half-spaces, ledges, and four vectors of its own."""


@dataclass(frozen=True)
class Scene:
    """Camera, arc and surface of one pose in the joint frame, as the kernels take them.

    `T_joint_camera` (4, 4) mm, `T_joint_tool` (4, 4) mm, `center_mm` (3,) the arc's centre, `shape` the
    section, `horizon_start` and `horizons` the corrugation's horizon tables.
    """

    T_joint_tool: Float64
    T_joint_camera: Float64
    center_mm: Float64
    shape: Section
    horizon_start: float
    horizons: Float64

    @property
    def below_surface(self) -> bool:
        """Whether the camera stands in or under the workpiece, where no prediction makes sense."""
        x, y, z = self.T_joint_camera[:3, 3]
        plain = float(np.interp(y, self.shape.vertices[:, 0], self.shape.vertices[:, 1]))
        return bool(z <= plain + float(corrugation_height(np.array(x), self.shape.corrugation)))


@functools.lru_cache(maxsize=8)
def _disc_nodes(n_p: int, n_q: int) -> Nodes:
    """Return p nodes and weights on [-1, 1] and q nodes and weights on [0, 1]."""
    # Gauss-Legendre in the angle s of p = cos(s): chords end like sin(s) at the outline, like 1 at a cut.
    s, s_weight = np.polynomial.legendre.leggauss(n_p)
    angle = np.pi / 2.0 * (s + 1.0)
    p, p_weight = np.cos(angle), np.pi / 2.0 * s_weight * np.sin(angle)
    q, q_weight = np.polynomial.legendre.leggauss(n_q)
    return p, p_weight, (q + 1.0) / 2.0, q_weight / 2.0


def scene(setup: Setup, T_base_tool: Float64, seam: SeamLine = NOMINAL_SEAM) -> Scene:
    """Put camera, arc and surface of a pose into the joint frame.

    Where the true seam runs beside its nominal line, the joint frame, the section and the arc that stands on
    it go with it.
    """
    T_base_joint = seam_frame(setup.joint, _ahead(setup, T_base_tool)) @ seam.frame()
    T_joint_tool = invert(T_base_joint) @ T_base_tool
    T_joint_camera = T_joint_tool @ setup.camera.T_tool_camera
    shape = section(setup.joint)
    offset = np.asarray(setup.arc.center_in_tool_mm)
    center = T_joint_tool[:3, :3] @ offset + T_joint_tool[:3, 3]
    if setup.arc.on_surface:
        # Over the surface the arc keeps its height, and a tilted tool carries its foot sideways.
        center[2] = offset[2] + float(corrugation_height(center[0], shape.corrugation))
    x_range = _footprint(setup, T_joint_camera, float(shape.corrugation[0]))
    start, horizons = horizon_tables(shape, x_range, center, setup.arc.radius_mm)
    return Scene(T_joint_tool, T_joint_camera, center, shape, start, horizons)


def _ahead(setup: Setup, T_base_tool: Float64) -> Float64:
    """Return the point of base below the laser, by which the seam's line segment is chosen."""
    x, y, _ = setup.laser.origin_in_tool_mm
    return np.asarray(T_base_tool[:3, :3] @ np.array([x, y, 0.0]) + T_base_tool[:3, 3])


def _footprint(setup: Setup, T_joint_camera: Float64, height_mm: float) -> tuple[float, float]:
    """Return the stations between which the camera sees the plate, whatever its height."""
    camera = setup.camera
    w, h = camera.width - 1.0, camera.height - 1.0
    corners = camera.normalised([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
    d = np.column_stack([corners, np.ones(4)]) @ T_joint_camera[:3, :3].T
    origin = T_joint_camera[:3, 3]
    # A ray that does not go down meets no plate: it is followed to a slope of 1 in 10 at most.
    down = np.minimum(d[:, 2], -0.1 * np.linalg.norm(d, axis=1))
    x = [origin[0] + (level - origin[2]) / down * d[:, 0] for level in (0.0, height_mm)]
    return float(np.min(x)), float(np.max(x))


@numba.njit(cache=True, inline="always")
def _way_to_sphere(square: float, distance: float, radius: float) -> float:
    """Return how far the sphere is along omega, in units of omega; omega.e_w = 1, `square` is omega^2."""
    # t^2 square - 2 t d + d^2 - R^2 = 0, the nearer root.
    root: float = math.sqrt(max(0.0, distance * distance - square * (distance * distance - radius * radius)))
    return (distance - root) / square


@numba.njit(cache=True, inline="always")
def _edge_clearance(
    P: Float64,
    axes: Axes,
    tan_b: float,
    p: float,
    q: float,
    distance: float,
    radius: float,
    corrugation: Float64,
    edge_y: float,
    edge_step: float,
    crest_x: float,
) -> float:
    """Return how far a ray from P passes over a corrugated lap's upper sheet, mm; huge if the arc is nearer.

    Looked at are the sheet's edge and, where the ray is over the sheet by then, the station `crest_x`.
    """
    wx, wy, wz, ux, uy, vx, vy, vz = axes
    oy = wy + tan_b * (p * uy + q * vy)
    if oy >= 0.0:
        return 1e9
    t_arc = _way_to_sphere(1.0 + tan_b * tan_b * (p * p + q * q), distance, radius)
    t = (edge_y - P[1]) / oy
    if t >= t_arc:
        return 1e9
    ox, oz = wx + tan_b * (p * ux + q * vx), wz + tan_b * q * vz
    c, _ = ridge(P[0] + t * ox, corrugation)
    clearance: float = P[2] + t * oz - c - edge_step
    if (crest_x - P[0]) * ox > t * ox * ox and (crest_x - P[0]) * ox < t_arc * ox * ox:
        c, _ = ridge(crest_x, corrugation)
        clearance = min(clearance, P[2] + (crest_x - P[0]) / ox * oz - c - edge_step)
    return clearance


@numba.njit(cache=True, nogil=True)
def _over_edge(
    P: Float64,
    axes: Axes,
    tan_b: float,
    p: tuple[float, float],
    q: tuple[float, float],
    on_rim: bool,
    distance: float,
    radius: float,
    corrugation: Float64,
    edge_y: float,
    edge_step: float,
    crest_x: float,
) -> float:
    """Return at which share of the way from (p[0], q[0]) to (p[1], q[1]) rays clear the upper sheet.

    0 if they do from the start, 1 if the end is hidden too. `on_rim` goes from p[0] to p[1] along the upper
    rim of the disc instead.
    """
    hidden, free = 0.0, 1.0
    below, above = 0.0, 0.0
    share = 0.0
    for i in range(2 + EDGE_STEPS):
        p_i = p[0] + share * (p[1] - p[0])
        q_i = math.sqrt(max(0.0, 1.0 - p_i * p_i)) if on_rim else q[0] + share * (q[1] - q[0])
        clearance = _edge_clearance(
            P, axes, tan_b, p_i, q_i, distance, radius, corrugation, edge_y, edge_step, crest_x
        )
        if i == 0 and clearance >= 0.0:
            return 0.0
        if i == 1 and clearance <= 0.0:
            return 1.0
        if clearance < 0.0:
            hidden, below = share, clearance
            above *= 0.5 if i > 2 else 1.0
        else:
            free, above = share, clearance
            below *= 0.5 if i > 2 else 1.0
        if i == 0:
            share = 1.0
        elif above > TURNED_AWAY_MM:
            share = 0.5 * (hidden + free)
        else:
            # Regula falsi with halved weights (Illinois): the clearance is nearly straight.
            share = (hidden * above - free * below) / (above - below)
    return free


@numba.njit(cache=True, nogil=True)
def _behind(
    P: Float64,
    axes: Axes,
    tan_b: float,
    p: tuple[float, float],
    q: tuple[float, float],
    across: bool,
    distance: float,
    radius: float,
    wall: Float64,
) -> float:
    """Return from which q on, from q[0] to q[1], the arc lies behind a face (n_y, n_z, c); q[1] if nowhere.

    `across` goes over the chords instead, a third of the way up the disc's upper half, and returns a p.
    """
    before, behind = 0.0, 1.0
    share = 0.0
    for i in range(20):
        p_i = p[0] + share * (p[1] - p[0])
        q_i = math.sqrt(max(0.0, 1.0 - p_i * p_i)) / 3.0 if across else q[0] + share * (q[1] - q[0])
        t = _way_to_sphere(1.0 + tan_b * tan_b * (p_i * p_i + q_i * q_i), distance, radius)
        _, wy, wz, _, uy, _, vy, vz = axes
        y = P[1] + t * (wy + tan_b * (p_i * uy + q_i * vy))
        z = P[2] + t * (wz + tan_b * q_i * vz)
        is_behind = wall[0] * y + wall[1] * z < wall[2]
        if i == 0 and is_behind:
            behind = 0.0
            break
        if i == 1 and not is_behind:
            break
        if is_behind:
            behind = share
        else:
            before = share
        share = 1.0 if i == 0 else 0.5 * (before + behind)
    return p[0] + behind * (p[1] - p[0]) if across else q[0] + behind * (q[1] - q[0])


@numba.njit(cache=True, nogil=True)
def arc_light(
    P: Float64,
    normal: Float64,
    omega_r: Float64,
    center: Float64,
    radius: float,
    planes: Float64,
    n_planes: int,
    ledges: Float64,
    n_ledges: int,
    corrugation: Float64,
    edge_y: float,
    edge_step: float,
    edge_hides: bool,
    crest_x: float,
    material: LobeNumbers,
    nodes: Nodes,
) -> float:
    """Return integral f_r cos(theta_i) d(omega) over the part of the luminous half-sphere that P sees.

    `planes` are the half-spaces m.omega > 0 that are open and `ledges` what cuts into the arc
    (`visibility.sky_planes`). Nodes of the arc that
    lie within a corrugation (its sheets `edge_step` apart at `edge_y`) do not shine; `edge_hides` says that
    P lies on the lower sheet, so that the upper one may stand in the way: its edge, or the station `crest_x`.
    """
    wx, wy, wz = center[0] - P[0], center[1] - P[1], center[2] - P[2]
    p_nodes, p_weights, q_nodes, q_weights = nodes
    distance = math.sqrt(wx * wx + wy * wy + wz * wz)
    if distance <= radius * (1.0 + 1e-9):
        return 0.0
    wx, wy, wz = wx / distance, wy / distance, wz / distance
    cos_e = math.sqrt(wx * wx + wy * wy)
    if cos_e > 1e-9:
        ux, uy = -wy / cos_e, wx / cos_e
    else:
        ux, uy, cos_e = 1.0, 0.0, 1e-9
    vx, vy, vz = -wz * uy, wz * ux, wx * uy - wy * ux
    if vz < 0.0:
        ux, uy, vx, vy, vz = -ux, -uy, -vx, -vy, -vz
    sin_b = radius / distance
    tan_b = sin_b / math.sqrt(1.0 - sin_b * sin_b)

    # Where the equator leaves the outline: beyond it the chord is whole (P above) or dark (P below).
    sin_corner = tan_b * wz / cos_e
    if sin_corner >= 1.0:
        return 0.0
    below = wz > 0.0
    p_max = math.sqrt(1.0 - sin_corner * sin_corner) if below else 1.0
    cos_psi_0 = sin_b / cos_e

    # A cut takes whole chords off at the side: their p must not be among the nodes.
    p_low, p_high = -p_max, p_max
    for j in range(n_planes):
        m_w = (planes[j, 0] * wx + planes[j, 1] * wy + planes[j, 2] * wz) / tan_b
        m_u = planes[j, 0] * ux + planes[j, 1] * uy
        m_v = planes[j, 0] * vx + planes[j, 1] * vy + planes[j, 2] * vz
        reach = math.sqrt(m_u * m_u + m_v * m_v)
        if m_w <= -reach:
            return 0.0
        if m_w >= reach:
            continue
        # Where the line m_w + m_u p + m_v q = 0 meets the unit circle.
        middle = -m_w * m_u / (reach * reach)
        half = math.sqrt(reach * reach - m_w * m_w) * abs(m_v) / (reach * reach)
        if m_w + m_u <= 0.0:
            p_high = min(p_high, middle + half)
        if m_w - m_u <= 0.0:
            p_low = max(p_low, middle - half)
    axes = (wx, wy, wz, ux, uy, vx, vy, vz)
    if edge_hides and p_high > p_low:
        # So does the edge: the outermost chords whose tops are open lie between two steps along the rim.
        start, step = p_low, (p_high - p_low) / RIM_STEPS
        first, last = RIM_STEPS + 1, -1
        for i in range(RIM_STEPS + 1):
            p = start + i * step
            q = math.sqrt(max(0.0, 1.0 - p * p))
            clearance = _edge_clearance(
                P, axes, tan_b, p, q, distance, radius, corrugation, edge_y, edge_step, crest_x
            )
            if clearance >= 0.0:
                first, last = min(first, i), i
        for side in range(2):
            i_open, i_hidden = (first, first - 1) if side == 0 else (last, last + 1)
            if not (0 <= i_open <= RIM_STEPS and 0 <= i_hidden <= RIM_STEPS):
                continue
            p_hidden, p_open = start + i_hidden * step, start + i_open * step
            share = _over_edge(
                P,
                axes,
                tan_b,
                (p_hidden, p_open),
                (0.0, 0.0),
                True,
                distance,
                radius,
                corrugation,
                edge_y,
                edge_step,
                crest_x,
            )
            p = p_hidden + share * (p_open - p_hidden)
            p_low, p_high = (p, p_high) if side == 0 else (p_low, p)
    if p_high <= p_low:
        return 0.0

    # Seen along a face that cuts into the arc, whole chords begin to lie behind it at one p.
    split = p_low, p_low
    for j in range(n_ledges):
        wall = ledges[2 * j + 1]
        p = _behind(P, axes, tan_b, (p_low, p_high), (0.0, 0.0), True, distance, radius, wall)
        if p in (p_low, p_high):
            p = _behind(P, axes, tan_b, (p_high, p_low), (0.0, 0.0), True, distance, radius, wall)
        split = (p, split[1]) if j == 0 else (min(p, split[0]), max(p, split[0]))

    total = 0.0
    for piece in range(1 + n_ledges):
        left = p_low if piece == 0 else split[piece - 1]
        right = p_high if piece == n_ledges else split[piece]
        if right <= left:
            continue
        for i in range(p_nodes.shape[0]):
            p = 0.5 * (left + right + (right - left) * p_nodes[i])
            chord = math.sqrt(max(0.0, 1.0 - p * p))
            low, high = -chord, chord
            # The equator at this p: R sin(psi) = p tan(beta) (d - R cos(psi) cos(e)).
            b = p * tan_b * cos_e
            k = p * tan_b / sin_b
            rest = 1.0 + b * b - k * k
            if rest >= 0.0:
                cos_psi = (k * b + math.sqrt(rest)) / (1.0 + b * b)
                if cos_psi >= cos_psi_0 - 1e-12:
                    low = sin_b * cos_psi * wz / ((1.0 - sin_b * cos_psi * cos_e) * tan_b)
                elif below:
                    continue
            elif below:
                continue
            for j in range(n_planes):
                m_w = planes[j, 0] * wx + planes[j, 1] * wy + planes[j, 2] * wz
                m_u = planes[j, 0] * ux + planes[j, 1] * uy
                m_v = planes[j, 0] * vx + planes[j, 1] * vy + planes[j, 2] * vz
                at_p = m_w / tan_b + m_u * p
                if m_v > 1e-12:
                    low = max(low, -at_p / m_v)
                elif m_v < -1e-12:
                    high = min(high, -at_p / m_v)
                elif at_p <= 0.0:
                    high = low
            if edge_hides and high > low:
                # The lowest q whose ray passes over the edge, by bisection: the clearance grows with q.
                low += (high - low) * _over_edge(
                    P,
                    axes,
                    tan_b,
                    (p, p),
                    (low, high),
                    False,
                    distance,
                    radius,
                    corrugation,
                    edge_y,
                    edge_step,
                    crest_x,
                )
            if high <= low:
                continue
            # All of the chord, less what lies behind a ledge and below its rim.
            for part in range(1 + n_ledges):
                begin, end, sign = low, high, 1.0
                if part > 0:
                    rim, wall = ledges[2 * part - 2], ledges[2 * part - 1]
                    sign = -1.0
                    begin = _behind(P, axes, tan_b, (p, p), (low, high), False, distance, radius, wall)
                    if begin == low:
                        # A face that leans away from the arc: the chord rises out from behind it.
                        end = _behind(P, axes, tan_b, (p, p), (high, low), False, distance, radius, wall)
                    at_p = (rim[1] * wy + rim[2] * wz) / tan_b + rim[1] * p * uy
                    m_v = rim[1] * vy + rim[2] * vz
                    if m_v > 1e-12:
                        end = min(end, -at_p / m_v)
                    elif at_p > 0.0:
                        end = begin
                    if end <= begin:
                        continue
                column = 0.0
                for j in range(q_nodes.shape[0]):
                    q = begin + (end - begin) * q_nodes[j]
                    ox = wx + tan_b * (p * ux + q * vx)
                    oy = wy + tan_b * (p * uy + q * vy)
                    oz = wz + tan_b * q * vz
                    square = 1.0 + tan_b * tan_b * (p * p + q * q)
                    length = math.sqrt(square)
                    ox, oy, oz = ox / length, oy / length, oz / length
                    cos_i = ox * normal[0] + oy * normal[1] + oz * normal[2]
                    cos_r = omega_r[0] * normal[0] + omega_r[1] * normal[1] + omega_r[2] * normal[2]
                    if cos_i <= 0.0 or cos_r <= 0.0:
                        continue
                    if corrugation[0] > 0.0:
                        t = _way_to_sphere(square, distance, radius) * length
                        c, _ = ridge(P[0] + t * ox, corrugation)
                        if P[1] + t * oy < edge_y:
                            c += edge_step
                        if P[2] + t * oz < c:
                            continue
                    hx, hy, hz = ox + omega_r[0], oy + omega_r[1], oz + omega_r[2]
                    h = math.sqrt(hx * hx + hy * hy + hz * hz)
                    cos_alpha = (hx * normal[0] + hy * normal[1] + hz * normal[2]) / h
                    cos_beta = 0.5 * h
                    shadowing = min(1.0, 2.0 * cos_alpha * min(cos_i, cos_r) / cos_beta)
                    fall = lobe_fall(material, hx, hy, hz, normal[0], normal[1], normal[2], h, cos_alpha)
                    f_r = material[0] + material[1] * shadowing / cos_r * fall
                    column += q_weights[j] * f_r * cos_i / (square * length)
                total += 0.5 * (right - left) * sign * p_weights[i] * (end - begin) * column
    return total * tan_b * tan_b


class ArcKernel(NamedTuple):
    """A scene's numbers as the kernels take them, see `Scene` and `arc_light`."""

    T_joint_camera: Float64
    center_mm: Float64
    radius_mm: float
    radiance_e: float
    vertices: Float64
    corrugation: Float64
    horizon_start: float
    horizons: Float64
    material: LobeNumbers
    nodes: Nodes
    nodes_cut: Nodes


def arc_kernel(
    setup: Setup, view: Scene, level: float = 1.0, nodes: tuple[int, int] = (NODES_P, NODES_Q)
) -> ArcKernel:
    """Gather a scene for the kernels; `level` is the arc's output over the nominal one.

    Raises ValueError for a pose whose camera stands below the surface.
    """
    if view.below_surface:
        raise ValueError("the camera stands below the surface at this pose")
    return ArcKernel(
        np.ascontiguousarray(view.T_joint_camera),
        view.center_mm,
        setup.arc.radius_mm,
        setup.arc.radiance_e * level,
        view.shape.vertices,
        view.shape.corrugation,
        view.horizon_start,
        view.horizons,
        lobe_numbers(setup.material),
        _disc_nodes(*nodes),
        _disc_nodes(CUT_FACTOR * nodes[0], nodes[1]),
    )


@numba.njit(cache=True, nogil=True)
def arc_at_ray(k: ArcKernel, x: float, y: float, scratch: Float64) -> tuple[float, int]:
    """Return the arc's light, e- without the lens' fall-off, on a ray (x, y, 1), and the face it meets.

    NaN and MISS for a ray that looks past the workpiece; `scratch` is (SCRATCH_ROWS, 3).
    """
    d, P, normal, omega_r = scratch[0], scratch[1], scratch[2], scratch[3]
    planes, ledges = scratch[4 : 4 + MAX_PLANES], scratch[4 + MAX_PLANES :]
    origin = k.T_joint_camera[:3, 3]
    for j in range(3):
        d[j] = k.T_joint_camera[j, 0] * x + k.T_joint_camera[j, 1] * y + k.T_joint_camera[j, 2]
    t, face = first_hit(origin, d, k.vertices, k.corrugation)
    if face == MISS:
        return math.nan, face
    length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    for j in range(3):
        P[j] = origin[j] + t * d[j]
        omega_r[j] = -d[j] / length
    face_normal(face, P[0], k.vertices, k.corrugation, normal)
    count, n_ledges = sky_planes(
        P,
        normal,
        face,
        k.center_mm,
        k.radius_mm,
        k.vertices,
        k.corrugation,
        k.horizon_start,
        k.horizons,
        planes,
        ledges,
    )
    edge_y = k.vertices[1, 0]
    edge_step = k.vertices[1, 1] - k.vertices[k.vertices.shape[0] - 2, 1]
    nodes = k.nodes
    edge_hides, crest_x = False, math.nan
    if k.corrugation[0] > 0.0 and face == 2 and k.center_mm[1] - k.radius_mm < edge_y:
        edge_hides = True
        _, crest_x = touch(k.horizons[0], k.horizon_start, P[0])
        nodes = k.nodes_cut
    if n_ledges > 0:
        nodes = k.nodes_cut
    for j in range(count):
        ahead = 0.0
        square = 0.0
        for a in range(3):
            ahead += planes[j, a] * (k.center_mm[a] - P[a])
            square += planes[j, a] * planes[j, a]
        # A plane through the centre's own level cuts nothing off the upper half.
        level_with_center = j == 0 and ahead > -1e-9 and normal[2] > 1.0 - 1e-12
        if ahead < 1.001 * k.radius_mm * math.sqrt(square) and not level_with_center:
            nodes = k.nodes_cut
    light = arc_light(
        P,
        normal,
        omega_r,
        k.center_mm,
        k.radius_mm,
        planes,
        count,
        ledges,
        n_ledges,
        k.corrugation,
        edge_y,
        edge_step,
        edge_hides,
        crest_x,
        k.material,
        nodes,
    )
    return k.radiance_e * light, face


@numba.njit(cache=True, nogil=True)
def _arc_pixels(
    k: ArcKernel, xy: Float32, cos4: Float32, pixels: Int64, mean_e: Float32, faces: Int32
) -> None:
    """Fill `mean_e` and `faces` (n,) of some pixels (n,), see `arc_at`."""
    scratch = np.empty((SCRATCH_ROWS, 3))
    for i in range(pixels.shape[0]):
        light, face = arc_at_ray(k, xy[pixels[i], 0], xy[pixels[i], 1], scratch)
        mean_e[i] = cos4[pixels[i]] * light
        faces[i] = face


def arc_at(kernel: ArcKernel, xy: Float32, cos4: Float32, pixels: Int64) -> tuple[Float32, Int32]:
    """Return the arc's mean, e- for `camera.exposure_s`, and the face seen at some pixels (n,).

    `xy` (H W, 2) and `cos4` (H W,) are the flattened `optics.Rays`. Before the point-spread function; NaN
    where a pixel looks past the workpiece.
    """
    mean_e = np.empty(len(pixels), dtype=np.float32)
    faces = np.empty(len(pixels), dtype=np.int32)
    _arc_pixels(kernel, xy, cos4, pixels, mean_e, faces)
    return mean_e, faces


@numba.njit(cache=True, nogil=True)
def _fill_cell(
    k: ArcKernel,
    xy: Float32,
    cos4: Float32,
    n_pos: int,
    scan: int,
    first: int,
    low: int,
    s_size: int,
    r_size: int,
    tolerance: float,
    floor_e: float,
    band_e: Float32,
    scratch: Float64,
    corners: Float64,
) -> bool:
    """Try to fill one cell of a band from its corners and centre; False if it is not that smooth.

    The cell spans scan lines scan ... scan + s_size - 1 and places first ... first + r_size - 1 of the band,
    whose place 0 is position `low` of the image.
    """
    if s_size < 3 or r_size < 3:
        return False
    face_0 = MISS
    for i in range(4):
        s = scan + (i // 2) * (s_size - 1)
        r = low + first + (i % 2) * (r_size - 1)
        corners[i], face = arc_at_ray(k, xy[s * n_pos + r, 0], xy[s * n_pos + r, 1], scratch)
        if i == 0:
            face_0 = face
        if face != face_0 or face == MISS:
            return False
    s_mid, r_mid = s_size // 2, r_size // 2
    pixel = (scan + s_mid) * n_pos + low + first + r_mid
    center, face = arc_at_ray(k, xy[pixel, 0], xy[pixel, 1], scratch)
    a, b = s_mid / (s_size - 1), r_mid / (r_size - 1)
    near = corners[0] * (1.0 - b) + corners[1] * b
    far = corners[2] * (1.0 - b) + corners[3] * b
    flat = near * (1.0 - a) + far * a
    if face != face_0 or abs(flat - center) > tolerance * center + floor_e:
        return False
    # What is left at the centre is put back as a bump that vanishes on the rim.
    bump = (center - flat) / (16.0 * a * (1.0 - a) * b * (1.0 - b))
    for i in range(s_size):
        a = i / (s_size - 1)
        for j in range(r_size):
            b = j / (r_size - 1)
            near = corners[0] * (1.0 - b) + corners[1] * b
            far = corners[2] * (1.0 - b) + corners[3] * b
            value = near * (1.0 - a) + far * a + bump * 16.0 * a * (1.0 - a) * b * (1.0 - b)
            band_e[scan + i, first + j] = value * cos4[(scan + i) * n_pos + low + first + j]
    return True


@numba.njit(cache=True, nogil=True)
def _arc_band(
    k: ArcKernel,
    xy: Float32,
    cos4: Float32,
    n_pos: int,
    lows: Int64,
    cell: int,
    tolerance: float,
    floor_e: float,
    band_e: Float32,
) -> None:
    """Fill a band (n_scan, depth), see `arc_band`."""
    n_scan, depth = band_e.shape
    scratch = np.empty((SCRATCH_ROWS, 3))
    corners = np.empty(4)
    # Cells still to be filled, the one on top next: scan, first, their sizes.
    stack = np.empty((64, 4), dtype=np.int64)
    for scan in range(0, n_scan, cell):
        low = lows[scan // cell]
        for first in range(0, depth, CELL_DEPTH):
            stack[0, 0], stack[0, 1] = scan, first
            stack[0, 2], stack[0, 3] = min(cell, n_scan - scan), min(CELL_DEPTH, depth - first)
            waiting = 1
            while waiting > 0:
                waiting -= 1
                s, r, s_size, r_size = stack[waiting]
                if _fill_cell(
                    k,
                    xy,
                    cos4,
                    n_pos,
                    s,
                    r,
                    low,
                    s_size,
                    r_size,
                    tolerance,
                    floor_e,
                    band_e,
                    scratch,
                    corners,
                ):
                    continue
                if s_size <= SMALLEST and r_size <= SMALLEST:
                    for i in range(s, s + s_size):
                        for j in range(r, r + r_size):
                            pixel = i * n_pos + low + j
                            light, _ = arc_at_ray(k, xy[pixel, 0], xy[pixel, 1], scratch)
                            band_e[i, j] = light * cos4[pixel]
                    continue
                s_part = s_size if s_size <= SMALLEST else (s_size + 1) // 2
                r_part = r_size if r_size <= SMALLEST else (r_size + 1) // 2
                for ds in range(0, s_size, s_part):
                    for dr in range(0, r_size, r_part):
                        stack[waiting, 0], stack[waiting, 1] = s + ds, r + dr
                        stack[waiting, 2] = min(s_part, s_size - ds)
                        stack[waiting, 3] = min(r_part, r_size - dr)
                        waiting += 1


def arc_band(
    kernel: ArcKernel,
    xy: Float32,
    cos4: Float32,
    lows: Int64,
    band_e: Float32,
    tolerance: float = 0.004,
    floor_e: float = 10.0,
) -> None:
    """Fill a band of the arc map (n_scan, depth), e-, NaN where a pixel looks past the workpiece.

    `xy` (n_scan n_pos, 2) and `cos4` are the camera's rays by scan line, `lows` (ceil(n_scan / CELL),) the
    position of the image at which the band begins for each CELL scan lines. A cell of CELL by CELL_DEPTH
    pixels, or a half or quarter of one, is read off its corners and centre where a bilinear surface misses
    the centre by no more than `tolerance` of its value plus `floor_e`; the miss itself is put back as a bump,
    so the error is smaller still.
    """
    n_pos = len(cos4) // band_e.shape[0]
    _arc_band(kernel, xy, cos4, n_pos, lows, CELL, tolerance, floor_e, band_e)


def arc_frame(kernel: ArcKernel, xy: Float32, cos4: Float32, shape: tuple[int, int]) -> Float32:
    """Return the whole arc map (H, W), e-; NaN where a pixel looks past the workpiece."""
    frame_e = np.empty(shape, dtype=np.float32)
    lows = np.zeros(-(-shape[0] // CELL), dtype=np.int64)
    arc_band(kernel, xy, cos4, lows, frame_e)
    return frame_e
