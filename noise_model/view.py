"""Pixels that look at one or several scenes: the surface that their rays meet, and the light from there.

A bent seam shows a frame's pixels several scenes, and the frames of a recording show more. All of them are
followed in one compiled call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar, cast

import numpy as np

from noise_model.arc.map import ArcKernels, arc_in_scenes, arc_kernels
from noise_model.arc.scene import Scene, Scenes, make_scene, make_scenes
from noise_model.compiled.arrays import Bool, Float32, Float64, Int32, Int64, Integers
from noise_model.instrument.camera import Rays
from noise_model.instrument.laser import sheets_of
from noise_model.setup import Setup
from noise_model.stripe import SheetReach, light_stripe, see_sheet
from noise_model.surface.brdf import lobe_numbers
from noise_model.surface.joint import NOMINAL_SEAM, BentSeam, SeamLine
from noise_model.surface.ray_casting import trace

Cached = TypeVar("Cached")


@dataclass(frozen=True, eq=False)
class View:
    """Pixels (...,), each of which looks at one of some scenes: a frame (H, W), or some pixels (n,).

    `setup` is the true one, its effects on geometry and surface applied; `which` (...,) is each pixel's
    scene. Of pixels that are no frame the first `n_even` are an even sample of it, all of them if None.
    `coarse` lets what is expensive and smooth, light that bounces, be followed at fewer points, and the
    laser's not at all. `part_seed` chooses the part, by the pattern on its metal; None for another one in
    each frame that is drawn. `inner` are those of some pixels that have their neighbours in view, and where
    these are, see `camera.blur_inner`.
    """

    setup: Setup
    scenes: Scenes
    which: Int64
    rays: Rays
    n_even: int | None = None
    coarse: bool = False
    part_seed: int | None = None
    inner: tuple[Int64, Int64] | None = None
    _cache: dict[str, object] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        setup: Setup,
        T_base_tool: Float64,
        seam: SeamLine = NOMINAL_SEAM,
        rays: Rays | None = None,
        pixels: Integers | None = None,
        ground: SeamLine | None = None,
        coarse: bool = False,
    ) -> View:
        """Return the view from one pose; `pixels` (n,) are places in the flattened image, by default all.

        `rays` spares tracing the camera's rays again; `ground` is that of `make_scene`, `coarse` as above.
        """
        rays = Rays.of(setup.camera) if rays is None else rays
        scene = make_scene(setup, T_base_tool, seam, ground)
        return cls.of_scene(setup, scene, rays if pixels is None else rays.at(pixels), coarse=coarse)

    @classmethod
    def of_scene(
        cls, setup: Setup, scene: Scene, rays: Rays, n_even: int | None = None, coarse: bool = False
    ) -> View:
        """Return the view of one scene along some rays (...,)."""
        which = np.zeros(rays.cos4.shape, dtype=np.int64)
        return cls(setup, Scenes.of([scene]), which, rays, n_even, coarse)

    @classmethod
    def along(
        cls,
        setup: Setup,
        T_base_tool: Sequence[Float64],
        seams: Sequence[BentSeam],
        pose: Int64,
        rays: Rays,
        stretch: Int64 | None = None,
    ) -> View:
        """Return the view from some poses at the seam of each; `pose` (...,) is each ray's, ascending.

        `stretch` (...,) is each pixel's stretch of its seam, where that is not to be found anew: light is not
        quite steady from one to the next, and a small step's difference would show it.
        """
        if stretch is None:
            middles = [BentSeam((seam.middle,), seam.ground) for seam in seams]
            points, _, _ = cls(setup, make_scenes(setup, T_base_tool, middles), pose, rays).surface
            x_mm = np.split(points[..., 0].ravel(), np.searchsorted(pose.ravel(), range(1, len(seams))))
            stretch = np.concatenate([seam.stretch_at(x) for seam, x in zip(seams, x_mm, strict=True)])
        firsts = np.cumsum([0, *(len(seam.lines) for seam in seams[:-1])])
        which = firsts[pose] + stretch.reshape(pose.shape)
        return cls(setup, make_scenes(setup, T_base_tool, seams), which, rays)

    def subset(self, chosen: Bool) -> View:
        """Return some of its pixels (...,), as (n,)."""
        return View(self.setup, self.scenes, self.which[chosen], self.rays.at(chosen.ravel()))

    def around(self, pixels: Int64, uv_px: Float64) -> View:
        """Return the view through places (k, m, 2) as (u, v), in the scenes of some of its pixels (k,)."""
        which = np.broadcast_to(self.which.ravel()[pixels, np.newaxis], uv_px.shape[:2])
        return View(self.setup, self.scenes, which, Rays.through(self.setup.camera, uv_px))

    @property
    def scene(self) -> Scene:
        """The scene of a view from one pose at a straight seam; the first of several."""
        return self.scenes[0]

    @property
    def shape(self) -> tuple[int, ...]:
        """The pixels' shape."""
        return self.which.shape

    @property
    def is_frame(self) -> bool:
        """True if the pixels are a whole frame in image order."""
        return self.which.ndim == 2

    @property
    def theta(self) -> Float64:
        """The field angle (...,), rad: between a pixel's ray and the optical axis."""
        x, y = np.moveaxis(self.rays.xy, -1, 0)
        return self.cached("theta", lambda: np.arctan(np.hypot(x, y).astype(np.float64)))

    @property
    def directions(self) -> Float64:
        """The pixels' viewing directions (..., 3), unit vectors of the joint frame."""
        return self.cached("directions", self._directions)

    def _directions(self) -> Float64:
        rays = np.concatenate([self.rays.xy, np.ones((*self.shape, 1), dtype=np.float32)], axis=-1)
        rays_joint = rays.astype(np.float64) @ self.scene.T_joint_camera[:3, :3].T
        return np.asarray(rays_joint / np.linalg.norm(rays_joint, axis=-1, keepdims=True))

    @property
    def surface(self) -> tuple[Float64, Float64, Int32]:
        """Intersections of the rays, joint frame: points (..., 3), mm, unit normals (..., 3), faces (...,).

        NaN, NaN and `ray_casting.MISS` for a ray that looks past the workpiece.
        """
        points, normals, faces = self._hits
        return points.reshape(*self.shape, 3), normals.reshape(*self.shape, 3), faces.reshape(self.shape)

    @property
    def faces(self) -> Int32:
        """The face that each pixel (...,) shows."""
        return self.surface[2]

    @property
    def _hits(self) -> tuple[Float64, Float64, Int32]:
        """The surface of the flattened pixels, as kernels take it."""
        return self.cached("hits", self._traced)

    def _traced(self) -> tuple[Float64, Float64, Int32]:
        n, shape = self.which.size, self.scenes.shape
        points, normals, faces = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, dtype=np.int32)
        trace(
            xy=self.rays.flat.xy,
            which=self.which.ravel(),
            T_joint_camera=self.scenes.T_joint_camera,
            vertices=shape.vertices,
            corrugation=shape.corrugation,
            points=points,
            normals=normals,
            faces=faces,
        )
        return points, normals, faces

    @property
    def distance_mm(self) -> Float64:
        """Distance of the surface from the camera along each ray (...,); NaN past the workpiece."""
        return self.cached("distance_mm", self._distance_mm)

    def _distance_mm(self) -> Float64:
        return np.asarray(np.linalg.norm(self.surface[0] - self.scene.T_joint_camera[:3, 3], axis=-1))

    def arc_e(self) -> Float32:
        """Return the arc's light (...,), e- for `camera.exposure_s`, at its nominal output.

        It is 0 past the workpiece. Raises ValueError for a pose whose camera stands below the surface.
        """
        kernels = self.cached("arc_kernels", self._arc_kernels)
        kernels = kernels._replace(material=lobe_numbers(self.setup.material))
        points, _, faces = self._hits
        light = arc_in_scenes(kernels, self.which.ravel(), points, faces, self.rays.flat.cos4)
        return light.reshape(self.shape)

    def _arc_kernels(self) -> ArcKernels:
        x_ranges_mm = np.tile([np.inf, -np.inf], (len(self.scenes), 1))
        np.fmin.at(x_ranges_mm[:, 0], self.which.ravel(), self._hits[0][:, 0])
        np.fmax.at(x_ranges_mm[:, 1], self.which.ravel(), self._hits[0][:, 0])
        # Of a scene that nothing shows all that counts is that it asks for little.
        unseen = x_ranges_mm[:, 0] > x_ranges_mm[:, 1]
        x_ranges_mm[unseen] = self.scenes.center_mm[unseen, :1]
        return arc_kernels(self.setup, self.scenes, x_ranges_mm)

    def laser_e(self, unit_e: float) -> Float32:
        """Return the laser stripe (...,), e- for `camera.exposure_s`, before the point-spread function.

        The sheet's irradiance times f_r towards the camera, times `unit_e`: of each pixel that at its centre.
        """
        if self.is_frame:
            # Most of a frame is dark: the pixels that meet the free sheet are known.
            sheet, light = self.sheet, np.zeros(self.which.size)
            lit = np.flatnonzero(sheet.near & ~sheet.shaded)
            light[lit] = self._stripe(self._hits[0][lit], self._hits[1][lit], self.which.ravel()[lit])
        else:
            light = self._stripe(*self._hits[:2], self.which.ravel())
        return np.asarray(light.reshape(self.shape) * (self.rays.cos4 * unit_e), dtype=np.float32)

    def _stripe(self, points: Float64, normals: Float64, which: Int64) -> Float64:
        """Return the sheet's light (n,) at points (n, 3) of the scenes `which` (n,)."""
        shape, laser, light = self.scenes.shape, self.setup.laser, np.empty(len(points))
        light_stripe(
            points=points,
            normals=normals,
            which=which,
            cameras=np.ascontiguousarray(self.scenes.T_joint_camera[:, :3, 3]),
            sheets=sheets_of(laser, self.scenes.T_joint_tool),
            material=lobe_numbers(self.setup.material),
            reach=laser.reach_sigmas,
            vertices=shape.vertices,
            corrugation=shape.corrugation,
            light=light,
        )
        return light

    @property
    def sheet(self) -> SheetReach:
        """The pixels (...,) that meet the laser sheet, at their centres."""
        return self.cached("sheet", self._sheet)

    def _sheet(self) -> SheetReach:
        n, shape, laser = self.which.size, self.scenes.shape, self.setup.laser
        seen = SheetReach(np.empty(n, dtype=np.bool_), np.empty(n, dtype=np.bool_))
        sheets, which = sheets_of(laser, self.scenes.T_joint_tool), self.which.ravel()
        see_sheet(self._hits[0], which, sheets, laser.reach_sigmas, shape.vertices, shape.corrugation, seen)
        return SheetReach(seen.near.reshape(self.shape), seen.shaded.reshape(self.shape))

    def mean(self, image: Float32) -> np.float32:
        """Return the frame's mean of an image (...,) of the view's pixels."""
        return np.float32(image.reshape(-1)[: self.n_even].mean(dtype=np.float64))

    def cached(self, name: str, compute: Callable[[], Cached]) -> Cached:
        """Return a value that is computed once under its name.

        It goes with the rays' ends: `dataclasses.replace` of a setup that renders equally, or by another
        metal, hands it on. So it may depend on that setup's geometry and source, on no effect on the image;
        what rendering itself computes under a name depends on no metal.
        """
        if name not in self._cache:
            self._cache[name] = compute()
        return cast(Cached, self._cache[name])
