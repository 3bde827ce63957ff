"""Pixels that look at one or several scenes: what their rays meet, and the light that they get from there.

A bent seam shows a frame's pixels several scenes, and the frames of a recording show more. All of them are
followed in one compiled call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

import numpy as np

from noise_model.arc.map import ArcKernels, arc_in_scenes, arc_kernels
from noise_model.arc.scene import Scenes
from noise_model.arrays import Bool, Float32, Float64, Int32, Int64
from noise_model.instrument.camera import fall_off
from noise_model.instrument.laser import sheets_of
from noise_model.kernel import kernel
from noise_model.setup import Setup
from noise_model.stripe import SheetSeen, light_stripe, see_sheet
from noise_model.surface.brdf import lobe_numbers
from noise_model.surface.ray_casting import trace

Kept = TypeVar("Kept")


@dataclass(frozen=True, eq=False)
class Sight:
    """Pixels (n,), each of which looks at one of some scenes.

    `which` (n,) says at which; `xy` (n, 2) are the pixels' normalised rays, `cos4` (n,) the lens' fall-off.
    `setup` is what is really there.
    """

    setup: Setup
    scenes: Scenes
    which: Int64
    xy: Float32
    cos4: Float32
    _kept: dict[str, object] = field(default_factory=dict, repr=False)

    @classmethod
    def joined(cls, parts: Sequence[Sight]) -> Sight:
        """Return the pixels of several sights of one setup, one after another."""
        if len(parts) == 1:
            return parts[0]
        before = np.cumsum([0, *(len(part.scenes) for part in parts[:-1])])
        return cls(
            parts[0].setup,
            Scenes.joined([part.scenes for part in parts]),
            np.concatenate([part.which + n for part, n in zip(parts, before, strict=True)]),
            np.concatenate([part.xy for part in parts]),
            np.concatenate([part.cos4 for part in parts]),
        )

    def with_metal(self, setup: Setup) -> Sight:
        """Return the same in a setup that differs by its metal alone: it does not change what rays meet."""
        return replace(self, setup=setup)

    def subset(self, chosen: Bool) -> Sight:
        """Return some of its pixels (n,)."""
        return Sight(self.setup, self.scenes, self.which[chosen], self.xy[chosen], self.cos4[chosen])

    def beside(self, pixels: Int64, uv_px: Float64) -> Sight:
        """Return what looks beside some of its pixels (k,), at places (k, m, 2) as (u, v): k m pixels."""
        xy = self.setup.camera.normalised(uv_px.reshape(-1, 2))
        which = np.repeat(self.which[pixels], uv_px.shape[1])
        return Sight(self.setup, self.scenes, which, xy.astype(np.float32), fall_off(xy).astype(np.float32))

    @property
    def surface(self) -> tuple[Float64, Float64, Int32]:
        """Where the rays end in the joint frame: points (n, 3), mm, unit normals (n, 3), faces (n,).

        NaN, NaN and `ray_casting.MISS` for a ray that looks past the workpiece.
        """
        return self._keep("surface", self._surface)

    def _surface(self) -> tuple[Float64, Float64, Int32]:
        n, shape = len(self.cos4), self.scenes.shape
        points, normals, faces = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, dtype=np.int32)
        poses = self.scenes.T_joint_camera
        trace(self.xy, self.which, poses, shape.vertices, shape.corrugation, points, normals, faces)
        return points, normals, faces

    @property
    def faces(self) -> Int32:
        """The face that each pixel (n,) shows."""
        return self.surface[2]

    def arc_e(self) -> Float32:
        """Return the arc's light (n,), e- for `camera.exposure_s`, at its nominal output.

        It is 0 past the workpiece. Raises ValueError for a pose whose camera stands below the surface.
        """
        kernels = self._keep("arc_kernels", self._arc_kernels)
        kernels = kernels._replace(material=lobe_numbers(self.setup.material))
        points, _, faces = self.surface
        return arc_in_scenes(kernels, self.which, points, faces, self.cos4)

    def _arc_kernels(self) -> ArcKernels:
        x_ranges_mm = np.tile([np.inf, -np.inf], (len(self.scenes), 1))
        _write_ranges(self.surface[0], self.which, x_ranges_mm)
        # Of a scene that nothing shows all that counts is that it asks for little.
        unseen = x_ranges_mm[:, 0] > x_ranges_mm[:, 1]
        x_ranges_mm[unseen] = self.scenes.center_mm[unseen, :1]
        return arc_kernels(self.setup, self.scenes, x_ranges_mm)

    def laser_e(self, unit_e: float) -> Float32:
        """Return the laser stripe (n,), e- for `camera.exposure_s`, before the point-spread function.

        The sheet's irradiance times f_r towards the camera, times `unit_e`: of each pixel that at its centre.
        """
        points, normals, _ = self.surface
        shape, laser, light = self.scenes.shape, self.setup.laser, np.empty(len(points))
        light_stripe(
            points,
            normals,
            self.which,
            np.ascontiguousarray(self.scenes.T_joint_camera[:, :3, 3]),
            sheets_of(laser, self.scenes.T_joint_tool),
            lobe_numbers(self.setup.material),
            laser.reach_sigmas,
            shape.vertices,
            shape.corrugation,
            light,
        )
        return np.asarray(light * (self.cos4 * unit_e), dtype=np.float32)

    @property
    def sheet(self) -> SheetSeen:
        """Where the pixels meet the laser sheet, at their centres."""
        return self._keep("sheet", self._sheet)

    def _sheet(self) -> SheetSeen:
        n, shape, laser = len(self.cos4), self.scenes.shape, self.setup.laser
        seen = SheetSeen(np.empty(n, dtype=np.bool_), np.empty(n, dtype=np.bool_))
        sheets, reach = sheets_of(laser, self.scenes.T_joint_tool), laser.reach_sigmas
        see_sheet(self.surface[0], self.which, sheets, reach, shape.vertices, shape.corrugation, seen)
        return seen

    def _keep(self, name: str, compute: Callable[[], Kept]) -> Kept:
        if name not in self._kept:
            self._kept[name] = compute()
        return cast(Kept, self._kept[name])


@kernel
def _write_ranges(points: Float64, which: Int64, x_ranges: Float64) -> None:
    """Write between which x (m, 2) the points (n, 3) of each scene lie; those of a miss are NaN."""
    for i in range(points.shape[0]):
        s, x = which[i], points[i, 0]
        if x < x_ranges[s, 0]:
            x_ranges[s, 0] = x
        if x > x_ranges[s, 1]:
            x_ranges[s, 1] = x
