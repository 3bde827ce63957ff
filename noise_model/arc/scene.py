"""Camera, arc and surface of a pose in the joint frame, for each stretch of a seam that it looks at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from noise_model.arrays import Bool, Float64
from noise_model.instrument.camera import Camera
from noise_model.kernel import kernel
from noise_model.setup import Setup
from noise_model.surface.joint import (
    NOMINAL_SEAM,
    BentSeam,
    SeamLine,
    Section,
    corrugation_height,
    seam_frame,
    section,
)
from noise_model.transforms import invert, transform

FOOT_STEPS = 3
"""Each leaves a hundredth of what a sheet's tilt moves the foot of the arc by."""


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
        rays, shape = _rim_rays(*self.camera.geometry), self.shape
        _write_footprint(rays, self.T_joint_camera, shape.vertices, shape.corrugation, footprint)
        return footprint

    @property
    def stations_mm(self) -> tuple[float, float, float]:
        """From which station to which the camera sees the plate, and the torch's."""
        first, last = self.footprint_mm[0]
        return float(first), float(last), float(self.T_joint_tool[0, 3])

    @cached_property
    def below_surface(self) -> bool:
        """Whether the camera stands in or under the workpiece, where no prediction makes sense."""
        return bool(_are_below(self.T_joint_camera[:3, 3], self.shape))


@dataclass(frozen=True, eq=False)
class Scenes:
    """The scenes of several stretches of a seam, or of several poses, of one camera and one joint.

    Its arrays are those of a `Scene`, one below the other: (n, 4, 4), (n, 3), `bend` (n, 2).
    """

    T_joint_tool: Float64
    T_joint_camera: Float64
    camera: Camera
    center_mm: Float64
    shape: Section
    bend: Float64

    @classmethod
    def alone(cls, scene: Scene) -> Scenes:
        """Return one scene as scenes."""
        poses = scene.T_joint_tool[np.newaxis], scene.T_joint_camera[np.newaxis]
        return cls(*poses, scene.camera, scene.center_mm[np.newaxis], scene.shape, np.array([scene.bend]))

    def __len__(self) -> int:
        """Return how many scenes there are."""
        return len(self.center_mm)

    def __getitem__(self, i: int) -> Scene:
        """Return one of the scenes."""
        slope, aside_mm = self.bend[i].tolist()
        poses = self.T_joint_tool[i], self.T_joint_camera[i]
        return Scene(*poses, self.camera, self.center_mm[i], self.shape, (slope, aside_mm))

    @cached_property
    def below_surface(self) -> Bool:
        """The `Scene.below_surface` of each (n,)."""
        return _are_below(self.T_joint_camera[:, :3, 3], self.shape)


def _are_below(places_mm: Float64, shape: Section) -> Bool:
    """Say which places (..., 3), joint frame, lie in or under a section."""
    x, y, z = places_mm.T
    plain = np.interp(y, shape.vertices[:, 0], shape.vertices[:, 1])
    return np.asarray(z <= plain + corrugation_height(x, shape.corrugation))


def make_scene(
    setup: Setup, T_base_tool: Float64, seam: SeamLine = NOMINAL_SEAM, ground: SeamLine | None = None
) -> Scene:
    """Put camera, arc and surface of a pose into the joint frame.

    Where the true seam runs beside its nominal line, the joint frame, the section and the arc that stands on
    it go with it; but ridges stay across the nominal line when the seam between them turns. `ground` is
    another stretch of a bent seam, on whose surface the arc stands.
    """
    T_nominal_tool = _nominal_pose(setup, T_base_tool)[np.newaxis]
    return _along(setup, T_nominal_tool, (seam,), None if ground is None else (ground,))[0]


def make_scenes(setup: Setup, T_base_tool: Sequence[Float64], seams: Sequence[BentSeam]) -> Scenes:
    """Return the scenes of some poses along each stretch of the seam at each of them, see `make_scene`."""
    counts = [len(seam.lines) for seam in seams]
    T_nominal_tool = np.repeat([_nominal_pose(setup, T) for T in T_base_tool], counts, axis=0)
    grounds = [seam.ground for seam in seams for _ in seam.lines]
    return _along(setup, T_nominal_tool, [line for seam in seams for line in seam.lines], grounds)


def _nominal_pose(setup: Setup, T_base_tool: Float64) -> Float64:
    """Return T_nominal_tool, the tool's pose in the frame of the nominal joint."""
    return invert(seam_frame(setup.joint, _ahead(setup, T_base_tool))) @ T_base_tool


def _along(
    setup: Setup, T_nominal_tool: Float64, seams: Sequence[SeamLine], grounds: Sequence[SeamLine] | None
) -> Scenes:
    """Return the scenes of poses (n, 4, 4), each along its stretch and on its ground, see `make_scene`."""
    has_ridges = setup.joint.has_ridges
    laid = [replace(seam, slope_y=0.0) if has_ridges and seam.slope_y != 0.0 else seam for seam in seams]
    T_laid_nominal = _inverted(np.array([line.frame() for line in laid]))
    T_joint_tool = T_laid_nominal @ T_nominal_tool
    T_joint_camera = T_joint_tool @ setup.camera.T_tool_camera
    shape = section(setup.joint)
    offset = np.asarray(setup.arc.center_in_tool_mm)
    center = T_joint_tool[:, :3, :3] @ offset + T_joint_tool[:, :3, 3]
    # Where another stretch's plate and seam run, or the seam's own that no ridge follows.
    T_laid_ground = T_laid_nominal @ np.array([ground.frame() for ground in grounds or seams])
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
        if grounds is not None:
            beside = up[:, :2] * (center[:, :2] - origin[:, :2])
            center[:, 2] += origin[:, 2] - beside.sum(axis=1) / up[:, 2]
    beside_mm = origin[:, 1] + along[:, 1] / along[:, 0] * (center[:, 0] - origin[:, 0])
    beside_mm[[ground is line for ground, line in zip(grounds or seams, laid, strict=True)]] = 0.0
    turns = [seam.slope_y - line.slope_y for seam, line in zip(seams, laid, strict=True)]
    return Scenes(
        T_joint_tool, T_joint_camera, setup.camera, center, shape, np.column_stack([turns, beside_mm])
    )


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
