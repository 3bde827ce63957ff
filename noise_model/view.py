"""View of the camera from one pose: pixels, rays, and lazily the surface that they meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from noise_model.arc.scene import Scene, Scenes, make_scene
from noise_model.compiled.arrays import Float32, Float64, Int32, Int64, Integers
from noise_model.instrument.camera import Rays
from noise_model.setup import Setup
from noise_model.sight import Kept, Sight, kept_in
from noise_model.surface.joint import NOMINAL_SEAM, SeamLine


@dataclass(frozen=True, eq=False)
class View:
    """The pixels (...,) that are predicted, from one pose: a whole image (H, W) or some of it, (n,).

    `setup` is what is really there, its effects on geometry and surface applied; `scene` that of the pose;
    `uv_px` (..., 2) the pixels' places as (u, v), `xy` (..., 2) their normalised rays, `cos4` (...,) the
    lens' fall-off. `is_frame` says that the pixels are a whole frame in image order; of others the first
    `n_even` are an even sample of it, all of them if it is None. `coarse` lets what is expensive and smooth,
    light that bounces, be followed at fewer points, and the laser's not at all. `part_seed` says which part
    lies there, by the pattern on its metal; None for another one in each frame that is drawn. `inner` are
    those of some pixels that have their neighbours in view, and where these are, see `camera.blur_inner`.
    """

    setup: Setup
    scene: Scene
    uv_px: Float32
    xy: Float32
    cos4: Float32
    is_frame: bool
    n_even: int | None = None
    coarse: bool = False
    part_seed: int | None = None
    inner: tuple[Int64, Int64] | None = None
    _kept: dict[str, object] = field(default_factory=dict, repr=False)

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
        """Look from a pose; `pixels` (n,) are indices into the flattened image, all of it without them.

        `rays` spares tracing the camera's rays again; `ground` is that of `make_scene`, `coarse` as above.
        """
        rays = Rays.of(setup.camera) if rays is None else rays
        height, width = rays.cos4.shape
        scene = make_scene(setup, T_base_tool, seam, ground)
        if pixels is None:
            v, u = np.mgrid[:height, :width].astype(np.float32)
            return cls(setup, scene, np.stack([u, v], axis=-1), rays.xy, rays.cos4, True, coarse=coarse)
        v_of, u_of = np.divmod(pixels, width)
        uv = np.column_stack([u_of, v_of]).astype(np.float32)
        xy, cos4 = rays.xy.reshape(-1, 2)[pixels], rays.cos4.reshape(-1)[pixels]
        return cls(setup, scene, uv, xy, cos4, False, coarse=coarse)

    @property
    def shape(self) -> tuple[int, ...]:
        """The pixels' shape."""
        return self.cos4.shape

    @property
    def theta(self) -> Float64:
        """The field angle (...,), rad: between a pixel's ray and the optical axis."""
        return self.keep(
            "theta", lambda: np.arctan(np.hypot(self.xy[..., 0], self.xy[..., 1]).astype(np.float64))
        )

    @property
    def directions(self) -> Float64:
        """The pixels' viewing directions (..., 3), unit vectors of the joint frame."""
        return self.keep("directions", self._directions)

    def _directions(self) -> Float64:
        rays = np.concatenate([self.xy, np.ones((*self.shape, 1), dtype=np.float32)], axis=-1)
        rays_joint = rays.astype(np.float64) @ self.scene.T_joint_camera[:3, :3].T
        return np.asarray(rays_joint / np.linalg.norm(rays_joint, axis=-1, keepdims=True))

    @property
    def surface(self) -> tuple[Float64, Float64, Int32]:
        """Intersections of the rays, joint frame: points (..., 3), mm, unit normals (..., 3), faces (...,).

        NaN, NaN and `ray_casting.MISS` for a ray that looks past the workpiece.
        """
        points, normals, faces = self.sight.surface
        return points.reshape(*self.shape, 3), normals.reshape(*self.shape, 3), faces.reshape(self.shape)

    @property
    def sight(self) -> Sight:
        """The pixels (n,), flattened, as what follows rays takes them."""
        return self.keep("sight", self._sight)

    def _sight(self) -> Sight:
        which = np.zeros(self.cos4.size, dtype=np.int64)
        xy = np.ascontiguousarray(self.xy.reshape(-1, 2))
        return Sight(self.setup, Scenes.of([self.scene]), which, xy, self.cos4.reshape(-1))

    @property
    def distance_mm(self) -> Float64:
        """Distance of the surface from the camera along each ray (...,); NaN past the workpiece."""
        return self.keep("distance_mm", self._distance_mm)

    def _distance_mm(self) -> Float64:
        return np.asarray(np.linalg.norm(self.surface[0] - self.scene.T_joint_camera[:3, 3], axis=-1))

    def mean(self, image: Float32) -> np.float32:
        """Return the frame's mean of an image (...,) of the view's pixels."""
        return np.float32(image.reshape(-1)[: self.n_even].mean(dtype=np.float64))

    def keep(self, name: str, compute: Callable[[], Kept]) -> Kept:
        """Return what was computed under a name before, or compute and keep it.

        It goes with the pose: `dataclasses.replace` of a setup that renders equally hands it on. What is kept
        may depend on that setup's geometry, source, surface and filter, not on effects on the image; for
        `Sight.with_metal`, what rendering keeps depends on no metal.
        """
        return kept_in(self._kept, name, compute)
