"""Model of a goniometer's readings: grey levels of a patch, lit by a small source, at stated angles.

    G = black + (saturation - black) E^gamma                       (Eq. 20)
    E = s f_r(theta_i, theta_r, phi_r) cos(theta_i) I / a^2        (Eq. 17, 18)

E is the image's irradiance, 1 where the sensor saturates; I the source's intensity and a its distance; s
holds what does not change while the goniometer turns: aperture, exposure, the camera's field angle. The
camera's distance and theta_r do not occur: a patch larger than a pixel's footprint keeps its radiance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Float64
from noise_model.surface.brdf import Material, reflectance

NORMAL = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class GreyResponse:
    """Response of the sensor from light to grey levels, DN: Eq. 20."""

    gamma: float = 1.0
    black_dn: float = 0.0
    saturation_dn: float = 255.0

    def __post_init__(self) -> None:
        if not 0 < self.gamma < np.inf:
            raise ValueError(f"gamma = {self.gamma}: must be > 0")
        if not (np.isfinite(self.black_dn) and self.black_dn < self.saturation_dn < np.inf):
            raise ValueError(f"saturation = {self.saturation_dn}: must be above black = {self.black_dn}")

    def gray_level(self, light: Float64) -> Float64:
        """Return the grey level, DN, of light E >= 0; not cut at saturation."""
        return np.asarray(self.black_dn + (self.saturation_dn - self.black_dn) * light**self.gamma)

    def light(self, gray_level: Float64) -> Float64:
        """Return the light E of grey levels, DN: gamma undone, odd about black."""
        level = (gray_level - self.black_dn) / (self.saturation_dn - self.black_dn)
        return np.asarray(np.sign(level) * np.abs(level) ** (1.0 / self.gamma))


@dataclass(frozen=True, eq=False)
class Settings:
    """Positions of source and camera, (m,) each: angles to the patch's normal and the incident plane.

    phi_r = 0 is the plane of incidence on the mirror's side, where a negative theta_r is the source's own
    side. `source` is I / a^2 in any unit, one for all settings that are compared.
    """

    theta_i_deg: Float64
    theta_r_deg: Float64
    phi_r_deg: Float64
    source: Float64

    def __post_init__(self) -> None:
        if not ((self.theta_i_deg >= 0) & (self.theta_i_deg < 90)).all():
            raise ValueError("theta_i_deg: an angle of incidence lies from 0 to below 90 deg")
        if not (np.abs(self.theta_r_deg) < 90).all():
            raise ValueError("theta_r_deg: a viewing angle lies between -90 and 90 deg")
        if not np.isfinite(self.phi_r_deg).all():
            raise ValueError("phi_r_deg: an azimuth is finite")
        if not ((self.source > 0) & np.isfinite(self.source)).all():
            raise ValueError("the source's intensity / distance^2 must be > 0")

    def __len__(self) -> int:
        return len(self.theta_i_deg)

    @property
    def omega_i(self) -> Float64:
        """Unit vectors (m, 3) towards the source, the patch's normal along z."""
        return _direction(self.theta_i_deg, np.full(len(self), 180.0))

    @property
    def omega_r(self) -> Float64:
        """Unit vectors (m, 3) towards the camera."""
        return _direction(self.theta_r_deg, self.phi_r_deg)

    @property
    def alpha(self) -> Float64:
        """The half vector's angle (m,) to the normal, rad: where in the lobe a setting lies."""
        half = self.omega_i + self.omega_r
        return np.asarray(np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2]))

    @property
    def irradiance(self) -> Float64:
        """The patch's irradiance (m,): cos(theta_i) I / a^2 (Eq. 16)."""
        return np.asarray(np.cos(np.radians(self.theta_i_deg)) * self.source)

    def light(self, material: Material) -> Float64:
        """Return E / s (m,): what a patch of this material sends to the camera."""
        f_r = reflectance(
            self.omega_i, self.omega_r, NORMAL, material.kappa_diff, material.kappa_spec, material.c2
        )
        return f_r * self.irradiance

    @staticmethod
    def in_plane(theta_i_deg: npt.ArrayLike, theta_r_deg: npt.ArrayLike) -> Settings:
        """Return all pairs of angles (i,) and (r,) in the plane of incidence, the source as it stands."""
        theta_i, theta_r = np.meshgrid(
            np.asarray(theta_i_deg, float), np.asarray(theta_r_deg, float), indexing="ij"
        )
        zeros = np.zeros(theta_i.size)
        return Settings(theta_i.ravel(), theta_r.ravel(), zeros, zeros + 1.0)

    def subset(self, which: npt.NDArray[np.intp]) -> Settings:
        """Return some of the settings, by their numbers (k,)."""
        return Settings(
            self.theta_i_deg[which], self.theta_r_deg[which], self.phi_r_deg[which], self.source[which]
        )


@dataclass(frozen=True, eq=False)
class Readings:
    """Grey levels averaged at each of m settings.

    `gray_level` (m,) the mean, DN, of `repeats` (m,) readings; `variance` (m,) that of a single one, DN^2,
    NaN where it was read once. `group` (N,) says to which setting each of the readings went, `is_whole` that
    all of them are whole numbers.
    """

    settings: Settings
    gray_level: Float64
    repeats: Float64
    variance: Float64
    group: npt.NDArray[np.intp]
    is_whole: bool

    @property
    def standard_error(self) -> Float64:
        """The mean's standard error (m,), DN, by the repeats alone; NaN where it was read once."""
        return np.sqrt(self.variance / self.repeats)


def average(settings: Settings, gray_level: Float64) -> Readings:
    """Average the readings (N,) that were taken at equal settings, in the order of first appearance.

    The paper averages 20 grey levels taken 0.2 s apart at each setting: the arc, or a lamp, flickers.
    Raises ValueError if a grey level is not finite or the numbers of settings and grey levels differ.
    """
    if len(settings) != len(gray_level) or not np.isfinite(gray_level).all():
        raise ValueError("each setting needs one finite grey level")
    keys = np.column_stack([settings.theta_i_deg, settings.theta_r_deg, settings.phi_r_deg, settings.source])
    _, first, sorted_group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    by_appearance = np.argsort(first)
    group = np.argsort(by_appearance)[sorted_group]
    repeats = np.bincount(group).astype(np.float64)
    mean = np.bincount(group, gray_level) / repeats
    squares = np.bincount(group, (gray_level - mean[group]) ** 2)
    variance = np.divide(squares, repeats - 1, out=np.full(len(mean), np.nan), where=repeats > 1)
    is_whole = bool((gray_level == np.rint(gray_level)).all())
    return Readings(settings.subset(first[by_appearance]), mean, repeats, variance, group, is_whole)


def _direction(theta_deg: Float64, azimuth_deg: Float64) -> Float64:
    theta, azimuth = np.radians(theta_deg), np.radians(azimuth_deg)
    return np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], axis=-1
    )
