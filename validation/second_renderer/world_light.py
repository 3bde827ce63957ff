"""What a pose of a true world shows: surface points, the arc's light and the laser stripe, before the lens.

Formulae are RECORDING.md's. Of `noise_model` only records (setup, joint) and rigid poses are used.
"""

from __future__ import annotations

import copy
import hashlib
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.instrument.camera import Camera
from noise_model.setup import Setup
from noise_model.surface.brdf import Material
from noise_model.transforms import invert, moved, transform
from validation.second_renderer.world_metal import STATED_LOBE, LobeShape
from validation.second_renderer.world_rays import ARC_POINTS, TILE, ArcBody, Caster
from validation.second_renderer.world_surface import Departure, TrueSurface

MARGIN_MM = 120.0
"""The mesh goes on so far before the first and beyond the last station of the tool."""

SHEET_REACH = 6.5
UNDISTORT_STEPS = 60


@dataclass(frozen=True)
class WorldLens:
    """Where a pixel's ray really goes, x_d and r_d in units of the focal length.

    `brown`: x_d = x_u (1 + k1 r_u^2 + k2 r_u^4) (OpenCV's radial part, added to the camera's own five);
    `division`: x_u = x_d / (1 + k1 r_d^2) (Fitzgibbon 2001), of a camera that states no distortion;
    `decentred`: k1 and k2 are added to the camera's p1 and p2 (Brown 1966, Photogramm. Eng. 32, 444).
    """

    kind: str = "brown"
    k1: float = 0.0
    k2: float = 0.0

    def rays(self, camera: Camera, uv_px: Float64) -> Float64:
        """Return the normalised rays (n, 2) of image points (n, 2), px."""
        x_d = (uv_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        if self.kind == "division":
            return np.asarray(x_d / (1.0 + self.k1 * np.sum(x_d**2, axis=1, keepdims=True)))
        k1, k2, p1, p2, k3 = camera.distortion[:5]
        if self.kind == "decentred":
            p1, p2 = p1 + self.k1, p2 + self.k2
        else:
            k1, k2 = k1 + self.k1, k2 + self.k2
        x_u = x_d
        for _ in range(UNDISTORT_STEPS if any((k1, k2, p1, p2, k3)) else 0):
            x, y = x_u.T
            r2 = x * x + y * y
            aside = np.column_stack(
                [2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y]
            )
            x_u = (x_d - aside) / (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))[:, np.newaxis]
        return np.asarray(x_u)


@dataclass(frozen=True)
class SheetProfile:
    """How the laser's irradiance falls off across its sheet, t in sigmas.

    (1 - pedestal) exp(-1/2 |t|^exponent) + pedestal exp(-1/2 (t / pedestal_ratio)^2).
    """

    exponent: float = 2.0
    pedestal: float = 0.0
    pedestal_ratio: float = 1.0

    def at(self, across: Float64) -> Float64:
        """Return the irradiance (n,) at distances (n,), sigmas, over that in the middle."""
        core = np.exp(-0.5 * np.abs(across) ** self.exponent)
        return (1.0 - self.pedestal) * core + self.pedestal * np.exp(
            -0.5 * (across / self.pedestal_ratio) ** 2
        )

    @property
    def reach(self) -> float:
        """How far from the middle the sheet is rendered, sigmas."""
        return float(max(SHEET_REACH ** (2.0 / self.exponent), SHEET_REACH * self.pedestal_ratio))


@dataclass(frozen=True, eq=False)
class TrueWorld:
    """What is really there. `setup` has the true values in place of the stated ones.

    `T_base_joint` (4, 4), mm, is where the joint really lies, `departure` how its seam runs, `lobe` how the
    metal's lobe falls, `lens` how the camera projects, `profile` how the sheet falls off. The arc is
    `arc_height_ratio` of its radius high.
    """

    setup: Setup
    T_base_joint: Float64
    departure: Departure = field(default_factory=Departure)
    lobe: LobeShape = STATED_LOBE
    lens: WorldLens = field(default_factory=WorldLens)
    profile: SheetProfile = field(default_factory=SheetProfile)
    arc_height_ratio: float = 1.0


@dataclass(frozen=True, eq=False)
class WorldSight:
    """What every pixel, (n,) of them in image order, looks at from one pose; joint frame, mm.

    `points` and `normals` (n, 3) are NaN and `faces` (n,) -1 past the metal; `directions` (n, 3) are unit
    vectors from `eye_mm` (3,); `cos4` (n,) the lens' fall-off; `key` names all that entered.
    """

    camera: Camera
    T_joint_tool: Float64
    eye_mm: Float64
    directions: Float64
    cos4: Float64
    points: Float64
    normals: Float64
    faces: Int64
    key: str

    @property
    def shape(self) -> tuple[int, int]:
        """The image's shape."""
        return self.camera.height, self.camera.width

    @cached_property
    def met(self) -> Int64:
        """Indices of the pixels that see metal."""
        return np.flatnonzero(self.faces >= 0)

    @cached_property
    def theta(self) -> Float64:
        """The field angle (H, W), rad."""
        return np.asarray(np.arccos(np.minimum(self.cos4**0.25, 1.0))).reshape(self.shape)

    @cached_property
    def distance_mm(self) -> Float64:
        """How far the metal is from the camera (H, W), mm; NaN past it."""
        return np.asarray(np.linalg.norm(self.points - self.eye_mm, axis=1)).reshape(self.shape)

    @cached_property
    def radius(self) -> Float64:
        """How far pixels (H, W) lie from the image's middle, in half diagonals."""
        u, v = pixel_grid(self.camera)
        w, h = self.camera.width - 1.0, self.camera.height - 1.0
        return np.asarray(2.0 * np.hypot(u - 0.5 * w, v - 0.5 * h) / math.hypot(w, h))


class Studio:
    """Renders a true world and keeps the arc's layers in `cache_dir`, by all that enters them."""

    def __init__(
        self, world: TrueWorld, stations_mm: tuple[float, float], cache_dir: Path | None = None
    ) -> None:
        self.world = world
        self.surface = TrueSurface(world.setup.joint, world.departure)
        self.caster = Caster(self.surface, stations_mm[0] - MARGIN_MM, stations_mm[1] + MARGIN_MM)
        self._cache_dir = cache_dir
        camera = world.setup.camera
        uv = np.column_stack([image.ravel() for image in pixel_grid(camera)])
        self._xy = world.lens.rays(camera, uv)

    def of_metal(self, material: Material) -> Studio:
        """Return the same world of another metal: the laser's power stays, and with it what it was set by."""
        other = copy.copy(self)
        # Kept in the copy: the stripe peaks as stated on the world's own metal.
        other.stripe_on_plate = self.stripe_on_plate
        other.world = replace(self.world, setup=replace(self.world.setup, material=material))
        return other

    def sight(
        self,
        T_base_tool: Float64,
        turn_deg: Sequence[float] = (0.0, 0.0, 0.0),
        move_mm: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> WorldSight:
        """Look from a pose of the tool, the camera turned and moved in its own frame."""
        world = self.world
        camera, joint = world.setup.camera, world.setup.joint
        T_joint_tool = invert(world.T_base_joint) @ T_base_tool
        T_tool_camera = camera.T_tool_camera
        if any((*turn_deg, *move_mm)):
            T_tool_camera = moved(T_tool_camera, turn_deg, move_mm)
        T_joint_camera = T_joint_tool @ T_tool_camera
        rays = np.column_stack([self._xy, np.ones(len(self._xy))])
        directions = rays @ T_joint_camera[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        cos4 = (1.0 + np.sum(self._xy**2, axis=1)) ** -2.0
        seen = self.caster.first_hits(T_joint_camera[:3, 3], directions)
        pinhole = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion
        key = digest(
            pinhole, world.lens, T_joint_camera, joint.type, sorted(joint.dimensions.items()), world.departure
        )
        return WorldSight(camera, T_joint_tool, T_joint_camera[:3, 3], directions, cos4, *seen, key)

    def arc_body(self, sight: WorldSight, shift_mm: tuple[float, float, float]) -> ArcBody:
        """Return the arc of a pose, its centre moved by `shift_mm` in the tool's frame.

        On the surface it keeps its height over the metal's reference surface below it.
        """
        arc = self.world.setup.arc
        offset = np.asarray(arc.center_in_tool_mm) + np.asarray(shift_mm)
        center = transform(sight.T_joint_tool, offset)
        if arc.on_surface:
            center[2] = offset[2] + float(self.surface.lift_mm(center[0])[0])
        return ArcBody(center, arc.radius_mm, self.world.arc_height_ratio)

    def arc_layers(self, sight: WorldSight, arc: ArcBody) -> tuple[Float32, Float32]:
        """Return D and S (H, W) of `Caster.arc_light`, 0 past the metal; kept on disk."""
        world = self.world
        c2 = world.setup.material.c2
        shape = () if arc.height_ratio == 1.0 else (arc.height_ratio,)
        key = digest(sight.key, arc.center_mm, arc.radius_mm, c2, world.lobe, ARC_POINTS, *shape)
        D, S = self.keep(f"arc_{key}", lambda: self._arc_layers(sight, arc))
        return D, S

    def keep(self, name: str, compute: Callable[[], tuple[Float32, ...]]) -> tuple[Float32, ...]:
        """Return images kept on disk under a name, or compute and keep them."""
        if self._cache_dir is None:
            return compute()
        path = self._cache_dir / f"{name}.npz"
        if path.exists():
            with np.load(path) as kept:
                return tuple(kept[f"arr_{n}"] for n in range(len(kept.files)))
        images = compute()
        self._cache_dir.mkdir(parents=True, exist_ok=True)
        half_done = path.with_suffix(f".{os.getpid()}.npz")
        np.savez(half_done, *images)
        half_done.replace(path)
        return images

    def _arc_layers(self, sight: WorldSight, arc: ArcBody) -> tuple[Float32, Float32]:
        u, v = (image.ravel().astype(np.int64) for image in pixel_grid(sight.camera))
        # Another turn in each pose: what is left of the sum's error is no pattern fixed to the image.
        turn = int(sight.key[:8], 16)
        tile = (4 * ((v + turn // 4) % 4) + (u + turn) % 4 + turn // 16) % TILE
        met = sight.met
        seen = sight.points[met], sight.normals[met], -sight.directions[met]
        world = self.world
        lit = self.caster.arc_light(*seen, tile[met], arc, world.setup.material.c2, world.lobe)
        layers = np.zeros((2, len(u)), dtype=np.float32)
        layers[:, met] = lit
        D, S = layers.reshape(2, *sight.shape)
        return D, S

    def arc_light(self, sight: WorldSight, arc: ArcBody) -> Float64:
        """Return the arc's light (H, W), e- for `camera.exposure_s` at the nominal current."""
        D, S = self.arc_layers(sight, arc)
        setup = self.world.setup
        metal = setup.material
        reflected = metal.kappa_diff * D.astype(np.float64) + metal.kappa_spec * S
        return np.asarray(setup.arc.radiance_e * sight.cos4.reshape(sight.shape) * reflected)

    def sheet(self, points: Float64, normals: Float64, T_joint_tool: Float64) -> Float64:
        """Return the laser sheet's irradiance (n,) at points (n, 3) of the joint frame, metal in between too.

        exp(-x'^2 h^2 / (2 sigma^2 z^2)) (h / z)^2 cos(theta_i) / cos(psi); 0 from below and past the fan.
        """
        lit = self._endless_sheet(points, normals, T_joint_tool)
        return np.where(self._in_fan(points, T_joint_tool), lit, 0.0)

    def _in_fan(self, points: Float64, T_joint_tool: Float64) -> Bool:
        """Say whether points (n, 3) lie within the laser's fan, by their angles in the sheet."""
        laser = self.world.setup.laser
        if laser.fan_half_angle_deg is None:
            return np.ones(len(points), dtype=np.bool_)
        rays = transform(invert(T_joint_tool), points) - laser.origin_mm
        rays -= np.outer(rays @ laser.plane[:3], laser.plane[:3])
        across = np.cross(laser.plane[:3], [0.0, 0.0, 1.0])
        aside = rays @ across / np.linalg.norm(across)
        half_angle = np.arcsin(np.abs(aside) / np.linalg.norm(rays, axis=1))
        return np.asarray(half_angle <= math.radians(laser.fan_half_angle_deg))

    def _endless_sheet(self, points: Float64, normals: Float64, T_joint_tool: Float64) -> Float64:
        laser = self.world.setup.laser
        h = laser.origin_in_tool_mm[2]
        T_tool_joint = invert(T_joint_tool)
        up = laser.origin_mm - transform(T_tool_joint, points)
        normals_tool = normals @ T_tool_joint[:3, :3].T
        aside = laser.off_mm(laser.origin_mm - up)
        z = up[:, 2]
        across = aside * h / (laser.stripe_sigma_mm * z)
        lit = self.world.profile.at(across) * (h / z) ** 2 * np.sum(up * normals_tool, axis=1) / z
        return np.where((z > 0.0) & (np.abs(across) < self.world.profile.reach), np.maximum(lit, 0.0), 0.0)

    def stripe(self, sight: WorldSight) -> Float64:
        """Return the laser stripe (H, W), e- for `camera.exposure_s`: it peaks at `peak_e` on the plate."""
        met = sight.met
        lit = self.sheet(sight.points[met], sight.normals[met], sight.T_joint_tool)
        near = met[lit > 0.0]
        points, normals = sight.points[near], sight.normals[near]
        origin = transform(sight.T_joint_tool, self.world.setup.laser.origin_mm)
        value = lit[lit > 0.0] * self._reflectance(points, normals, origin, -sight.directions[near])
        value *= self.caster.open_ways(points, normals, np.broadcast_to(origin, points.shape))
        image = np.zeros(len(sight.faces))
        image[near] = value * sight.cos4[near] * (self.world.setup.laser.peak_e / self.stripe_on_plate)
        return image.reshape(sight.shape)

    @cached_property
    def stripe_on_plate(self) -> float:
        """Irradiance f_r cos^4 at the stripe's peak: flat plate at tool height, level pose, middle column."""
        camera = self.world.setup.camera
        rows = np.linspace(0.0, camera.height - 1.0, 10 * camera.height)
        uv = np.column_stack([np.full_like(rows, 0.5 * (camera.width - 1.0)), rows])
        xy = self.world.lens.rays(camera, uv)
        rays = np.column_stack([xy, np.ones(len(xy))]) @ camera.T_tool_camera[:3, :3].T
        eye = camera.T_tool_camera[:3, 3]
        points = eye - rays * (eye[2] / rays[:, 2:])
        normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
        origin = self.world.setup.laser.origin_mm
        towards = eye - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        value = self._endless_sheet(points, normals, np.eye(4))
        value *= self._reflectance(points, normals, origin, towards)
        return float(np.max(value * (1.0 + np.sum(xy**2, axis=1)) ** -2.0))

    def _reflectance(self, points: Float64, normals: Float64, source: Float64, towards: Float64) -> Float64:
        metal = self.world.setup.material
        omega_i = source - points
        omega_i /= np.linalg.norm(omega_i, axis=1, keepdims=True)
        lobe = self.caster.lobe(normals, omega_i, towards, metal.c2, self.world.lobe)
        return metal.kappa_diff + metal.kappa_spec * lobe


def pixel_grid(camera: Camera) -> tuple[Float64, Float64]:
    """Return the pixels' columns u and rows v, both (H, W)."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    return u, v


def digest(*parts: object) -> str:
    """Return a name for values that repeats only if all of them do."""
    name = hashlib.sha256()
    for part in parts:
        name.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
        name.update(b"|")
    return name.hexdigest()[:32]
