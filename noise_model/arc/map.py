"""The arc map: per pixel the mean of the arc's light for the robot's present pose (Eq. 8-14, 18).

The arc is a Lambertian emitter, so L cos(phi) dA / r^2 is L d(omega) and a pixel receives

    radiance_e cos^4 * integral over the visible directions of f_r(omega, omega_r) cos(theta_i) d(omega).

`quadrature` holds the integral of one surface point, `ray` a ray's, `table` the faces' light as
piecewise polynomials and `fill` the filling of bands and frames from them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noise_model.arc.baked import NOTHING_BAKED, BakedLight, bake, place_baked, table_from
from noise_model.arc.bicubic import node_rules
from noise_model.arc.fill import CELL as CELL
from noise_model.arc.fill import MIXED, fill_band, fill_pixels
from noise_model.arc.quadrature import DiscRule, gauss_nodes
from noise_model.arc.ray import ArcKernel as ArcKernel
from noise_model.arc.ray import follow, light_at
from noise_model.arc.scene import Scene, Scenes
from noise_model.arc.scratch import ArcScratch
from noise_model.arc.table import TO_POWERS, FaceTable, new_table
from noise_model.compiled.arrays import Bool, Float32, Float64, Int32, Int64
from noise_model.compiled.kernel import kernel
from noise_model.setup import Setup
from noise_model.surface.brdf import LobeNumbers, lobe_numbers
from noise_model.surface.faces import height_under
from noise_model.surface.ray_casting import MISS
from noise_model.surface.visibility import Bend, horizons_of_scenes, is_curved_lap

NODES_P, NODES_Q = 8, 4
"""Nodes across the arc's disc and up a chord."""

TOLERANCE, FLOOR_E = 0.005, 20.0
"""Largest error of a filled map: relative, or in electrons where that is more."""

MAX_MARGIN_MM = 4.0
"""No face is continued further beyond its edges."""


def _on_half_sphere() -> Float64:
    """Return directions (n, 3) all over the upper half-sphere."""
    tau, delta = np.meshgrid(np.linspace(0.0, 0.5 * np.pi, 10), np.linspace(0.0, 2.0 * np.pi, 24))
    sin = np.sin(tau)
    return np.stack([sin * np.cos(delta), sin * np.sin(delta), np.cos(tau)], axis=-1).reshape(-1, 3)


ON_HALF_SPHERE = _on_half_sphere()
"""Directions in which metal that cuts into the arc is looked for."""

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
    """Return True if a sphere's point in any of some directions (n, 3) lies below a section's surface.

    `center` is the sphere's, mm, joint frame.
    """
    for i in range(outward.shape[0]):
        x, y = center[0] + radius * outward[i, 0], center[1] + radius * outward[i, 1]
        if center[2] + radius * outward[i, 2] < height_under(x, y, vertices, corrugation) - CUT_MM:
            return True
    return False


@kernel
def metal_cuts(
    center: tuple[float, float, float], bend: Bend, radius: float, vertices: Float64, corrugation: Float64
) -> bool:
    """Return True if the sheets of a lap whose edge is not straight may cut into the luminous half-sphere."""
    if not is_curved_lap(vertices, corrugation, bend):
        return False
    under = (center[0], center[1] - bend[1], center[2])
    return any_below(under, radius, ON_HALF_SPHERE, vertices, corrugation)


class ArcKernels(NamedTuple):
    """The numbers of several scenes (s,) as the kernels take them; see `ArcKernel`.

    `horizons` (s, 2, n, 2) have the length of the longest one.
    """

    rotation: Float64
    eye: Float64
    center: Float64
    bend: Float64
    radius: float
    radiance_e: float
    vertices: Float64
    corrugation: Float64
    horizon_start: Float64
    horizons: Float64
    metal_cuts: Bool
    material: LobeNumbers
    rule: DiscRule


@kernel(allocates=True)
def _of_scene(k: ArcKernels, s: int) -> ArcKernel:
    """Return the kernel of one scene, which knows of no `reach`."""
    eye, center, bend = k.eye[s], k.center[s], k.bend[s]
    return ArcKernel(
        rotation=k.rotation[s],
        eye=(eye[0], eye[1], eye[2]),
        center=(center[0], center[1], center[2]),
        bend=(bend[0], bend[1]),
        radius=k.radius,
        radiance_e=k.radiance_e,
        vertices=k.vertices,
        corrugation=k.corrugation,
        horizon_start=k.horizon_start[s],
        horizons=k.horizons[s],
        metal_cuts=k.metal_cuts[s],
        reach=(math.nan, math.nan, math.nan, math.nan),
        material=k.material,
        rule=k.rule,
    )


def arc_kernels(setup: Setup, scenes: Scenes, x_ranges_mm: Float64) -> ArcKernels:
    """Gather several scenes for the kernels, the arc's output the nominal one.

    `x_ranges_mm` (n, 2) says between which stations points of each scene are asked for. Raises ValueError for
    a pose whose camera stands below the surface.
    """
    if scenes.below_surface.any():
        raise ValueError("the camera stands below the surface at this pose")
    radius = setup.arc.radius_mm
    starts, horizons = horizons_of_scenes(scenes.shape, x_ranges_mm, scenes.center_mm, radius, False)
    cuts = [
        metal_cuts(tuple(center), tuple(bend), radius, *scenes.shape)
        for center, bend in zip(scenes.center_mm.tolist(), scenes.bend.tolist(), strict=True)
    ]
    return ArcKernels(
        rotation=np.ascontiguousarray(scenes.T_joint_camera[:, :3, :3]),
        eye=np.ascontiguousarray(scenes.T_joint_camera[:, :3, 3]),
        center=scenes.center_mm,
        bend=scenes.bend,
        radius=radius,
        radiance_e=setup.arc.radiance_e,
        vertices=scenes.shape.vertices,
        corrugation=scenes.shape.corrugation,
        horizon_start=starts,
        horizons=horizons,
        metal_cuts=np.array(cuts),
        material=lobe_numbers(setup.material),
        rule=DiscRule(gauss_nodes(), NODES_P, NODES_Q),
    )


def arc_kernel(
    setup: Setup, scene: Scene, level: float = 1.0, nodes: tuple[int, int] = (NODES_P, NODES_Q)
) -> ArcKernel:
    """Gather a scene for the kernels; `level` is the arc's output over the nominal one.

    Raises ValueError for a pose whose camera stands below the surface.
    """
    if scene.below_surface:
        raise ValueError("the camera stands below the surface at this pose")
    made: ArcKernel = kernel_of(
        scene,
        horizon_of(scene, setup.arc.radius_mm),
        setup.arc.radius_mm,
        setup.arc.radiance_e * level,
        lobe_numbers(setup.material),
        DiscRule(gauss_nodes(), *nodes),
    )
    return made


class Horizon(NamedTuple):
    """A scene's horizon table (2, n, 2) and the station of its first row, mm; see `horizons_of_scenes`."""

    start: float
    table: Float64


LEVEL = Horizon(0.0, np.empty((2, 0, 2)))
"""The horizon of a scene without a corrugation."""


def horizon_of(scene: Scene, radius: float) -> Horizon:
    """Return a scene's horizon, also for points beyond what the camera sees: faces are continued."""
    if scene.shape.corrugation[0] == 0.0:
        return LEVEL
    centers = np.array([scene.center_mm], dtype=np.float64)
    starts, tables = horizons_of_scenes(scene.shape, scene.footprint_mm[:1], centers, radius, True)
    return Horizon(float(starts[0]), tables[0])


@kernel(allocates=True)
def kernel_of(
    scene: Scene, horizon: Horizon, radius: float, radiance_e: float, material: LobeNumbers, rule: DiscRule
) -> ArcKernel:
    """Return `arc_kernel`'s numbers of a scene whose camera stands above the surface."""
    T, foot, center = scene.T_joint_camera, scene.footprint_mm, scene.center_mm
    vertices, corrugation = scene.shape
    middle = (center[0], center[1], center[2])
    return ArcKernel(
        rotation=T[:3, :3].copy(),
        eye=(T[0, 3], T[1, 3], T[2, 3]),
        center=middle,
        bend=scene.bend,
        radius=radius,
        radiance_e=radiance_e,
        vertices=vertices,
        corrugation=corrugation,
        horizon_start=horizon.start,
        horizons=horizon.table,
        metal_cuts=metal_cuts(middle, scene.bend, radius, vertices, corrugation),
        reach=(foot[0, 0], foot[0, 1], foot[1, 0], foot[1, 1]),
        material=material,
        rule=rule,
    )


@kernel(allocates=True)
def _arc_pixels(
    k: ArcKernel, xy: Float32, cos4: Float32, pixels: Int64, mean_e: Float32, faces: Int32, work: ArcScratch
) -> None:
    """Fill `mean_e` and `faces` (n,) of some pixels (n,), see `arc_at`."""
    for i in range(pixels.shape[0]):
        P, face = follow(k, xy[pixels[i], 0], xy[pixels[i], 1])
        faces[i] = face
        mean_e[i] = math.nan if face == MISS else cos4[pixels[i]] * light_at(k, P, face, work)


@kernel(allocates=True)
def _arc_in_scenes(
    k: ArcKernels,
    which: Int64,
    points: Float64,
    faces: Int32,
    cos4: Float32,
    mean_e: Float32,
    work: ArcScratch,
) -> None:
    """Fill `mean_e` (n,), see `arc_in_scenes`."""
    scene, current = _of_scene(k, 0), 0
    for i in range(which.shape[0]):
        if faces[i] == MISS:
            mean_e[i] = 0.0
            continue
        # Most points belong to the scene of the one before.
        if which[i] != current:
            current = which[i]
            scene = _of_scene(k, current)
        # A sum with a literal is what kernels take faces as: 64 bits.
        P, face = (points[i, 0], points[i, 1], points[i, 2]), 0 + int(faces[i])
        mean_e[i] = cos4[i] * light_at(scene, P, face, work)


def arc_in_scenes(kernels: ArcKernels, which: Int64, points: Float64, faces: Int32, cos4: Float32) -> Float32:
    """Return the arc's mean (n,), e- for `camera.exposure_s`, at points of several scenes.

    `which` (n,) says to which scene each point (n, 3), mm, joint frame, and its face belong, `cos4` (n,) is
    the lens' fall-off. Before the point-spread function; 0 where a ray looks past the workpiece.
    """
    mean_e = np.empty(len(which), dtype=np.float32)
    _arc_in_scenes(kernels, which, points, faces, cos4, mean_e, ArcScratch.of(kernels.vertices))
    return mean_e


def arc_at(kernel: ArcKernel, xy: Float32, cos4: Float32, pixels: Int64) -> tuple[Float32, Int32]:
    """Return the arc's mean, e- for `camera.exposure_s`, and the face seen at some pixels (n,).

    `xy` (H W, 2) and `cos4` (H W,) are the flattened `camera.Rays`. Before the point-spread function; NaN
    where a pixel looks past the workpiece.
    """
    mean_e = np.empty(len(pixels), dtype=np.float32)
    faces = np.empty(len(pixels), dtype=np.int32)
    _arc_pixels(kernel, xy, cos4, pixels, mean_e, faces, ArcScratch.of(kernel.vertices))
    return mean_e, faces


@kernel
def _margin_mm(k: ArcKernel, xy: Float32, n_scan: int) -> float:
    """Return the reach of a cell of `MIXED` pixels on a level face, at most MAX_MARGIN_MM.

    By the camera's rays `xy` (n_scan n_pos, 2): so far faces go on beyond their edges.
    """
    # An image of one pixel has no step.
    first = max(0, min(xy.shape[0] // n_scan // 2, xy.shape[0] - 2))
    last = min(first + 1, xy.shape[0] - 1)
    pixel = math.hypot(xy[last, 0] - xy[first, 0], xy[last, 1] - xy[first, 1])
    distance_mm = k.eye[2] / max(0.1, abs(k.rotation[2, 2]))
    return float(min(MIXED * pixel * distance_mm, MAX_MARGIN_MM))


@kernel(allocates=True)
def table_of(
    k: ArcKernel, xy: Float32, n_scan: int, rel: float, floor_e: float, to_powers: Float64, baked: BakedLight
) -> FaceTable:
    """Return a scene's table, from what is `baked` where that holds, else an empty one.

    See `table.new_table`; the camera's rays are `xy` (n_scan n_pos, 2).
    """
    place = place_baked(k, baked)
    if place >= 0:
        return table_from(k, baked, place, rel, floor_e, to_powers)
    return new_table(k, _margin_mm(k, xy, n_scan), rel, floor_e, to_powers)


def baked_light(k: ArcKernel, xy: Float32, n_scan: int, tolerance: float, floor_e: float) -> BakedLight:
    """Return an `ArcMap`'s baked light about a nominal pose, to the map's own tolerance."""
    return bake(k, _margin_mm(k, xy, n_scan), tolerance, floor_e)


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
        baked: BakedLight = NOTHING_BAKED,
    ) -> ArcMap:
        """Begin the map of a scene.

        `tolerance`, relative, and `floor_e`, whichever is more, bound what the faces' tables and the cells
        read off them may each be off, halves of it where all is smooth; docs/explanation/arc_map.md says what
        is reached. `baked` is light for the same tolerance, of the same setup.
        """
        table = table_of(kernel, xy, n_scan, tolerance, floor_e, TO_POWERS, baked)
        return cls(kernel, xy, cos4, table)

    def at(self, pixels: Int64) -> Float32:
        """Return the light (n,) at some pixels (n,)."""
        mean_e = np.empty(len(pixels), dtype=np.float32)
        work = ArcScratch.of(self.kernel.vertices)
        fill_pixels(self.kernel, self.table, self.xy, self.cos4, pixels, mean_e, work)
        return mean_e

    def fill(self, lows: Int64, band_e: Float32) -> None:
        """Fill a band (n_scan, depth); CELL lines each begin at a place of `lows` (ceil(n_scan / CELL),)."""
        fill_band(
            k=self.kernel,
            table=self.table,
            xy=self.xy,
            cos4=self.cos4,
            rules=node_rules(),
            lows=lows,
            band_e=band_e,
            work=ArcScratch.of(self.kernel.vertices),
        )


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
