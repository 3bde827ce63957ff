"""The arc map: per pixel the mean of the arc's light for the robot's present pose (Eq. 8-14, 18).

The arc is a Lambertian emitter, so L cos(phi) dA / r^2 is L d(omega) and a pixel receives

    radiance_e cos^4 * integral over the visible directions of f_r(omega, omega_r) cos(theta_i) d(omega).

`quadrature` holds the integral of one surface point, `ray` a ray's, `table` the faces' light as
piecewise polynomials and `fill` the filling of bands and frames from them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from noise_model.arc.fill import MIXED, fill_band, fill_pixels
from noise_model.arc.quadrature import gauss_nodes
from noise_model.arc.ray import ArcKernel as ArcKernel
from noise_model.arc.ray import follow, light_at, scratch
from noise_model.arc.table import TO_POWERS, FaceTable, new_table
from noise_model.arrays import Float32, Float64, Int32, Int64
from noise_model.instrument.camera import Camera
from noise_model.kernel import kernel
from noise_model.setup import Setup
from noise_model.surface.brdf import lobe_numbers
from noise_model.surface.faces import ridge
from noise_model.surface.joint import NOMINAL_SEAM, SeamLine, Section, corrugation_height, seam_frame, section
from noise_model.surface.ray_casting import MISS
from noise_model.surface.visibility import horizon_tables, is_curved_lap
from noise_model.transforms import invert, transform

NODES_P, NODES_Q = 8, 4
"""Nodes across the arc's disc and up a chord."""

TOLERANCE, FLOOR_E = 0.005, 20.0
"""How far a filled map may be off: relative, or in electrons where that is more."""

MAX_MARGIN_MM = 4.0
"""No face is continued further beyond its edges."""

FOOT_STEPS = 3
"""Each leaves a hundredth of what a sheet's tilt moves the foot of the arc by."""

CELL = 8
"""So many scan lines of a band share its place."""


@dataclass(frozen=True)
class Scene:
    """Camera, arc and surface of one pose in the joint frame.

    `T_joint_camera` (4, 4) mm, `T_joint_tool` (4, 4) mm, `camera` itself, `center_mm` (3,) the arc's centre,
    `shape` the section. `bend` says how the section's edges leave the direction of x on their way to the arc:
    their slope dy/dx at the section, how far to the left they run under the arc, mm.
    """

    T_joint_tool: Float64
    T_joint_camera: Float64
    camera: Camera
    center_mm: Float64
    shape: Section
    bend: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def footprint_mm(self) -> Float64:
        """Between which x and y (2, 2), mm, joint frame, the camera sees the joint.

        Its rim's rays are followed to the highest and the lowest level between the plates, and to the plates
        where these rise or fall.
        """
        footprint = np.empty((2, 2))
        _write_footprint(
            _rim_rays(*self.camera.geometry),
            self.T_joint_camera,
            self.shape.vertices,
            self.shape.corrugation,
            footprint,
        )
        return footprint

    @property
    def stations_mm(self) -> tuple[float, float, float]:
        """From which station to which the camera sees the plate, and the torch's."""
        first, last = self.footprint_mm[0]
        return float(first), float(last), float(self.T_joint_tool[0, 3])

    @cached_property
    def below_surface(self) -> bool:
        """Whether the camera stands in or under the workpiece, where no prediction makes sense."""
        x, y, z = self.T_joint_camera[:3, 3]
        plain = float(np.interp(y, self.shape.vertices[:, 0], self.shape.vertices[:, 1]))
        return bool(z <= plain + float(corrugation_height(np.array(x), self.shape.corrugation)))


def make_scene(
    setup: Setup, T_base_tool: Float64, seam: SeamLine = NOMINAL_SEAM, ground: SeamLine | None = None
) -> Scene:
    """Put camera, arc and surface of a pose into the joint frame.

    Where the true seam runs beside its nominal line, the joint frame, the section and the arc that stands on
    it go with it; but ridges stay across the nominal line when the seam between them turns. `ground` is
    another stretch of a bent seam, on whose surface the arc stands.
    """
    return make_scenes(setup, T_base_tool, (seam,), ground)[0]


def make_scenes(
    setup: Setup, T_base_tool: Float64, seams: Sequence[SeamLine], ground: SeamLine | None = None
) -> list[Scene]:
    """Return the scenes of a pose along each of some stretches of the seam, see `make_scene`."""
    has_ridges = setup.joint.has_ridges
    laid = [replace(seam, slope_y=0.0) if has_ridges and seam.slope_y != 0.0 else seam for seam in seams]
    T_nominal_tool = invert(seam_frame(setup.joint, _ahead(setup, T_base_tool))) @ T_base_tool
    T_laid_nominal = _inverted(np.array([line.frame() for line in laid]))
    T_joint_tool = T_laid_nominal @ T_nominal_tool
    T_joint_camera = T_joint_tool @ setup.camera.T_tool_camera
    shape = section(setup.joint)
    offset = np.asarray(setup.arc.center_in_tool_mm)
    center = T_joint_tool[:, :3, :3] @ offset + T_joint_tool[:, :3, 3]
    # Where another stretch's plate and seam run, or the seam's own that no ridge follows.
    T_laid_ground = T_laid_nominal @ np.array([(ground or seam).frame() for seam in seams])
    along, up, origin = (T_laid_ground[:, :3, column] for column in (0, 2, 3))
    if setup.arc.on_surface:
        # Over the surface the arc keeps its height, and a tilted tool carries its foot sideways.
        # The way down is upright, and an inclined sheet's ridges are not.
        slope_z = np.array([line.slope_z for line in laid])
        foot, height = center[:, 0] - slope_z * center[:, 2], np.zeros(len(seams))
        for _ in range(FOOT_STEPS if shape.corrugation[0] > 0.0 else 0):
            height = corrugation_height(foot, shape.corrugation)
            foot = center[:, 0] - slope_z * (center[:, 2] - height)
        center[:, 0], center[:, 2] = foot + slope_z * offset[2], offset[2] + height
        if ground is not None:
            beside = up[:, :2] * (center[:, :2] - origin[:, :2])
            center[:, 2] += origin[:, 2] - beside.sum(axis=1) / up[:, 2]
    beside_mm = origin[:, 1] + along[:, 1] / along[:, 0] * (center[:, 0] - origin[:, 0])
    bends = [
        (seam.slope_y - line.slope_y, 0.0 if (ground or seam) is line else aside_mm)
        for seam, line, aside_mm in zip(seams, laid, beside_mm.tolist(), strict=True)
    ]
    placed = zip(T_joint_tool, T_joint_camera, center, bends, strict=True)
    return [
        Scene(T_tool, T_camera, setup.camera, arc_mm, shape, bend)
        for T_tool, T_camera, arc_mm, bend in placed
    ]


def _inverted(T_a_b: Float64) -> Float64:
    """Return T_b_a (n, 4, 4) of rigid T_a_b (n, 4, 4)."""
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[:, :3, :3] = T_a_b[:, :3, :3].swapaxes(1, 2)
    T_b_a[:, :3, 3:] = -T_b_a[:, :3, :3] @ T_a_b[:, :3, 3:]
    T_b_a[:, 3, 3] = 1.0
    return T_b_a


def _ahead(setup: Setup, T_base_tool: Float64) -> Float64:
    """Return the point of base where the sheet is at tool height: by it the seam's segment is chosen."""
    return transform(T_base_tool, setup.laser.point_mm)


@kernel
def _write_footprint(
    rays: Float64, T_joint_camera: Float64, vertices: Float64, corrugation: Float64, footprint: Float64
) -> None:
    """Write between which x and y (2, 2) rays (n, 3) of the camera, followed as `Scene` says, end."""
    T, last = T_joint_camera, vertices.shape[0] - 1
    eye_y, eye_z = T[1, 3], T[2, 3]
    lowest, highest = math.inf, -math.inf
    for j in range(1, last):
        lowest, highest = min(lowest, vertices[j, 1]), max(highest, vertices[j, 1] + corrugation[0])
    for c in range(2):
        footprint[c, 0], footprint[c, 1] = math.inf, -math.inf
    for i in range(rays.shape[0]):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        d_x = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
        d_y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
        d_z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
        # A ray that does not go down meets no plate: it is followed to a slope of 1 in 10 at most.
        least = -0.1 * math.sqrt(d_x * d_x + d_y * d_y + d_z * d_z)
        for which in range(4):
            slope, level = 0.0, lowest if which == 0 else highest
            if which >= 2:
                edge, end = (1, 0) if which == 2 else (last - 1, last)
                slope = (vertices[end, 1] - vertices[edge, 1]) / (vertices[end, 0] - vertices[edge, 0])
                level = vertices[edge, 1] + slope * (eye_y - vertices[edge, 0])
                if slope == 0.0:
                    continue
            way = (level - eye_z) / min(d_z - slope * d_y, least)
            for c in range(2):
                coordinate = T[c, 3] + way * (d_x if c == 0 else d_y)
                footprint[c, 0], footprint[c, 1] = (
                    min(footprint[c, 0], coordinate),
                    max(footprint[c, 1], coordinate),
                )


@lru_cache
def _rim_rays(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: tuple[float, ...]
) -> Float64:
    """Return rays (9, 3) of the image's corners, its sides' middles and its own, camera frame."""
    camera = Camera(width, height, fx, fy, cx, cy, np.eye(4), distortion)
    u, v = np.meshgrid([0.0, 0.5 * (width - 1.0), width - 1.0], [0.0, 0.5, 1.0])
    rim = camera.normalised(np.column_stack([u.ravel(), v.ravel() * (height - 1.0)]))
    return np.column_stack([rim, np.ones(len(rim))])


def _metal_cuts(radius: float, scene: Scene) -> bool:
    """Say whether the sheets of a lap whose edge is not straight may cut into the luminous half-sphere."""
    vertices, corrugation = scene.shape.vertices, scene.shape.corrugation
    if not is_curved_lap(vertices, corrugation, scene.bend):
        return False
    x, y, z = scene.center_mm.tolist()
    return bool(any_below((x, y - scene.bend[1], z), radius, ON_HALF_SPHERE, vertices, corrugation))


def _on_half_sphere() -> Float64:
    """Return directions (n, 3) all over the upper half-sphere."""
    tau, delta = np.meshgrid(np.linspace(0.0, 0.5 * np.pi, 10), np.linspace(0.0, 2.0 * np.pi, 24))
    sin = np.sin(tau)
    return np.stack([sin * np.cos(delta), sin * np.sin(delta), np.cos(tau)], axis=-1).reshape(-1, 3)


ON_HALF_SPHERE = _on_half_sphere()
"""Where it is seen whether metal cuts into the arc."""

CUT_MM = 1e-6
"""A point so far below the surface is below it."""


@kernel
def any_below(
    center: tuple[float, float, float],
    radius: float,
    outward: Float64,
    vertices: Float64,
    corrugation: Float64,
) -> bool:
    """Say whether a sphere's point in any of some directions (n, 3) lies below a section's surface.

    `center` is the sphere's, mm, joint frame. The plain twin compares with `ray_casting.surface_height`.
    """
    for i in range(outward.shape[0]):
        y = center[1] + radius * outward[i, 1]
        # The face's right end: the last vertex that is not beyond y.
        j = 0
        while j < vertices.shape[0] - 2 and vertices[j + 1, 0] <= y:
            j += 1
        share = min(max((y - vertices[j, 0]) / (vertices[j + 1, 0] - vertices[j, 0]), 0.0), 1.0)
        plain = vertices[j, 1] + share * (vertices[j + 1, 1] - vertices[j, 1])
        height = plain + ridge(center[0] + radius * outward[i, 0], corrugation)[0]
        if center[2] + radius * outward[i, 2] < height - CUT_MM:
            return True
    return False


def arc_kernel(
    setup: Setup, scene: Scene, level: float = 1.0, nodes: tuple[int, int] = (NODES_P, NODES_Q)
) -> ArcKernel:
    """Gather a scene for the kernels; `level` is the arc's output over the nominal one.

    Raises ValueError for a pose whose camera stands below the surface.
    """
    if scene.below_surface:
        raise ValueError("the camera stands below the surface at this pose")
    x, y, z = scene.T_joint_camera[:3, 3]
    x_range, y_range = scene.footprint_mm.tolist()
    radius = setup.arc.radius_mm
    start, horizons = horizon_tables(scene.shape, (x_range[0], x_range[1]), scene.center_mm, radius)
    return ArcKernel(
        np.ascontiguousarray(scene.T_joint_camera[:3, :3]),
        (float(x), float(y), float(z)),
        (float(scene.center_mm[0]), float(scene.center_mm[1]), float(scene.center_mm[2])),
        scene.bend,
        radius,
        setup.arc.radiance_e * level,
        scene.shape.vertices,
        scene.shape.corrugation,
        start,
        horizons,
        _metal_cuts(radius, scene),
        (*x_range, *y_range),
        lobe_numbers(setup.material),
        gauss_nodes(),
        *nodes,
    )


@kernel(allocates=True)
def _arc_pixels(
    k: ArcKernel, xy: Float32, cos4: Float32, pixels: Int64, mean_e: Float32, faces: Int32
) -> None:
    """Fill `mean_e` and `faces` (n,) of some pixels (n,), see `arc_at`."""
    work = scratch()
    for i in range(pixels.shape[0]):
        P, face = follow(k, xy[pixels[i], 0], xy[pixels[i], 1])
        faces[i] = face
        mean_e[i] = math.nan if face == MISS else cos4[pixels[i]] * light_at(k, P, face, work)


def arc_at(kernel: ArcKernel, xy: Float32, cos4: Float32, pixels: Int64) -> tuple[Float32, Int32]:
    """Return the arc's mean, e- for `camera.exposure_s`, and the face seen at some pixels (n,).

    `xy` (H W, 2) and `cos4` (H W,) are the flattened `camera.Rays`. Before the point-spread function; NaN
    where a pixel looks past the workpiece.
    """
    mean_e = np.empty(len(pixels), dtype=np.float32)
    faces = np.empty(len(pixels), dtype=np.int32)
    _arc_pixels(kernel, xy, cos4, pixels, mean_e, faces)
    return mean_e, faces


@dataclass(frozen=True, eq=False)
class ArcMap:
    """The arc's light on a camera's rays, read off tables of the faces that are made where they are asked.

    `xy` (n_scan n_pos, 2) and `cos4` (n_scan n_pos,) are the camera's rays by scan line. All light is e- for
    `camera.exposure_s`, before the point-spread function, and NaN where a pixel looks past the workpiece.
    """

    kernel: ArcKernel
    xy: Float32
    cos4: Float32
    table: FaceTable

    @classmethod
    def of(
        cls,
        kernel: ArcKernel,
        xy: Float32,
        cos4: Float32,
        n_scan: int,
        tolerance: float = TOLERANCE,
        floor_e: float = FLOOR_E,
    ) -> ArcMap:
        """Begin the map of a scene.

        `tolerance`, relative, and `floor_e`, whichever is more, bound what the faces' tables and the cells
        read off them may each be off, halves of it where all is smooth; docs/explanation/arc_map.md says what
        is reached.
        """
        margin_mm = _margin_mm(kernel, xy, n_scan)
        return cls(kernel, xy, cos4, new_table(kernel, margin_mm, tolerance, floor_e, TO_POWERS))

    def at(self, pixels: Int64) -> Float32:
        """Return the light (n,) at some pixels (n,)."""
        mean_e = np.empty(len(pixels), dtype=np.float32)
        fill_pixels(self.kernel, self.table, self.xy, self.cos4, pixels, mean_e)
        return mean_e

    def fill(self, lows: Int64, band_e: Float32) -> None:
        """Fill a band (n_scan, depth); CELL lines each begin at a place of `lows` (ceil(n_scan / CELL),)."""
        fill_band(self.kernel, self.table, self.xy, self.cos4, lows, CELL, band_e)


def _margin_mm(kernel: ArcKernel, xy: Float32, n_scan: int) -> float:
    """Return how far a cell of `MIXED` pixels reaches on a level face, beyond its edge, mm."""
    # An image of one pixel has no step.
    first = max(0, min(len(xy) // n_scan // 2, len(xy) - 2))
    pixel = float(np.hypot(*np.diff(xy[first : first + 2], axis=0).sum(axis=0)))
    distance = kernel.eye[2] / max(0.1, abs(kernel.rotation[2, 2]))
    margin: float = min(MIXED * pixel * distance, MAX_MARGIN_MM)
    return margin


def arc_frame(
    kernel: ArcKernel,
    xy: Float32,
    cos4: Float32,
    shape: tuple[int, int],
    tolerance: float = TOLERANCE,
    floor_e: float = FLOOR_E,
) -> Float32:
    """Return the whole `ArcMap` (H, W), e-; NaN where a pixel looks past the workpiece."""
    frame_e = np.empty(shape, dtype=np.float32)
    lows = np.zeros(-(-shape[0] // CELL), dtype=np.int64)
    ArcMap.of(kernel, xy, cos4, shape[0], tolerance, floor_e).fill(lows, frame_e)
    return frame_e
