"""Constants of a setup for the tracker: scan lines, rays, the charge of each code.

A scan line crosses the stripe. If the stripe runs along the image's rows the scan lines are its columns,
otherwise its rows; positions along a scan line are pixels. All kernels see the image scan line by scan line.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from noise_model.arc.baked import NOTHING_BAKED, BakedLight
from noise_model.arc.bicubic import node_rules
from noise_model.arc.map import arc_kernel, baked_light
from noise_model.arc.quadrature import gauss_nodes
from noise_model.arc.scene import scene_along
from noise_model.arc.table import TO_POWERS
from noise_model.calibration_errors import CalibrationCovariance, tool_displacement
from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.effects import acting, apply_setup_effects
from noise_model.instrument.camera import Intrinsics, Rays
from noise_model.instrument.laser import Sheet, plane_met, sheet_in_tool
from noise_model.instrument.sensor import SensorResponse, dark_part_e2, linearise, saturation_dn, variance_e2
from noise_model.setup import Setup, require_setup
from noise_model.stripe import stripe_runs_along_rows
from noise_model.surface.brdf import LobeNumbers, lobe_numbers
from noise_model.surface.joint import NOMINAL_SEAM
from noise_model.transforms import invert, transform
from tracker.seam.calibration_field import CalibrationField
from tracker.seam.locate import SeamSource

MIN_LIGHT = 0.05
"""The light, over full well, from which a bent response's noise counts."""

MIN_PIXELS_PER_MM = 3.2
"""A stripe is sought as if it moved by so much at least: a camera's pose, a plate's tilt and the stripe's
scatter do not get less, in pixels, where height moves the stripe little."""

SEARCH_REACH_MM = 5.0
"""Half-width of the first search about the seam's nominal place."""

TRACK_REACH_MM = 1.0
"""Half-width of the search about a known seam's expected place, beyond three sigmas of that place."""

MIN_ACROSS = 0.2
"""The least cosine between the sheet's normal and the tool's x axis for a place in the sheet to follow x."""

MAP_TOLERANCE, MAP_FLOOR_E = 0.01, 20.0
"""Largest error of the map where it is read off its tables: relative, and in electrons."""

FIELD_NODES = 11
"""Columns and rows of the image at which the calibration's errors are propagated to the sheet."""

SAMPLE, LEVEL_SAMPLE = 600, 150
"""About so many pixels are an even sample of an image, however many it has; so many tell the arc's level.

The level is known to the map's own 5 % over the root of their number, 0.5 %: less than its map is off.
"""


class StripeSource(NamedTuple):
    """Setup of the stripe for the kernels: laser, metal and camera.

    `sheet` is the laser's in the tool frame, `T_tool_camera` (4, 4) mm; scan lines run as `SensorGeometry`'s.
    """

    sheet: Sheet
    material: LobeNumbers
    T_tool_camera: Float64
    lens: Intrinsics
    psf_sigma_px: float
    along_rows: bool


class ArcSource(NamedTuple):
    """Setup of the arc's map for the kernels.

    `radiance_e` is the arc's at the stated current and exposure. `rules`, `to_powers`, `node_at` and
    `node_rules` are those of `arc.quadrature`, `arc.table` and `arc.fill`; `baked` is the light about the
    nominal pose.
    """

    radius_mm: float
    radiance_e: float
    rules: Float64
    to_powers: Float64
    node_at: Int64
    node_rules: Float64
    baked: BakedLight


class ImageSource(NamedTuple):
    """Setup of the frames for the kernels; see `SensorGeometry`.

    `level_scan` and `level_position` (n,) are `level_sample`. `black_sigma_e` is the black level's
    1 sigma.
    """

    n_scan: int
    n_pos: int
    along_rows: bool
    xy: Float32
    cos4: Float32
    charge_e: Float32
    saturation_dn: int
    dark_variance_e2: float
    is_linear: bool
    response: SensorResponse
    black_sigma_e: float
    level_scan: Int64
    level_position: Int64


@dataclass(frozen=True)
class SensorGeometry:
    """A setup's tables, by scan line.

    `setup` is what is really there: effects that change it are applied (`effects.apply_setup_effects`).
    `xy` (n_scan n_pos, 2) float32 the normalised rays, `cos4` (n_scan n_pos,) float32; `charge_e` (codes,)
    float32 the electrons of each DN; `saturation_dn` the lowest code that is censored; `dark_variance_e2` the
    variance of an unlit pixel. The setup's exposure is that of `camera.exposure_s`.
    """

    setup: Setup
    along_rows: bool
    n_scan: int
    n_pos: int
    xy: Float32
    cos4: Float32
    charge_e: Float32
    saturation_dn: int
    dark_variance_e2: float

    @classmethod
    def of(cls, setup: Setup) -> SensorGeometry:
        """Derive the tables; raises ValueError if the stripe is not in view at tool height."""
        setup = apply_setup_effects(require_setup(setup))
        along_rows = stripe_runs_along_rows(setup)
        # A profile has no pixels.
        seen = setup.camera if setup.profiler is None else replace(setup.camera, height=1)
        rays = Rays.of(seen)
        xy, cos4 = (rays.xy.swapaxes(0, 1), rays.cos4.T) if along_rows else (rays.xy, rays.cos4)
        charge = linearise(np.arange(setup.sensor.max_dn + 1), setup.sensor).astype(np.float32)
        return cls(
            setup=setup,
            along_rows=along_rows,
            n_scan=xy.shape[0],
            n_pos=xy.shape[1] if setup.profiler is None else setup.camera.height,
            xy=np.ascontiguousarray(xy).reshape(-1, 2),
            cos4=np.ascontiguousarray(cos4).reshape(-1),
            charge_e=charge,
            saturation_dn=saturation_dn(setup.sensor),
            dark_variance_e2=float(variance_e2(0.0, setup.sensor)),
        )

    def make_ready(self) -> None:
        """Derive all tables that are otherwise derived when a step first needs them."""
        for name, table in vars(type(self)).items():
            if isinstance(table, cached_property):
                getattr(self, name)

    @cached_property
    def calibration_digest(self) -> str:
        """Digest of camera, laser and their errors, twelve hexadecimal digits."""
        setup = self.setup
        stated = f"{setup.camera!r}{setup.laser!r}{setup.calibration_errors!r}"
        return hashlib.sha256(stated.encode()).hexdigest()[:12]

    @cached_property
    def has_light_effects(self) -> bool:
        """True if effects of the setup act on the arc's light on its way to the pixels."""
        return any(effect.light or effect.image for effect, _ in acting(self.setup))

    @cached_property
    def seam_source(self) -> SeamSource:
        """Setup of the seam for the kernels."""
        return SeamSource.of(self.setup)

    @cached_property
    def calibration_field(self) -> CalibrationField:
        """Displacement of the seam by errors of the calibration, up to twice the working distance."""
        camera = self.setup.camera
        u, v = (np.linspace(0.0, size - 1.0, FIELD_NODES) for size in (camera.width, camera.height))
        points_px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        points_tool, moves_mm = calibration_moves(self.setup, self.setup.calibration_errors, points_px)
        depth_mm = float(transform(invert(camera.T_tool_camera), self.setup.laser.point_mm)[2])
        return CalibrationField.fit(camera.T_tool_camera, points_tool, moves_mm, 2.0 * depth_mm)

    @cached_property
    def arc_source(self) -> ArcSource:
        """The setup's arc and what its map is made with."""
        arc = self.setup.arc
        return ArcSource(
            arc.radius_mm, float(arc.radiance_e), gauss_nodes(), TO_POWERS, *node_rules(), self.baked_light
        )

    @cached_property
    def image_source(self) -> ImageSource:
        """The setup's frames."""
        sensor = self.setup.sensor
        level_scan, level_position = self.level_sample
        return ImageSource(
            n_scan=self.n_scan,
            n_pos=self.n_pos,
            along_rows=self.along_rows,
            xy=self.xy,
            cos4=self.cos4,
            charge_e=self.charge_e,
            saturation_dn=self.saturation_dn,
            dark_variance_e2=self.dark_variance_e2,
            is_linear=sensor.is_linear,
            response=SensorResponse.of(sensor),
            black_sigma_e=self.setup.tolerance.black_level_dn * sensor.gain_e_per_dn,
            level_scan=level_scan,
            level_position=level_position,
        )

    @cached_property
    def frame_form(self) -> tuple[tuple[int, int], np.dtype[Any]]:
        """A frame's shape and type."""
        return self.setup.frame_shape, np.dtype(self.setup.sensor.dtype)

    @cached_property
    def baked_light(self) -> BakedLight:
        """The arc's light about the pose whose tool stands on the nominal seam, see `arc.baked`."""
        source = self.seam_source.scene
        scene = scene_along(source, source.segments.frames[0], NOMINAL_SEAM)
        if scene.below_surface or self.setup.profiler is not None:
            return NOTHING_BAKED
        return baked_light(arc_kernel(self.setup, scene), self.xy, self.n_scan, MAP_TOLERANCE, MAP_FLOOR_E)

    @cached_property
    def stripe_source(self) -> StripeSource:
        """The setup's laser, metal and camera."""
        camera = self.setup.camera
        return StripeSource(
            sheet_in_tool(self.setup.laser),
            lobe_numbers(self.setup.material),
            np.require(camera.T_tool_camera, np.float64, ("C", "W")),
            camera.intrinsics,
            camera.psf_sigma_px,
            self.along_rows,
        )

    @cached_property
    def pixels_per_mm(self) -> float:
        """Displacement of the stripe, px, per mm of height or lateral position, whichever is larger.

        The displaced point stays in the laser's sheet, however that is tilted.
        """
        camera = self.setup.camera
        nx, ny, nz, _ = self.setup.laser.plane
        # A sheet that does not cut the tool's x axis runs along it: there a move up or aside stays in it.
        lean = (-nz / nx, -ny / nx) if abs(nx) > MIN_ACROSS else (0.0, 0.0)
        moved = np.array([[0.0, 0.0, 0.0], [lean[0], 0.0, 1.0], [lean[1], 1.0, 0.0]])
        points_camera = transform(invert(camera.T_tool_camera), self.setup.laser.point_mm + moved)
        scan_points = self.scan_points(camera.project(points_camera))
        return float(np.abs(scan_points[1:, 1] - scan_points[0, 1]).max())

    def reach_px(self, reach_mm: float) -> float:
        """Return the half-width of the search, px, for a stripe that may be off by a reach, mm."""
        return reach_mm * max(self.pixels_per_mm, MIN_PIXELS_PER_MM)

    @cached_property
    def even_sample(self) -> tuple[Int64, Int64]:
        """Scan lines and positions (n,) of an even sample of the image's pixels."""
        return self.lattice(max(1, round(math.sqrt(self.n_scan * self.n_pos / SAMPLE))))

    @cached_property
    def level_sample(self) -> tuple[Int64, Int64]:
        """Scan lines and positions (n,) of the pixels that determine the arc's level."""
        return self.lattice(max(1, round(math.sqrt(self.n_scan * self.n_pos / LEVEL_SAMPLE))))

    def lattice(self, spacing_px: int) -> tuple[Int64, Int64]:
        """Return scan lines and positions (n,) of a grid of pixels, `spacing_px` apart."""
        scan = np.arange(spacing_px // 2, self.n_scan, spacing_px)
        position = np.arange(spacing_px // 2, self.n_pos, spacing_px)
        s, r = np.meshgrid(scan, position, indexing="ij")
        return s.ravel(), r.ravel()

    def image_points(self, scan: Float64, position: Float64) -> Float64:
        """Return image points (n, 2) as (u, v) of scan lines and positions (n,)."""
        return np.column_stack([scan, position] if self.along_rows else [position, scan])

    def scan_points(self, points_px: Float64) -> Float64:
        """Return (n, 2) as (scan, position) of image points (n, 2) as (u, v)."""
        return points_px if self.along_rows else points_px[:, ::-1]


def dark_variance_at(image: ImageSource, charge_e: Float32 | Float64) -> float:
    """Return the part of a pixel's variance, e-^2, that is not its light's, in light like charges (n,), e-.

    A linear sensor's is the same everywhere. Of a bent response the step of a code goes with the light, and
    may be large in the dark: taken is that at the median of the charges, but not below what a stripe that can
    be seen has, MIN_LIGHT of full well.
    """
    if image.is_linear or charge_e.size == 0:
        return image.dark_variance_e2
    typical_e = max(float(np.median(charge_e)), MIN_LIGHT * image.response.full_well_e)
    return float(dark_part_e2(typical_e, image.response))


def meet_laser_plane(setup: Setup, origins_tool: Float64, rays_tool: Float64) -> Float64:
    """Return the places of rays (n, 3) from origins (3,) or (n, 3), mm, in the laser sheet, tool frame.

    A ray that runs away from the sheet gives NaN.
    """
    points, rays = np.empty((len(rays_tool), 3)), np.ascontiguousarray(rays_tool)
    origins = np.require(np.broadcast_to(origins_tool, points.shape), np.float64, ("C", "W"))
    _meet(sheet_in_tool(setup.laser), origins, rays, points)
    return points


@kernel
def _meet(sheet: Sheet, origins: Float64, rays: Float64, points: Float64) -> None:
    """Write where rays (n, 3) from their origins (n, 3) meet the sheet, NaN where they run away from it."""
    for i in range(rays.shape[0]):
        o, r = origins[i], rays[i]
        nx, ny, nz, d = plane_met(sheet, o, r)
        t = -(o[0] * nx + o[1] * ny + o[2] * nz + d) / (r[0] * nx + r[1] * ny + r[2] * nz)
        for k in range(3):
            points[i, k] = o[k] + t * r[k] if t > 0.0 else math.nan


def to_laser_plane(setup: Setup, image_points_px: Float64) -> tuple[Float64, Float64]:
    """Return where image points (n, 2) meet the laser sheet, (n, 3) mm, tool frame, and their rays (n, 3).

    A ray that runs away from the sheet gives NaN.
    """
    camera = setup.camera
    xy = camera.normalised(image_points_px)
    rays_tool = np.column_stack([xy, np.ones(len(xy))]) @ camera.T_tool_camera[:3, :3].T
    return meet_laser_plane(setup, camera.T_tool_camera[:3, 3], rays_tool), rays_tool


def calibration_moves(
    setup: Setup, covariance: CalibrationCovariance, points_px: Float64
) -> tuple[Float64, Float64]:
    """Return places on the sheet of image points (n, 2), and their moves by independent errors of 1 sigma.

    Places (n, 3) and moves (n, m, 3) are in the tool frame, mm.
    """
    here = to_laser_plane(setup, points_px)[0]
    moves_mm = np.empty((len(here), len(covariance.modes), 3))
    for k, sizes in enumerate(np.eye(len(covariance.modes))):
        errors = covariance.errors(sizes)
        there = to_laser_plane(setup.with_errors(errors), points_px)[0]
        moves_mm[:, k] = there + tool_displacement(errors) - here
    return here, moves_mm
