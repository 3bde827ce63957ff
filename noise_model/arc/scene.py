"""Camera, arc and surface of a pose in the joint frame, for each stretch of a seam that it looks at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64, as_compiled_for
from noise_model.compiled.kernel import kernel
from noise_model.instrument.camera import Camera
from noise_model.setup import Setup
from noise_model.surface.faces import height_under, ridge
from noise_model.surface.joint import (
    NOMINAL_SEAM,
    BentSeam,
    SeamLine,
    SeamSegments,
    SurfaceSection,
    crossed_segment,
    line_frame,
    section,
)
from noise_model.transforms import inverted, moved_point, multiplied


class Scene(NamedTuple):
    """Camera, arc and surface of one pose in the joint frame, as the kernels take and give them.

    `T_joint_camera` (4, 4) mm, `T_joint_tool` (4, 4) mm, `center_mm` (3,) the arc's centre, `shape` the
    section. `bend` says how the section's edges leave the direction of x on their way to the arc: their slope
    dy/dx at the section, how far to the left they run under the arc, mm. `footprint_mm` (2, 2) is between
    which x and y the camera sees the joint: its rim's rays are followed to the highest and the lowest level
    between the plates, and to the plates where these rise or fall. `below_surface` says whether the camera
    stands in or under the workpiece, where no prediction makes sense.
    """

    T_joint_tool: Float64
    T_joint_camera: Float64
    center_mm: Float64
    shape: SurfaceSection
    bend: tuple[float, float]
    footprint_mm: Float64
    below_surface: bool

    @property
    def stations_mm(self) -> tuple[float, float, float]:
        """From which station to which the camera sees the plate, and the torch's."""
        first, last = self.footprint_mm[0].tolist()
        return first, last, float(self.T_joint_tool[0, 3])


@dataclass(frozen=True, eq=False)
class Scenes:
    """The scenes of several stretches of a seam, or of several poses, of one camera and one joint.

    Its arrays are those of a `Scene`, one below the other: (n, 4, 4), (n, 3), `bend` (n, 2), (n, 2, 2), (n,).
    """

    T_joint_tool: Float64
    T_joint_camera: Float64
    center_mm: Float64
    shape: SurfaceSection
    bend: Float64
    footprint_mm: Float64
    below_surface: Bool

    @classmethod
    def of(cls, scenes: Sequence[Scene]) -> Scenes:
        """Return some scenes as one."""
        return cls(
            np.array([scene.T_joint_tool for scene in scenes]),
            np.array([scene.T_joint_camera for scene in scenes]),
            np.array([scene.center_mm for scene in scenes]),
            scenes[0].shape,
            np.array([scene.bend for scene in scenes]),
            np.array([scene.footprint_mm for scene in scenes]),
            np.array([scene.below_surface for scene in scenes]),
        )

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.center_mm)

    def __getitem__(self, i: int) -> Scene:
        """Return one of the scenes."""
        slope, aside_mm = self.bend[i].tolist()
        places = self.T_joint_tool[i], self.T_joint_camera[i], self.center_mm[i]
        return Scene(
            *places, self.shape, (slope, aside_mm), self.footprint_mm[i], bool(self.below_surface[i])
        )


class SceneSource(NamedTuple):
    """Part of all scenes that a setup fixes, as the kernels take it.

    `segments` are its joint's nominal seam, `shape` its section. `sheet` (4,) is the laser's plane,
    `ahead_mm` (3,) where that is at tool height, tool frame: by both the seam's segment is chosen.
    `T_tool_camera` (4, 4) mm, `rim_rays` (9, 3) the camera's, `arc_mm` (3,) the arc's centre, tool frame,
    which keeps its height `on_surface`. Where it `has_ridges` they stay across the nominal line.
    """

    segments: SeamSegments
    shape: SurfaceSection
    sheet: Float64
    ahead_mm: Float64
    T_tool_camera: Float64
    rim_rays: Float64
    arc_mm: Float64
    on_surface: bool
    has_ridges: bool

    @classmethod
    def of(cls, setup: Setup) -> SceneSource:
        """Gather a setup."""
        return cls(
            segments=SeamSegments.of(setup.joint),
            shape=section(setup.joint),
            sheet=np.array(setup.laser.plane, dtype=np.float64),
            ahead_mm=setup.laser.point_mm,
            T_tool_camera=np.require(setup.camera.T_tool_camera, np.float64, ("C", "W")),
            rim_rays=_rim_rays(*setup.camera.geometry),
            arc_mm=np.array(setup.arc.center_in_tool_mm, dtype=np.float64),
            on_surface=setup.arc.on_surface,
            has_ridges=setup.joint.has_ridges,
        )


def make_scene(
    setup: Setup, T_base_tool: Float64, seam: SeamLine = NOMINAL_SEAM, ground: SeamLine | None = None
) -> Scene:
    """Put camera, arc and surface of a pose into the joint frame.

    Where the true seam runs relative to its nominal line, the joint frame, the section and the arc that
    stands on it go with it; but ridges stay across the nominal line when the seam between them turns.
    `ground` is another stretch of a bent seam, on whose surface the arc stands.
    """
    return scene_along(SceneSource.of(setup), T_base_tool, seam, ground)


def make_scenes(setup: Setup, T_base_tool: Sequence[Float64], seams: Sequence[BentSeam]) -> Scenes:
    """Return the scenes of some poses along each stretch of the seam at each of them, see `make_scene`."""
    source = SceneSource.of(setup)
    scenes: list[Scene] = []
    for T, seam in zip(map(as_compiled_for, T_base_tool), seams, strict=True):
        segment = crossed_segment(source.segments, T, source.sheet, source.ahead_mm)
        ground = seam.ground.as_floats()
        scenes += [laid_scene(source, T, segment, line.as_floats(), ground, False) for line in seam.lines]
    return Scenes.of(scenes)


def scene_along(
    source: SceneSource, T_base_tool: Float64, seam: SeamLine, ground: SeamLine | None = None
) -> Scene:
    """Return the scene of a pose along a stretch of the seam, see `make_scene`."""
    T = as_compiled_for(T_base_tool)
    segment = crossed_segment(source.segments, T, source.sheet, source.ahead_mm)
    line = seam.as_floats()
    on = line if ground is None else ground.as_floats()
    scene: Scene = laid_scene(source, T, segment, line, on, ground is None)
    return scene


@kernel(allocates=True)
def laid_scene(
    source: SceneSource,
    T_base_tool: Float64,
    segment: int,
    seam: SeamLine,
    ground: SeamLine,
    is_own_ground: bool,
) -> Scene:
    """Return the scene of a pose along a stretch, given relative to a segment of the nominal line.

    `is_own_ground` says that the arc stands on the stretch itself.
    """
    along_x = seam
    if source.has_ridges:
        along_x = SeamLine(seam.station_mm, seam.y_mm, seam.z_mm, 0.0, seam.slope_z, seam.slope_sigma)
    T_nominal_tool = multiplied(inverted(source.segments.frames[segment]), T_base_tool)
    T_laid_nominal = inverted(line_frame(along_x))
    T_joint_tool = multiplied(T_laid_nominal, T_nominal_tool)
    T_joint_camera = multiplied(T_joint_tool, source.T_tool_camera)
    # Where another stretch's plate and seam run, or the seam's own that no ridge follows.
    T_laid_ground = multiplied(T_laid_nominal, line_frame(ground))
    center_mm = _arc_center(source, T_joint_tool, along_x.slope_z, T_laid_ground, is_own_ground)
    turn = seam.slope_y - along_x.slope_y
    aside_mm = 0.0
    if not is_own_ground or turn != 0.0:
        slope = T_laid_ground[1, 0] / T_laid_ground[0, 0]
        aside_mm = T_laid_ground[1, 3] + slope * (center_mm[0] - T_laid_ground[0, 3])
    footprint_mm = np.empty((2, 2))
    vertices, corrugation = source.shape
    _write_footprint(source.rim_rays, T_joint_camera, vertices, corrugation, footprint_mm)
    below = is_below(T_joint_camera[0, 3], T_joint_camera[1, 3], T_joint_camera[2, 3], vertices, corrugation)
    return Scene(T_joint_tool, T_joint_camera, center_mm, source.shape, (turn, aside_mm), footprint_mm, below)


@kernel(allocates=True)
def _arc_center(
    source: SceneSource, T_joint_tool: Float64, slope_z: float, T_laid_ground: Float64, is_own_ground: bool
) -> Float64:
    """Return the arc's centre (3,), joint frame, mm.

    Over the surface the arc keeps its height, and a tilted tool carries its foot sideways. The way down is
    upright, and an inclined sheet's ridges are not.
    """
    center = moved_point(T_joint_tool, source.arc_mm)
    if not source.on_surface:
        return center
    offset_z, corrugation = source.arc_mm[2], source.shape.corrugation
    foot, height = center[0] - slope_z * center[2], 0.0
    # Each leaves a hundredth of what a sheet's tilt moves the foot of the arc by.
    for _ in range(3 if corrugation[0] > 0.0 else 0):
        height = ridge(foot, corrugation)[0]
        foot = center[0] - slope_z * (center[2] - height)
    center[0], center[2] = foot + slope_z * offset_z, offset_z + height
    if not is_own_ground:
        T = T_laid_ground
        rise = T[0, 2] * (center[0] - T[0, 3]) + T[1, 2] * (center[1] - T[1, 3])
        center[2] += T[2, 3] - rise / T[2, 2]
    return center


@kernel
def is_below(x: float, y: float, z: float, vertices: Float64, corrugation: Float64) -> bool:
    """Return True if a place of the joint frame, mm, lies in or under a section."""
    return bool(z <= height_under(x, y, vertices, corrugation))


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
        min_descent = -0.1 * math.sqrt(d_x * d_x + d_y * d_y + d_z * d_z)
        for which in range(4):
            slope, level = 0.0, lowest if which == 0 else highest
            if which >= 2:
                edge, end = (1, 0) if which == 2 else (last - 1, last)
                slope = (vertices[end, 1] - vertices[edge, 1]) / (vertices[end, 0] - vertices[edge, 0])
                level = vertices[edge, 1] + slope * (eye_y - vertices[edge, 0])
                if slope == 0.0:
                    continue
            way = (level - eye_z) / min(d_z - slope * d_y, min_descent)
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
    camera = Camera(
        width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, T_tool_camera=np.eye(4), distortion=distortion
    )
    u, v = np.meshgrid([0.0, 0.5 * (width - 1.0), width - 1.0], [0.0, 0.5, 1.0])
    rim = camera.normalised(np.column_stack([u.ravel(), v.ravel() * (height - 1.0)]))
    return np.column_stack([rim, np.ones(len(rim))])
