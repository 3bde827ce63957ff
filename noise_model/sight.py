"""Pixels that look at one or several scenes: what their rays meet, and the light that they get from there.

A bent seam shows a frame's pixels several scenes, and the frames of a recording show more. All of them are
followed in one compiled call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar, cast

import numpy as np

from noise_model.arc.map import ArcKernels, arc_in_scenes, arc_kernels
from noise_model.arc.scene import Scenes, make_scenes
from noise_model.compiled.arrays import Bool, Float32, Float64, Int32, Int64, Integers
from noise_model.compiled.kernel import kernel
from noise_model.instrument.camera import Rays, fall_off
from noise_model.instrument.laser import sheets_of
from noise_model.setup import Setup
from noise_model.stripe import SheetReach, light_stripe, see_sheet
from noise_model.surface.brdf import lobe_numbers
from noise_model.surface.joint import BentSeam
from noise_model.surface.ray_casting import trace

Kept = TypeVar("Kept")


class PixelRays(NamedTuple):
    """The rays of some pixels of each of some frames, one frame after another.

    `pose` (n,) says from which frame's pose a ray starts, `ends` (f,) where each frame's pixels end.
    `xy` (n, 2) and `cos4` (n,) are those of `camera.Rays`.
    """

    pose: Int64
    ends: Int64
    xy: Float32
    cos4: Float32

    @classmethod
    def of(cls, rays: Rays, pixels: Sequence[Integers]) -> PixelRays:
        """Return the rays of pixels of each frame, (n,) by their places in the flattened image."""
        counts, every = [len(some) for some in pixels], np.concatenate(pixels)
        xy, cos4 = rays.xy.reshape(-1, 2)[every], rays.cos4.reshape(-1)[every]
        return cls(np.repeat(np.arange(len(pixels)), counts), np.cumsum(counts), xy, cos4)


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
    def along(
        cls,
        setup: Setup,
        T_base_tool: Sequence[Float64],
        seams: Sequence[BentSeam],
        rays: PixelRays,
        stretch: Int64 | None = None,
    ) -> Sight:
        """Look from some poses at the seam of each.

        `stretch` (n,) says which stretch each pixel shows, where that is not to be found anew: light is not
        quite steady from one to the next, and a small step's difference would show it.
        """
        if stretch is None:
            middles = [BentSeam((seam.middle,), seam.ground) for seam in seams]
            scenes = make_scenes(setup, T_base_tool, middles)
            points, _, _ = cls(setup, scenes, rays.pose, rays.xy, rays.cos4).surface
            x_mm = np.split(points[:, 0], rays.ends[:-1])
            stretch = np.concatenate([seam.stretch_at(x) for seam, x in zip(seams, x_mm, strict=True)])
        firsts = np.cumsum([0, *(len(seam.lines) for seam in seams[:-1])])
        which = firsts[rays.pose] + stretch
        return cls(setup, make_scenes(setup, T_base_tool, seams), which, rays.xy, rays.cos4)

    def with_metal(self, setup: Setup) -> Sight:
        """Return the same in a setup that differs by its metal alone.

        Both share what they keep, where rays end and the arc as the surface sees it: it depends on no metal.
        """
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
        trace(
            xy=self.xy,
            which=self.which,
            T_joint_camera=poses,
            vertices=shape.vertices,
            corrugation=shape.corrugation,
            points=points,
            normals=normals,
            faces=faces,
        )
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
            points=points,
            normals=normals,
            which=self.which,
            cameras=np.ascontiguousarray(self.scenes.T_joint_camera[:, :3, 3]),
            sheets=sheets_of(laser, self.scenes.T_joint_tool),
            material=lobe_numbers(self.setup.material),
            reach=laser.reach_sigmas,
            vertices=shape.vertices,
            corrugation=shape.corrugation,
            light=light,
        )
        return np.asarray(light * (self.cos4 * unit_e), dtype=np.float32)

    @property
    def sheet(self) -> SheetReach:
        """Where the pixels meet the laser sheet, at their centres."""
        return self._keep("sheet", self._sheet)

    def _sheet(self) -> SheetReach:
        n, shape, laser = len(self.cos4), self.scenes.shape, self.setup.laser
        seen = SheetReach(np.empty(n, dtype=np.bool_), np.empty(n, dtype=np.bool_))
        sheets, reach = sheets_of(laser, self.scenes.T_joint_tool), laser.reach_sigmas
        see_sheet(self.surface[0], self.which, sheets, reach, shape.vertices, shape.corrugation, seen)
        return seen

    def _keep(self, name: str, compute: Callable[[], Kept]) -> Kept:
        return kept_in(self._kept, name, compute)


def kept_in(store: dict[str, object], name: str, compute: Callable[[], Kept]) -> Kept:
    """Return what a store holds under a name, or compute and keep it."""
    if name not in store:
        store[name] = compute()
    return cast(Kept, store[name])


@kernel
def _write_ranges(points: Float64, which: Int64, x_ranges: Float64) -> None:
    """Write between which x (m, 2) the points (n, 3) of each scene lie; those of a miss are NaN."""
    for i in range(points.shape[0]):
        s, x = which[i], points[i, 0]
        if x < x_ranges[s, 0]:
            x_ranges[s, 0] = x
        if x > x_ranges[s, 1]:
            x_ranges[s, 1] = x
