"""Joints swept along a bent seam, and where rays meet them: plain code that shares nothing with the model.

Sections are drawn here, and rays are met by Newton's steps on each face's own equation. Joint frame, mm: x
along the nominal seam, y to its left, z out of the metal; a station x is moved by
y = y_amp sin(2 pi x / y_period) and z = z_slope x, and raised by a corrugation's ridges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.optimize import brentq

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import Joint
from noise_model.transforms import invert, transform

ACROSS_MM = 300.0
ROUND_CHORDS = 40
"""Chords of a rounded root."""

NEWTON_STEPS, MET_MM = 12, 1e-7
STEEP_ENOUGH, SPARE_MM = 1e-3, 0.05
"""A face is left out where the ray's tangent misses it by more than the seam's sag and this."""

MARCH_MM, MIN_MARCH_STEPS = 0.75, 4
"""Where ridges run a ray is followed in steps of the station, for Newton's might find the ridge behind."""

OFF_MM, SHORT = 2e-3, 1e-3
"""Shadow rays leave the metal by so much, and end that share before their source."""


def outline(joint: Joint) -> tuple[Float64, Float64]:
    """Return a section's corners (n, 2) as (y, z), y rising, and its seam point (2,); mm."""
    size = joint.dimensions
    seam, rise = np.zeros(2), 0.0
    match joint.type:
        case "flat":
            inner = [(0.0, 0.0)]
        case "v_groove":
            half, depth = size["root_gap_mm"] / 2.0, size["depth_mm"]
            mouth = half + depth * math.tan(math.radians(size["included_angle_deg"]) / 2.0)
            inner = [(-mouth, 0.0), (-half, -depth), (half, -depth), (mouth, 0.0)]
            seam[1] = -depth
        case "half_v":
            half, depth = size["root_gap_mm"] / 2.0, size["depth_mm"]
            mouth = half + depth * math.tan(math.radians(size["bevel_angle_deg"]))
            inner = [(-half, 0.0), (-half, -depth), (half, -depth), (mouth, 0.0)]
            seam[1] = -depth
        case "u_groove":
            half, depth, radius = size["root_gap_mm"] / 2.0, size["depth_mm"], size["root_radius_mm"]
            bevel = math.radians(size["bevel_angle_deg"])
            turns = np.linspace(0.0, math.pi / 2.0 - bevel, ROUND_CHORDS)
            side = [(half + radius * math.sin(a), radius * (1.0 - math.cos(a)) - depth) for a in turns]
            y, z = side[-1]
            side.append((y - z * math.tan(bevel), 0.0))
            inner = [(-y, z) for y, z in reversed(side)] + side
            seam[1] = -depth
        case "butt":
            half, depth = size["gap_mm"] / 2.0, size["thickness_mm"]
            inner = [(-half, 0.0), (-half, -depth), (half, -depth), (half, 0.0)]
        case "lap" | "corrugation":
            inner = [(0.0, size["thickness_mm"]), (0.0, 0.0)]
        case "fillet":
            inner = [(0.0, 0.0)]
            rise = ACROSS_MM / math.tan(math.radians(size["included_angle_deg"]) / 2.0)
        case "outside_corner":
            inner = [(0.0, 0.0)]
            rise = -ACROSS_MM / math.tan(math.radians(size["included_angle_deg"]) / 2.0)
        case other:
            raise ValueError(f"[joint] type = {other!r}: this world does not draw it")
    inner = [corner for n, corner in enumerate(inner) if n == 0 or corner != inner[n - 1]]
    ends = (-ACROSS_MM, inner[0][1] + rise), (ACROSS_MM, inner[-1][1] + rise)
    return np.array([ends[0], *inner, ends[1]]), seam


@dataclass(frozen=True, eq=False)
class SweptJoint:
    """A section's corners (n, 2), its seam point (2,), and `bend` (6,): y_amp, y_period, z_slope and ridges.

    The ridges are height, width and pitch, mm.
    """

    corners: Float64
    seam: Float64
    bend: Float64

    @classmethod
    def of(cls, joint: Joint, y_amp_mm: float, y_period_mm: float, z_slope: float) -> SweptJoint:
        """Sweep a joint's section along a bent seam."""
        ridges = [joint.dimensions.get(f"{name}_mm", 0.0) for name in ("height", "width", "pitch")]
        if joint.type != "corrugation":
            ridges = [0.0, 1.0, 1.0]
        return cls(*outline(joint), np.array([y_amp_mm, y_period_mm, z_slope, *ridges]))

    def seam_tool_mm(self, setup: Setup, T_joint_tool: Float64) -> Float64:
        """Return where the seam meets the laser plane (3,), mm, tool frame."""
        T_tool_joint, plane = invert(T_joint_tool), setup.laser.plane

        def point(x_mm: float) -> Float64:
            aside, _, lift, _ = departure(x_mm, self.bend)
            return transform(T_tool_joint, np.array([x_mm, self.seam[0] + aside, self.seam[1] + lift]))

        start = float(transform(T_joint_tool, setup.laser.point_mm)[0])
        met = brentq(lambda x: float(point(x) @ plane[:3] + plane[3]), start - 60.0, start + 60.0, xtol=1e-9)
        return point(float(met))


@njit(cache=True)
def departure(x: float, bend: Float64) -> tuple[float, float, float, float]:
    """Return how far a station is moved aside and up, mm, each followed by its slope."""
    turn = 2.0 * math.pi / bend[1]
    aside, aside_slope = bend[0] * math.sin(turn * x), bend[0] * turn * math.cos(turn * x)
    lift, lift_slope = bend[2] * x, bend[2]
    u = x - bend[5] * round(x / bend[5])
    if bend[3] > 0.0 and abs(u) < 0.5 * bend[4]:
        wave = 2.0 * math.pi / bend[4]
        lift += 0.5 * bend[3] * (1.0 + math.cos(wave * u))
        lift_slope -= 0.5 * bend[3] * wave * math.sin(wave * u)
    return aside, aside_slope, lift, lift_slope


@njit(cache=True)
def _level(o, d, t, k, corners, bend):  # type: ignore[no-untyped-def]
    """Return a face's equation at o + t d, its derivative by t, the place along the face, and its length."""
    aside, aside_slope, lift, lift_slope = departure(o[0] + t * d[0], bend)
    y, z = o[1] + t * d[1] - aside, o[2] + t * d[2] - lift
    return _level_there(y, z, d[1] - aside_slope * d[0], d[2] - lift_slope * d[0], k, corners)[:4]


@njit(cache=True)
def _level_there(y, z, y_slope, z_slope, k, corners):  # type: ignore[no-untyped-def]
    """Return what `_level` does for a place of the section, and how fast the place moves along the face."""
    dy, dz = corners[k + 1, 0] - corners[k, 0], corners[k + 1, 1] - corners[k, 1]
    length = math.hypot(dy, dz)
    dy, dz = dy / length, dz / length
    value = (z - corners[k, 1]) * dy - (y - corners[k, 0]) * dz
    along = (y - corners[k, 0]) * dy + (z - corners[k, 1]) * dz
    return value, z_slope * dy - y_slope * dz, along, length, y_slope * dy + z_slope * dz


@njit(cache=True)
def _newton(o, d, start, k, corners, bend, least, most):  # type: ignore[no-untyped-def]
    """Return where a ray meets a face, NaN for nowhere between two lengths."""
    t = start
    for _ in range(NEWTON_STEPS):
        value, slope, along, length = _level(o, d, t, k, corners, bend)
        if slope == 0.0:
            return math.nan
        step = value / slope
        t -= step
        if abs(step) < MET_MM:
            break
    value, slope, along, length = _level(o, d, t, k, corners, bend)
    if abs(value) > 1e-5 or not least < t < most or along < 0.0 or along > length:
        return math.nan
    return t


@njit(cache=True)
def _straight_hit(o, d, corners, bend, least, most, any_hit):  # type: ignore[no-untyped-def]
    """Do what `first_hit` does where no ridges run: the seam hardly bends over a joint's width.

    A face that the tangent at one place of the ray misses by more than the seam's bend allows is left out.
    """
    best, face = most, -1
    t_0 = min(max(-o[2] / d[2], least), most) if d[2] != 0.0 else least
    aside, aside_slope, lift, lift_slope = departure(o[0] + t_0 * d[0], bend)
    y, z = o[1] + t_0 * d[1] - aside, o[2] + t_0 * d[2] - lift
    y_slope, z_slope = d[1] - aside_slope * d[0], d[2] - lift_slope * d[0]
    curvature = abs(bend[0]) * (2.0 * math.pi / bend[1]) ** 2
    for k in range(corners.shape[0] - 1):
        value, slope, along, length, pace = _level_there(y, z, y_slope, z_slope, k, corners)
        start = t_0
        if abs(slope) > STEEP_ENOUGH:
            step = -value / slope
            sag = 0.5 * curvature * (d[0] * step) ** 2 + SPARE_MM
            slack = sag * (1.0 + abs(pace / slope))
            if not -slack <= along + pace * step <= length + slack:
                continue
            start += step
            if not least - sag / abs(slope) <= start <= best + sag / abs(slope):
                continue
        met = _newton(o, d, start, k, corners, bend, least, best)
        if not math.isnan(met):
            best, face = met, k
            if any_hit:
                break
    return best, face


@njit(cache=True)
def _ridged_hit(o, d, corners, bend, least, most, any_hit):  # type: ignore[no-untyped-def]
    """Do what `first_hit` does where ridges run, step after step along the ray."""
    best, face, n_faces = most, -1, corners.shape[0] - 1
    # The ray is in the ridges' reach between two heights only.
    top, bottom = bend[3] + corners[:, 1].max() + 2.0, corners[:, 1].min() - 2.0
    t_1, t_2 = (top - o[2]) / d[2], (bottom - o[2]) / d[2]
    low, high = max(min(t_1, t_2), least), min(max(t_1, t_2), most)
    n_steps = max(math.ceil(abs(d[0]) * (high - low) / MARCH_MM), MIN_MARCH_STEPS)
    before = np.empty(n_faces)
    for i in range(n_steps + 1):
        t = low + (high - low) * i / n_steps
        aside, _, lift, _ = departure(o[0] + t * d[0], bend)
        y, z = o[1] + t * d[1] - aside, o[2] + t * d[2] - lift
        for k in range(n_faces):
            here = _level_there(y, z, 0.0, 0.0, k, corners)[0]
            if i > 0 and before[k] * here <= 0.0:
                start = t - (high - low) / n_steps * abs(here) / max(abs(here) + abs(before[k]), 1e-300)
                met = _newton(o, d, start, k, corners, bend, least, best)
                if not math.isnan(met):
                    best, face = met, k
            before[k] = here
        if face >= 0 and (any_hit or best <= t):
            break
    return best, face


@njit(cache=True)
def first_hit(o, d, corners, bend, least, most, any_hit=False):  # type: ignore[no-untyped-def]
    """Return how far along a ray the metal is met first (any hit: met), and the face; NaN and -1."""
    if bend[3] > 0.0:
        best, face = _ridged_hit(o, d, corners, bend, least, most, any_hit)
    else:
        best, face = _straight_hit(o, d, corners, bend, least, most, any_hit)
    return (best, face) if face >= 0 else (math.nan, -1)


@njit(cache=True)
def first_hits(rays, eye, corners, bend, asked):  # type: ignore[no-untyped-def]
    """Return where rays (n, 3) from the eye meet the metal first (n, 3) and the faces (n,); NaN and -1.

    Rays that are not `asked` (n,) for meet nothing.
    """
    places, faces = np.full(rays.shape, np.nan), np.full(rays.shape[0], -1)
    for i in range(rays.shape[0]):
        if asked[i]:
            t, faces[i] = first_hit(eye, rays[i], corners, bend, 1.0, 1e4)
            places[i] = eye + t * rays[i]
    return places, faces


@njit(cache=True)
def hit_near(o, d, place, k, corners, bend):  # type: ignore[no-untyped-def]
    """Return how far along a ray it meets face k near a place where its neighbour met it; NaN for nowhere."""
    start = (place[0] - o[0]) * d[0] + (place[1] - o[1]) * d[1] + (place[2] - o[2]) * d[2]
    return _newton(o, d, start, k, corners, bend, 1.0, 1e4)


@njit(cache=True)
def normal_at(x, k, corners, bend):  # type: ignore[no-untyped-def]
    """Return the unit normal of a face at a station, out of the metal."""
    _, aside_slope, _, lift_slope = departure(x, bend)
    dy, dz = corners[k + 1, 0] - corners[k, 0], corners[k + 1, 1] - corners[k, 1]
    n = np.array([dz * aside_slope - dy * lift_slope, -dz, dy])
    return n / math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)


@njit(cache=True)
def is_open(p, n, target, corners, bend):  # type: ignore[no-untyped-def]
    """Say whether nothing lies between a point of the metal and a target."""
    o = p + OFF_MM * n
    way = target - o
    length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    return first_hit(o, way / length, corners, bend, 1e-4, (1.0 - SHORT) * length, True)[1] < 0
