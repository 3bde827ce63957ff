"""Joints swept along a bent seam, and where rays meet them: plain code that shares nothing with the model.

Sections are drawn here, and rays are met by Newton's steps on each face's own equation. Joint frame, mm: x
along the nominal seam, y to its left, z out of the metal; a station x is moved by
y = y_amp sin(2 pi x / y_period) and z = z_slope x, and raised by a corrugation's ridges.

A seam may turn: straight on, an arc to the left in the level plane, straight on again. x is then the station
along that path, y and z count across it, turned about the travel by `roll`. Rays are met by steps that no
surface is nearer than (Hart 1996, The Visual Computer 12, 527, sphere tracing).
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

TRACE_SHARE, TRACE_MM, MAX_TRACE_STEPS = 0.85, 5e-4, 400
"""Share of the way to the nearest face that a step goes, for seams wander; its least length; most steps."""


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
    """A section's corners (n, 2), its seam point (2,), and `bend` (10,).

    That is y_amp, y_period, z_slope, ridges and arc: of the ridges height, width and pitch, mm; of the arc
    its curvature, 1/mm, 0 for a straight seam, the stations of its start and end, mm, and the joint's roll
    about the travel, rad.
    """

    corners: Float64
    seam: Float64
    bend: Float64

    @classmethod
    def of(
        cls,
        joint: Joint,
        y_amp_mm: float,
        y_period_mm: float,
        z_slope: float,
        arc: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    ) -> SweptJoint:
        """Sweep a joint's section along a bent seam."""
        ridges = [joint.dimensions.get(f"{name}_mm", 0.0) for name in ("height", "width", "pitch")]
        if joint.type != "corrugation":
            ridges = [0.0, 1.0, 1.0]
        return cls(*outline(joint), np.array([y_amp_mm, y_period_mm, z_slope, *ridges, *arc]))

    def seam_tool_mm(self, setup: Setup, T_joint_tool: Float64) -> Float64:
        """Return where the seam meets the laser plane (3,), mm, tool frame."""
        T_tool_joint, plane = invert(T_joint_tool), setup.laser.plane

        def point(x_mm: float) -> Float64:
            aside, _, lift, _ = departure(x_mm, self.bend)
            return transform(T_tool_joint, self.base_mm(x_mm, self.seam[0] + aside, self.seam[1] + lift))

        def off_mm(x_mm: float) -> float:
            return float(point(x_mm) @ plane[:3] + plane[3])

        start = float(place(transform(T_joint_tool, setup.laser.point_mm), self.bend)[0])
        first_mm, last_mm = start - 60.0, start + 60.0
        if self.bend[6] != 0.0:
            # A sheet may cut a seam that turns twice: the sensor looks where it stands.
            x_mm = np.arange(first_mm, last_mm, 0.5)
            off = np.array([off_mm(float(each)) for each in x_mm])
            cut = x_mm[:-1][off[:-1] * off[1:] <= 0.0]
            if not len(cut):
                return np.full(3, math.nan)
            away = [np.linalg.norm(point(float(each)) - setup.laser.point_mm) for each in cut]
            first_mm = float(cut[np.argmin(away)])
            last_mm = first_mm + 0.5
        return point(float(brentq(off_mm, first_mm, last_mm, xtol=1e-9)))

    def base_mm(self, x_mm: float, y_mm: float, z_mm: float) -> Float64:
        """Return the point (3,) at a station, y and z across the path."""
        bend, start, end, roll = self.bend[6:]
        if bend == 0.0:
            return np.array([x_mm, y_mm, z_mm])
        angle = bend * (min(max(x_mm, start), end) - start)
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        leftward, up = np.array([-way[1], way[0], 0.0]), np.array([0.0, 0.0, 1.0])
        on_path = np.array([start + math.sin(angle) / bend, (1.0 - math.cos(angle)) / bend, 0.0])
        on_path += (min(x_mm - start, 0.0) + max(x_mm - end, 0.0)) * way
        y_axis, z_axis = (
            math.cos(roll) * leftward + math.sin(roll) * up,
            math.cos(roll) * up - math.sin(roll) * leftward,
        )
        return np.asarray(on_path + y_mm * y_axis + z_mm * z_axis)


@njit(cache=True)  # type: ignore[untyped-decorator]
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
def _on_path(x, y, bend):  # type: ignore[no-untyped-def]
    """Return a point's station on a path that turns, its way left, the heading, and d station / d way."""
    radius, start = 1.0 / bend[6], bend[7]
    whole = bend[6] * (bend[8] - start)
    angle = math.atan2(x - start, radius - y) % (2.0 * math.pi)
    if angle <= whole:
        far = math.hypot(x - start, radius - y)
        return start + radius * angle, radius - far, angle, radius / max(far, 1e-6)
    if angle > math.pi + 0.5 * whole:
        return x, y, 0.0, 1.0
    c, s = math.cos(whole), math.sin(whole)
    u, v = x - start - radius * s, y - radius * (1.0 - c)
    return bend[8] + c * u + s * v, c * v - s * u, whole, 1.0


@njit(cache=True)
def place(p, bend):  # type: ignore[no-untyped-def]
    """Return a point's station, its y and z from the seam's section, and the gradients of these (3,) each."""
    if bend[6] == 0.0:
        aside, aside_slope, lift, lift_slope = departure(p[0], bend)
        return p[0], p[1] - aside, p[2] - lift, (-aside_slope, 1.0, 0.0), (-lift_slope, 0.0, 1.0)
    station, way_left, heading, pace = _on_path(p[0], p[1], bend)
    aside, aside_slope, lift, lift_slope = departure(station, bend)
    c, s, across, up = math.cos(heading), math.sin(heading), math.cos(bend[9]), math.sin(bend[9])
    y, z = across * way_left + up * p[2] - aside, across * p[2] - up * way_left - lift
    aside_slope, lift_slope = pace * aside_slope, pace * lift_slope
    of_y = -across * s - aside_slope * c, across * c - aside_slope * s, up
    of_z = up * s - lift_slope * c, -up * c - lift_slope * s, across
    return station, y, z, of_y, of_z


@njit(cache=True)
def _level(o, d, t, k, corners, bend):  # type: ignore[no-untyped-def]
    """Return a face's equation at o + t d, its derivative by t, the place along the face, and its length."""
    if bend[6] != 0.0:
        _, y, z, a, b = place(o + t * d, bend)
        y_slope, z_slope = a[0] * d[0] + a[1] * d[1] + a[2] * d[2], b[0] * d[0] + b[1] * d[1] + b[2] * d[2]
        return _level_there(y, z, y_slope, z_slope, k, corners)[:4]
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
        met = _newton(o, d, start, k, corners, bend, least=least, most=best)
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
                met = _newton(o, d, start, k, corners, bend, least=least, most=best)
                if not math.isnan(met):
                    best, face = met, k
            before[k] = here
        if face >= 0 and (any_hit or best <= t):
            break
    return best, face


@njit(cache=True)
def _nearest_face(y, z, corners):  # type: ignore[no-untyped-def]
    """Return the distance of a place of the section to the nearest face, mm, and that face."""
    nearest, face = math.inf, 0
    for k in range(corners.shape[0] - 1):
        dy, dz = corners[k + 1, 0] - corners[k, 0], corners[k + 1, 1] - corners[k, 1]
        u, v = y - corners[k, 0], z - corners[k, 1]
        share = min(max((u * dy + v * dz) / (dy * dy + dz * dz), 0.0), 1.0)
        away = (u - share * dy) ** 2 + (v - share * dz) ** 2
        if away < nearest:
            nearest, face = away, k
    return math.sqrt(nearest), face


@njit(cache=True)
def _turned_hit(o, d, corners, bend, least, most):  # type: ignore[no-untyped-def]
    """Do what `first_hit` does where the seam turns."""
    t = least
    for _ in range(MAX_TRACE_STEPS):
        _, y, z, _, _ = place(o + t * d, bend)
        away, k = _nearest_face(y, z, corners)
        if away < 4.0 * TRACE_MM:
            met = _newton(o, d, t, k, corners, bend, least=least, most=most)
            if not math.isnan(met) and abs(met - t) < 1.0:
                return met, k
        t += max(TRACE_SHARE * away, TRACE_MM)
        if t >= most:
            break
    return most, -1


@njit(cache=True)
def first_hit(o, d, corners, bend, least, most, any_hit=False):  # type: ignore[no-untyped-def]
    """Return how far along a ray the metal is met first (any hit: met), and the face; NaN and -1."""
    if bend[6] != 0.0:
        best, face = _turned_hit(o, d, corners, bend, least, most)
    elif bend[3] > 0.0:
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
    return _newton(o, d, start, k, corners, bend, least=1.0, most=1e4)


@njit(cache=True)
def rise_at(p, k, corners, bend):  # type: ignore[no-untyped-def]
    """Return the gradient of a face's equation times its length, at a point (3,)."""
    _, _, _, of_y, of_z = place(p, bend)
    dy, dz = corners[k + 1, 0] - corners[k, 0], corners[k + 1, 1] - corners[k, 1]
    return np.array([dy * of_z[0] - dz * of_y[0], dy * of_z[1] - dz * of_y[1], dy * of_z[2] - dz * of_y[2]])


@njit(cache=True)
def normal_at(p, k, corners, bend):  # type: ignore[no-untyped-def]
    """Return the unit normal of a face at a point (3,), out of the metal."""
    n = rise_at(p, k, corners, bend)
    return n / math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)


@njit(cache=True)
def is_open(p, n, target, corners, bend):  # type: ignore[no-untyped-def]
    """Say whether nothing lies between a point of the metal and a target."""
    o = p + OFF_MM * n
    way = target - o
    length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    return first_hit(o, way / length, corners, bend, 1e-4, (1.0 - SHORT) * length, True)[1] < 0
