"""The arc's light as a function of arc, metal, camera, seam and levels: residuals and derivatives.

In pixel i of frame f

    charge = exp(ln_radiance + ln_level_f) (1 + sum_k field_k phi_k(u, v)) map_i + black,

map the arc's light by arc, metal, camera and seam.

Radiance and kappas only occur as a product, so the kappas' sum is held as stated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.arc.lattice import PixelSample, choose_pixels, expected_light
from calibration.hand_eye_arc import CAMERA, FIELD_SIGMA, FIELDS
from noise_model.calibration_errors import POSE
from noise_model.compiled.arrays import Float64
from noise_model.effects import apply_setup_effects
from noise_model.fit import Fit, Parameter
from noise_model.instrument.camera import Rays
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import moved
from tracker.geometry import SensorGeometry
from tracker.state import Frame

RADIUS, X, Y, Z, RADIANCE, RATIO, C2 = (
    "ln_radius",
    "center_x",
    "center_y",
    "center_z",
    "ln_radiance",
    "ln_kappa_ratio",
    "ln_c2",
)
ARC = (RADIUS, X, Y, Z, RADIANCE, RATIO, C2)
"""Calibrated parameters: radius, centre in the tool, mm, radiance, kappa_spec / kappa_diff and c2."""

BROAD: Mapping[str, float] = {RADIUS: 0.4, X: 3.0, Y: 3.0, Z: 2.0, RADIANCE: 3.0, RATIO: 1.0, C2: 0.7}
"""1 sigma of what an arc and a metal may be, about the stated values: wide, so that the frames decide."""

STATED: Mapping[str, float] = {RADIUS: 0.1, X: 0.1, Y: 0.1, Z: 0.1, RADIANCE: 0.1, RATIO: 0.1, C2: 0.1}
"""1 sigma of a stated value that the frames do not determine, relative or mm."""

STEPS: Mapping[str, float] = {RADIUS: 0.03, X: 0.05, Y: 0.05, Z: 0.05, RATIO: 0.03, C2: 0.03}

CAMERA_STEPS = (0.03, 0.03, 0.03, 0.04, 0.04, 0.04)
"""Derivatives' steps of the camera's turn, deg, and move, mm."""

SEAM = ("seam_y", "seam_z", "seam_slope_y", "seam_slope_z")
SEAM_STEPS = (0.05, 0.05, 0.002, 0.002)

RENDERED = (RADIUS, X, Y, Z, RATIO, C2, *CAMERA, *SEAM)
"""The parameters whose derivatives are rendered."""

PART_SIGMAS = (2.0, 2.0, 0.02, 0.02)
"""1 sigma of a part's position, mm sideways and in height, and along its seam, without a stripe."""


@dataclass(frozen=True, eq=False)
class PartPlacement:
    """Placement of the part by stripes, jointly with the camera.

    `values` (10,) are `CAMERA` and `SEAM` about the stated camera and the nominal seam at `station_mm`, deg
    and mm; `covariance` (10, 10).
    """

    station_mm: float
    values: Float64
    covariance: Float64

    @classmethod
    def without_stripes(cls, setup: Setup, station_mm: float) -> PartPlacement:
        """Return the prior without stripes: the camera's tolerance, and the usual scatter of parts."""
        camera = np.maximum(setup.calibration_errors.sigmas(POSE), 1e-4)
        sigmas = np.array([*camera, *PART_SIGMAS])
        return cls(station_mm, np.zeros(10), np.diag(sigmas**2))

    @classmethod
    def from_stripes(
        cls, setup: Setup, station_mm: float, values: Mapping[str, float], fit: Fit
    ) -> PartPlacement:
        """Return the part's placement by stripes, for each camera within its tolerance.

        Their estimate of the camera itself is not used: it would rest on the assumption of a straight seam.
        With B = C_pc C_cc^-1, the part lies at p - B c + B camera, and its own covariance is C_pp - B C_cp.
        """
        names = [parameter.name for parameter in fit.parameters]
        errors = [names.index(name) for name in setup.calibration_errors.mode_names]
        seam = [names.index(name) for name in SEAM]
        C, x = fit.covariance, np.array([values[name] for name in names])
        by_error = setup.calibration_errors.modes_of(POSE).T
        C_camera_seam = by_error @ C[np.ix_(errors, seam)]
        # What of the camera is exact tells nothing of the seam.
        B = (np.linalg.pinv(by_error @ C[np.ix_(errors, errors)] @ by_error.T) @ C_camera_seam).T
        # The seam need not go on straight from the stripes to the torch.
        own = C[np.ix_(seam, seam)] - B @ C_camera_seam + np.diag(np.square((0.1, 0.1, 0.03, 0.01)))
        prior = cls.without_stripes(setup, station_mm).covariance[:6, :6]
        covariance = np.block([[prior, prior @ B.T], [B @ prior, B @ prior @ B.T + own]])
        return cls(station_mm, np.append(np.zeros(6), x[seam] - B @ by_error @ x[errors]), covariance)


@dataclass(frozen=True, eq=False)
class ArcProblem:
    """The pixels of all frames, and the parameters that explain them.

    `pixel_sigma` is the relative 1 sigma of the metal's texture and the map, `flicker` that of a frame's
    level; `held` are those of `ARC` that the frames do not determine: their stated values count.
    """

    setup: Setup
    part: PartPlacement
    frames: tuple[PixelSample, ...]
    rays: Rays
    pixel_sigma: float
    flicker: float
    held: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        setup: Setup,
        frames: Sequence[tuple[Frame, Float64]],
        part: PartPlacement,
        pixel_sigma: float,
        flicker: float,
    ) -> ArcProblem:
        """Choose the pixels of frames with their T_base_tool (4, 4)."""
        true = apply_setup_effects(setup)
        rays, geometry = Rays.of(true.camera), SensorGeometry.of(setup)
        problem = cls(setup, part, (), rays, pixel_sigma, flicker)
        seam = problem.seam_at(dict(zip((*CAMERA, *SEAM), part.values, strict=True)))
        chosen = (choose_pixels(geometry, rays, frame, T_base_tool, seam) for frame, T_base_tool in frames)
        return replace(problem, frames=tuple(lattice for lattice in chosen if len(lattice.charge_e)))

    @cached_property
    def levels(self) -> tuple[str, ...]:
        """The names of the frames' levels."""
        return tuple(f"ln_level_{lattice.frame.index}" for lattice in self.frames)

    @property
    def parameters(self) -> list[Parameter]:
        """All parameters with their priors; those of camera and seam come as residuals of `PartPlacement`."""
        black_e = max(self.setup.tolerance.black_level_dn * self.setup.sensor.gain_e_per_dn, 1e-3)
        sigmas = {name: (STATED if name in self.held else BROAD)[name] for name in ARC}
        wide = 30.0 * np.sqrt(np.diag(self.part.covariance))
        return [
            *(Parameter(name, "", 0.0, sigma) for name, sigma in sigmas.items()),
            *(Parameter(name, "", 0.0, float(s)) for name, s in zip((*CAMERA, *SEAM), wide, strict=True)),
            Parameter("black", "e-", 0.0, black_e),
            *(Parameter(name, "", 0.0, FIELD_SIGMA) for name in FIELDS),
            *(Parameter(name, "", 0.0, self.flicker) for name in self.levels),
        ]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters' names."""
        return tuple(parameter.name for parameter in self.parameters)

    def named(self, x: Float64) -> dict[str, float]:
        """Return parameters (p,) by name."""
        return dict(zip(self.names, x.tolist(), strict=True))

    def setup_at(self, x: Mapping[str, float]) -> Setup:
        """Return the setup with arc, metal and camera as parameters say."""
        arc, metal = self.setup.arc, self.setup.material
        x_mm, y_mm, z_mm = arc.center_in_tool_mm
        arc = replace(
            arc,
            radius_mm=arc.radius_mm * math.exp(x[RADIUS]),
            center_in_tool_mm=(x_mm + x[X], y_mm + x[Y], z_mm + x[Z]),
        )
        total = metal.kappa_diff + metal.kappa_spec
        ratio = metal.kappa_spec / metal.kappa_diff * math.exp(x[RATIO])
        metal = replace(
            metal,
            kappa_diff=total / (1.0 + ratio),
            kappa_spec=total * ratio / (1.0 + ratio),
            c2=metal.c2 * math.exp(x[C2]),
        )
        change = [x[name] for name in CAMERA]
        camera = self.setup.camera
        camera = replace(camera, T_tool_camera=moved(camera.T_tool_camera, change[:3], change[3:]))
        return replace(self.setup, arc=arc, material=metal, camera=camera)

    def seam_at(self, x: Mapping[str, float]) -> SeamLine:
        """Return the seam's line."""
        y, z, slope_y, slope_z = (x[name] for name in SEAM)
        return SeamLine(self.part.station_mm, y, z, slope_y, slope_z)

    def light(self, x: Mapping[str, float]) -> Float64:
        """Return the arc's light (n,), e-, of all pixels at the stated radiance."""
        true, seam = apply_setup_effects(self.setup_at(x)), self.seam_at(x)
        parts = [expected_light(true, self.rays, lattice, seam) for lattice in self.frames]
        return np.nan_to_num(np.concatenate(parts))

    @cached_property
    def charge_e(self) -> Float64:
        """The charge (n,) of all pixels, e-."""
        return np.concatenate([lattice.charge_e for lattice in self.frames])

    @cached_property
    def frame_of(self) -> Float64:
        """To which frame each pixel belongs (n, f), 1 or 0."""
        counts = [len(lattice.charge_e) for lattice in self.frames]
        return np.repeat(np.eye(len(counts)), counts, axis=0)

    @cached_property
    def phi(self) -> Float64:
        """The fields (n, 5) over the image, from its middle in half widths."""
        camera = self.setup.camera
        uv = np.concatenate([lattice.uv_px for lattice in self.frames])
        u, v = ((uv - 0.5 * np.array([camera.width, camera.height])) / (0.5 * camera.width)).T
        return np.column_stack([u, v, u * u, u * v, v * v])

    def sigma_e(self, x: Float64, light_e: Float64) -> Float64:
        """Return 1 sigma (n,) of the pixels' charge, e-."""
        noise_e = np.concatenate([lattice.noise_e for lattice in self.frames])
        return np.asarray(np.hypot(noise_e, self.pixel_sigma * self._gain(x) * light_e))

    def _gain(self, x: Float64) -> Float64:
        """Return the factor (n,) of each pixel's light."""
        level = math.exp(x[ARC.index(RADIANCE)]) * np.exp(self.frame_of @ x[-len(self.frames) :])
        fields = 1.0 + self.phi @ x[-len(self.frames) - len(FIELDS) : -len(self.frames)]
        return np.asarray(level * fields)

    def mean_e(self, x: Float64, light_e: Float64) -> Float64:
        """Return the mean charge (n,), e-, at parameters (p,) whose light is known."""
        return np.asarray(self._gain(x) * light_e + x[self.names.index("black")])

    def of_part(self, x: Float64) -> Float64:
        """Return the whitened residuals (10,) of what the stripes say."""
        first = len(ARC)
        return np.asarray(self._whiten @ (x[first : first + 10] - self.part.values))

    @cached_property
    def _whiten(self) -> Float64:
        return np.linalg.inv(np.linalg.cholesky(self.part.covariance))

    def residuals(self, x: Float64, sigma_e: Float64) -> Float64:
        """Return the whitened residuals (n + 10,) of pixels and stripes; sigmas (n,) are held."""
        off_e = self.mean_e(x, self.light(self.named(x))) - self.charge_e
        return np.concatenate([off_e / sigma_e, self.of_part(x)])

    def derivatives_e(self, x: Float64) -> Float64:
        """Return the derivatives (n, p) of the pixels' mean charge, e-."""
        names, here = self.names, self.named(x)
        light_e, gain = self.light(here), self._gain(x)
        J_e = np.zeros((len(light_e), len(names)))
        steps = {**STEPS, **dict(zip((*CAMERA, *SEAM), (*CAMERA_STEPS, *SEAM_STEPS), strict=True))}
        for name in RENDERED:
            moved_e = self.light({**here, name: here[name] + steps[name]})
            J_e[:, names.index(name)] = gain * (moved_e - light_e) / steps[name]
        J_e[:, names.index(RADIANCE)] = gain * light_e
        J_e[:, names.index("black")] = 1.0
        level = gain / (1.0 + self.phi @ x[-len(self.frames) - len(FIELDS) : -len(self.frames)])
        J_e[:, -len(self.frames) - len(FIELDS) : -len(self.frames)] = (level * light_e)[:, None] * self.phi
        J_e[:, -len(self.frames) :] = (gain * light_e)[:, None] * self.frame_of
        return J_e

    def derivatives(self, x: Float64, sigma_e: Float64) -> Float64:
        """Return the derivatives (n + 10, p) of the residuals; sigmas (n,) are held."""
        of_part = np.zeros((10, len(self.names)))
        of_part[:, len(ARC) : len(ARC) + 10] = self._whiten
        return np.vstack([self.derivatives_e(x) / sigma_e[:, None], of_part])
