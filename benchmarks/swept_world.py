"""A plain world to be judged in: joints swept along a bent seam, cast ray by ray, with speckle on the metal.

Nothing of the forward model is in it: sections are drawn here, rays are met by Newton's steps on each face's
own equation, and the arc is a sum over points of its half-sphere with a shadow ray each. Only records (setup,
its parts) are shared. Joint frame, mm: x along the nominal seam, y to its left, z out of the metal; a station
x is moved by y = y_amp sin(2 pi x / y_period) and z = z_slope x, and raised by a corrugation's ridges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from noise_model.arrays import Float64, Integers
from noise_model.setup import Setup
from noise_model.surface.joint import Joint
from noise_model.transforms import invert, transform

ACROSS_MM = 300.0
ROUND_CHORDS = 40
"""Chords of a rounded root."""

NEWTON_STEPS, MET_MM = 12, 1e-7
MARCH_STEPS = 48
"""Where ridges run a ray is followed in so many steps, for Newton's might find the ridge behind."""

ARC_POINTS, ARC_COARSER = 32, 4
"""Points of the arc's upper half, and by how much coarser its light is computed than the image."""

PARTS = 3
"""A pixel's light is the mean of so many by so many of its parts."""

OFF_MM, SHORT = 2e-3, 1e-3
"""Shadow rays leave the metal by so much, and end that share before their source."""

SHEET_REACH = 6.0


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
    """Return a face's equation at o + t d, its derivative by t, and y and z from the section's frame."""
    aside, aside_slope, lift, lift_slope = departure(o[0] + t * d[0], bend)
    y, z = o[1] + t * d[1] - aside, o[2] + t * d[2] - lift
    dy, dz = corners[k + 1, 0] - corners[k, 0], corners[k + 1, 1] - corners[k, 1]
    length = math.hypot(dy, dz)
    dy, dz = dy / length, dz / length
    value = (z - corners[k, 1]) * dy - (y - corners[k, 0]) * dz
    slope = (d[2] - lift_slope * d[0]) * dy - (d[1] - aside_slope * d[0]) * dz
    along = (y - corners[k, 0]) * dy + (z - corners[k, 1]) * dz
    return value, slope, along, length


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
def first_hit(o, d, corners, bend, least, most):  # type: ignore[no-untyped-def]
    """Return how far along a ray the metal is met first, and the face; NaN and -1 for nowhere."""
    best, face = most, -1
    if bend[3] > 0.0:
        # The ray is in the ridges' reach between two heights only.
        top, bottom = bend[3] + corners[:, 1].max() + 2.0, corners[:, 1].min() - 2.0
        t_1, t_2 = (top - o[2]) / d[2], (bottom - o[2]) / d[2]
        low, high = max(min(t_1, t_2), least), min(max(t_1, t_2), most)
    for k in range(corners.shape[0] - 1):
        if bend[3] > 0.0:
            before = _level(o, d, low, k, corners, bend)[0]
            for i in range(1, MARCH_STEPS + 1):
                t = low + (high - low) * i / MARCH_STEPS
                here = _level(o, d, t, k, corners, bend)[0]
                if before * here <= 0.0:
                    step = (high - low) / MARCH_STEPS
                    start = t - step * abs(here) / max(abs(here) + abs(before), 1e-300)
                    met = _newton(o, d, start, k, corners, bend, least, best)
                    if not math.isnan(met):
                        best, face = met, k
                        break
                before = here
        else:
            value, slope, _, _ = _level(o, d, 0.0, k, corners, bend)
            if slope != 0.0:
                met = _newton(o, d, -value / slope, k, corners, bend, least, best)
                if not math.isnan(met):
                    best, face = met, k
    return (best, face) if face >= 0 else (math.nan, -1)


@njit(cache=True)
def _lobe(n, w_i, w_r, c2):  # type: ignore[no-untyped-def]
    """Return the specular term of unit vectors: min(1, 2 cos a cos t / cos b) exp(-c2 a^2) / cos(theta_r)."""
    cos_i = n[0] * w_i[0] + n[1] * w_i[1] + n[2] * w_i[2]
    cos_r = n[0] * w_r[0] + n[1] * w_r[1] + n[2] * w_r[2]
    if cos_i <= 0.0 or cos_r <= 0.0:
        return 0.0
    h = w_i + w_r
    h /= math.sqrt(h[0] ** 2 + h[1] ** 2 + h[2] ** 2)
    cos_a = min(n[0] * h[0] + n[1] * h[1] + n[2] * h[2], 1.0)
    cos_b = h[0] * w_i[0] + h[1] * w_i[1] + h[2] * w_i[2]
    a = math.acos(cos_a)
    return min(1.0, 2.0 * cos_a * min(cos_i, cos_r) / cos_b) * math.exp(-c2 * a * a) / cos_r


@njit(cache=True)
def _normal(x, k, corners, bend):  # type: ignore[no-untyped-def]
    """Return the unit normal of a face at a station, out of the metal."""
    _, aside_slope, _, lift_slope = departure(x, bend)
    dy, dz = corners[k + 1, 0] - corners[k, 0], corners[k + 1, 1] - corners[k, 1]
    n = np.array([dz * aside_slope - dy * lift_slope, -dz, dy])
    return n / math.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)


@njit(cache=True)
def _is_open(p, n, target, corners, bend):  # type: ignore[no-untyped-def]
    """Say whether nothing lies between a point of the metal and a target."""
    o = p + OFF_MM * n
    way = target - o
    length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    return first_hit(o, way / length, corners, bend, 1e-4, (1.0 - SHORT) * length)[1] < 0


@njit(cache=True)
def _stripe(rays, eye, corners, bend, origin, plane, up, stand, sigma, metal, image, near):  # type: ignore[no-untyped-def]
    """Write the stripe's light (n,) over kappa-free peak for rays (n, 3) from the eye."""
    for i in range(rays.shape[0]):
        image[i] = 0.0
        if not near[i]:
            continue
        t, k = first_hit(eye, rays[i], corners, bend, 1.0, 1e4)
        if k < 0:
            continue
        p = eye + t * rays[i]
        depth = (origin[0] - p[0]) * up[0] + (origin[1] - p[1]) * up[1] + (origin[2] - p[2]) * up[2]
        if depth <= 0.0:
            continue
        aside = plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] + plane[3]
        across = aside * stand / (sigma * depth)
        if abs(across) > SHEET_REACH:
            continue
        n = _normal(p[0], k, corners, bend)
        way = origin - p
        far = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        cos_i = (n[0] * way[0] + n[1] * way[1] + n[2] * way[2]) / depth
        if cos_i <= 0.0 or not _is_open(p, n, origin, corners, bend):
            continue
        lit = math.exp(-0.5 * across * across) * (stand / depth) ** 2 * cos_i
        image[i] = lit * (metal[0] + metal[1] * _lobe(n, way / far, -rays[i], metal[2]))


@njit(cache=True)
def _arc(rays, eye, corners, bend, centre, radius, metal, image):  # type: ignore[no-untyped-def]
    """Write the arc's reflected light (n,) over radiance for rays (n, 3) from the eye."""
    golden = math.pi * (3.0 - math.sqrt(5.0))
    area = 2.0 * math.pi * radius * radius / ARC_POINTS
    for i in range(rays.shape[0]):
        image[i] = 0.0
        t, k = first_hit(eye, rays[i], corners, bend, 1.0, 1e4)
        if k < 0:
            continue
        p = eye + t * rays[i]
        n = _normal(p[0], k, corners, bend)
        turn = 2.0 * math.pi * ((i * 0.7548776662466927) % 1.0)
        total = 0.0
        for m in range(ARC_POINTS):
            cos_t = 1.0 - (m + 0.5) / ARC_POINTS
            sin_t = math.sqrt(1.0 - cos_t * cos_t)
            out = np.array([sin_t * math.cos(golden * m + turn), sin_t * math.sin(golden * m + turn), cos_t])
            source = centre + radius * out
            way = source - p
            far = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
            way /= far
            cos_i = n[0] * way[0] + n[1] * way[1] + n[2] * way[2]
            cos_o = -(out[0] * way[0] + out[1] * way[1] + out[2] * way[2])
            if cos_i > 0.0 and cos_o > 0.0 and _is_open(p, n, source, corners, bend):
                total += (
                    cos_i * cos_o / (far * far) * (metal[0] + metal[1] * _lobe(n, way, -rays[i], metal[2]))
                )
        image[i] = total * area


@dataclass(frozen=True)
class Speckle:
    """Log-normal grains on the stripe's light: their contrast, 0 for none, and the field's sigma, px."""

    contrast: float
    grain_px: float


class SweptWorld:
    """Renders frames of a setup over a swept joint. `setup` has the true values."""

    def __init__(self, setup: Setup, joint: SweptJoint, speckle: Speckle) -> None:
        self.setup, self.joint, self.speckle = setup, joint, speckle
        v, u = np.mgrid[: setup.camera.height, : setup.camera.width].astype(np.float64)
        pixels = np.column_stack([u.ravel(), v.ravel()])
        self._xy = setup.camera.normalised(pixels)
        # A pixel integrates over its area: an edge that was looked at in its middle alone would jump.
        parts = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        self._parts = [setup.camera.normalised(pixels + np.array([du, dv])) for du in parts for dv in parts]
        self._lens_px = math.sqrt(max(setup.camera.psf_sigma_px**2 - 1.0 / 12.0, 0.01))
        self._coarse = (np.indices((setup.camera.height, setup.camera.width)) % ARC_COARSER == 0).all(axis=0)
        self._peak = self._stripe_on_plate()

    def frame(
        self, T_joint_tool: Float64, laser_on: bool, arc_on: bool, draw: np.random.Generator
    ) -> Integers:
        """Return an image (H, W), DN, of one pose."""
        setup = self.setup
        shape = (setup.camera.height, setup.camera.width)
        cos4 = ((1.0 + np.sum(self._xy**2, axis=1)) ** -2.0).reshape(shape)
        charge = np.zeros(shape)
        if laser_on:
            parts = [self._stripe(T_joint_tool, self.joint, xy) for xy in self._parts]
            stripe = np.mean(parts, axis=0).reshape(shape) * cos4 * (setup.laser.peak_e / self._peak)
            stripe = gaussian_filter(stripe, self._lens_px, truncate=6.0)
            charge += stripe * self._grains(shape, draw)
        if arc_on:
            charge += gaussian_filter(self.arc_light(T_joint_tool) * cos4, setup.camera.psf_sigma_px)
        sensor = setup.sensor
        noisy = draw.poisson(np.maximum(charge, 0.0)) + sensor.read_noise_e * draw.standard_normal(shape)
        share = np.minimum(noisy, sensor.full_well_e) / sensor.full_well_e
        over_black = (
            np.sign(share) * np.abs(share) ** sensor.gamma * sensor.full_well_e / sensor.gain_e_per_dn
        )
        codes = np.rint(over_black + sensor.black_level_dn).clip(0, 2**sensor.bits - 1)
        return codes.astype(np.uint8 if sensor.bits == 8 else np.uint16)

    def _grains(self, shape: tuple[int, int], draw: np.random.Generator) -> Float64:
        if self.speckle.contrast == 0.0:
            return np.ones(shape)
        field = gaussian_filter(draw.standard_normal(shape), self.speckle.grain_px, mode="wrap")
        spread = math.sqrt(math.log1p(self.speckle.contrast**2))
        return np.asarray(np.exp(spread * field / field.std() - 0.5 * spread**2))

    def _rays(self, T_joint_tool: Float64, xy: Float64) -> tuple[Float64, Float64]:
        T_joint_camera = T_joint_tool @ self.setup.camera.T_tool_camera
        rays = np.column_stack([xy, np.ones(len(xy))]) @ T_joint_camera[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return np.ascontiguousarray(rays), np.ascontiguousarray(T_joint_camera[:3, 3])

    def _stripe(self, T_joint_tool: Float64, joint: SweptJoint, xy: Float64) -> Float64:
        rays, eye = self._rays(T_joint_tool, xy)
        laser, metal = self.setup.laser, self.setup.material
        normal = T_joint_tool[:3, :3] @ laser.plane[:3]
        plane = np.array([*normal, laser.plane[3] - normal @ T_joint_tool[:3, 3]])
        image = np.empty(len(rays))
        # A ray that passes the sheet far beside any height of the metal is left out.
        top, bottom = (
            max(joint.corners[1:-1, 1], default=0.0) + joint.bend[3] + 40.0,
            joint.corners[:, 1].min() - 15.0,
        )
        low = eye + rays * ((bottom - eye[2]) / rays[:, 2:])
        high = eye + rays * ((min(top, eye[2] - 1.0) - eye[2]) / rays[:, 2:])
        reach = SHEET_REACH * laser.stripe_sigma_mm * 2.0
        off_low, off_high = low @ plane[:3] + plane[3], high @ plane[:3] + plane[3]
        near = (np.minimum(off_low, off_high) < reach) & (np.maximum(off_low, off_high) > -reach)
        _stripe(
            rays, eye, joint.corners, joint.bend, transform(T_joint_tool, laser.origin_mm), plane,
            np.ascontiguousarray(T_joint_tool[:3, 2]), laser.origin_in_tool_mm[2], laser.stripe_sigma_mm,
            np.array([metal.kappa_diff, metal.kappa_spec, metal.c2]), image, near,
        )  # fmt: skip
        return image

    def arc_light(self, T_joint_tool: Float64) -> Float64:
        """Return the arc's light (H, W), e-, before the lens."""
        rays, eye = self._rays(T_joint_tool, self._xy)
        arc, metal = self.setup.arc, self.setup.material
        centre = transform(T_joint_tool, np.asarray(arc.center_in_tool_mm))
        if arc.on_surface:
            centre[2] = arc.center_in_tool_mm[2] + departure(float(centre[0]), self.joint.bend)[2]
        kappas = np.array([metal.kappa_diff, metal.kappa_spec, metal.c2])
        coarse = self._coarse.ravel()
        image = np.empty(int(coarse.sum()))
        _arc(rays[coarse], eye, self.joint.corners, self.joint.bend, centre, arc.radius_mm, kappas, image)
        height, width = self._coarse.shape
        small = image.reshape(-(-height // ARC_COARSER), -(-width // ARC_COARSER))
        # Few points are grainy: their mean over some pixels is not.
        small = gaussian_filter(small, 1.0, mode="nearest").astype(np.float32)
        places = (np.arange(n, dtype=np.float32) / ARC_COARSER for n in (width, height))
        full = cv2.remap(small, *np.meshgrid(*places), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(arc.radiance_e * full.astype(np.float64))

    def _stripe_on_plate(self) -> float:
        """Return the stripe's peak on a flat plate at tool height, level pose, middle column."""
        camera = self.setup.camera
        plate = SweptJoint(
            np.array([[-ACROSS_MM, 0.0], [ACROSS_MM, 0.0]]), np.zeros(2), np.array([0, 1, 0, 0, 1, 1.0])
        )
        cos4 = (1.0 + np.sum(self._xy**2, axis=1)) ** -2.0
        return float(
            (self._stripe(np.eye(4), plate, self._xy) * cos4).reshape(camera.height, camera.width).max()
        )
