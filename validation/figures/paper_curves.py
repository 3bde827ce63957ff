"""The numbers of the paper's Figures 6 to 12, with the geometry that they need and the print leaves open.

Everywhere the patch stands level with the arc's centre C, at a distance a from it, its normal lies in the
plane of C and `up`, and theta_i is measured to C (Figure 8: to the middle of what the patch sees of the arc).
docs/explanation/paper.md says what the curves show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Float64
from noise_model.surface.brdf import (
    MILD_STEEL,
    ZN_COATED,
    Material,
    geometrical_attenuation,
    reflectance,
)
from validation.figures.hemisphere import (
    Hemisphere,
    irradiance_extended,
    irradiance_point,
    point_source,
    reflected_radiance_extended,
    reflected_radiance_point,
)
from validation.figures.mirror import SUS304, Mirror

UP = np.array([0.0, 0.0, 1.0])
RADIUS_MM = 2.0
"""The arc's radius R in all figures: that of a GTAW arc of some 100 A; the print's own is not known."""

ARC = Hemisphere(np.zeros(3), RADIUS_MM, UP)
DISTANCE_MM = 30.0
"""The distance a of Figures 9 to 12."""

NEAREST_MM = 1.25 * RADIUS_MM
FARTHEST_MM = 30.0 * RADIUS_MM

MIDDLE_MM = np.array([0.0, 0.0, 4.0 * RADIUS_MM / (3.0 * np.pi)])
"""The centroid of the half disc that a patch level with C sees of the arc."""

NODES = 16
"""Quadrature nodes: the curves are smooth over the arc's 2 R / a = 0.13 rad. Nearer by, twice as many."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches (N, 3), mm, their normals, the directions to what theta_i is measured to, and the views."""

    points_mm: Float64
    normals: Float64
    omega_i: Float64
    omega_r: Float64


def patches(
    a_mm: npt.ArrayLike,
    theta_i_deg: npt.ArrayLike,
    theta_r_deg: npt.ArrayLike,
    phi_r_deg: npt.ArrayLike = 0.0,
    *,
    towards_up: bool = True,
    aim_mm: Float64 = ARC.center_mm,
) -> Patches:
    """Return patches level with C that see `aim_mm` (3,) under theta_i and are seen from theta_r, phi_r.

    The arguments broadcast to (N,). The normal is tilted in the vertical plane, towards `up` or away from it.
    phi_r is counted from the side opposite the arc: at 0 and theta_r = theta_i the aim is mirrored.
    """
    a, theta_i, theta_r, phi_r = np.broadcast_arrays(
        *np.atleast_1d(a_mm, np.radians(theta_i_deg), np.radians(theta_r_deg), np.radians(phi_r_deg))
    )
    points_mm = a[:, np.newaxis] * np.array([1.0, 0.0, 0.0])
    omega_i = _unit(aim_mm - points_mm)
    across = np.cross(np.array([0.0, 1.0, 0.0]), omega_i) * (1.0 if towards_up else -1.0)
    normals = np.cos(theta_i)[:, np.newaxis] * omega_i + np.sin(theta_i)[:, np.newaxis] * across
    forward = np.cos(theta_i)[:, np.newaxis] * across - np.sin(theta_i)[:, np.newaxis] * omega_i
    aside = np.cross(normals, forward)
    level = np.cos(phi_r)[:, np.newaxis] * forward + np.sin(phi_r)[:, np.newaxis] * aside
    omega_r = np.cos(theta_r)[:, np.newaxis] * normals + np.sin(theta_r)[:, np.newaxis] * level
    return Patches(points_mm, normals, omega_i, omega_r)


@dataclass(frozen=True, eq=False)
class OverDistance:
    """Figures 6 and 7: the radiance (N,) over a (N,), mm, of the extended arc and of the point source.

    Both are divided by the extended arc's at the nearest a.
    """

    number: int
    material: Material
    theta_i_deg: float
    theta_r_deg: float
    a_mm: Float64
    extended: Float64
    point: Float64

    def columns(self) -> dict[str, Float64]:
        """Return the curves by name."""
        return {"a_mm": self.a_mm, "extended": self.extended, "point": self.point}


@dataclass(frozen=True, eq=False)
class MirrorOverDistance:
    """Figure 8: a mirror over a (N,), mm, under one convention and under the other.

    `extended` and `point` are the light that falls on the mirror and that it passes on, whatever direction it
    takes: irradiances, divided by the extended arc's at the nearest a. `image` is the radiance of the arc's
    image in the mirror over rho L.
    """

    number: int
    mirror: Mirror
    theta_i_deg: float
    theta_r_deg: float
    a_mm: Float64
    extended: Float64
    point: Float64
    image: Float64

    def columns(self) -> dict[str, Float64]:
        """Return the curves by name."""
        return {"a_mm": self.a_mm, "extended": self.extended, "point": self.point, "image": self.image}


@dataclass(frozen=True, eq=False)
class OverAzimuth:
    """Figures 9 and 10: the radiance (N,) over phi_r (N,), deg, each curve over its own at phi_r = 0."""

    number: int
    material: Material
    theta_i_deg: float
    theta_r_deg: float
    phi_r_deg: Float64
    extended: Float64
    point: Float64

    def columns(self) -> dict[str, Float64]:
        """Return the curves by name."""
        return {"phi_r_deg": self.phi_r_deg, "extended": self.extended, "point": self.point}


@dataclass(frozen=True, eq=False)
class OverViewingAngle:
    """A material's curves (N,) in Figures 11 and 12 over theta_r, each divided by its own peak.

    `f_r` alone, for light from C; `lobe_flat`, f_r without the lobe's 1/cos(theta_r); `extended`, the
    radiance under the arc.
    """

    material: Material
    f_r: Float64
    lobe_flat: Float64
    extended: Float64


@dataclass(frozen=True, eq=False)
class OffSpecular:
    """Figures 11 and 12: both materials over theta_r (N,), deg."""

    number: int
    theta_i_deg: float
    theta_r_deg: Float64
    of_materials: tuple[OverViewingAngle, ...]

    def columns(self) -> dict[str, Float64]:
        """Return the curves by name."""
        table = {"theta_r_deg": self.theta_r_deg}
        for curves in self.of_materials:
            for name in ("f_r", "lobe_flat", "extended"):
                table[f"{curves.material.name}_{name}"] = getattr(curves, name)
        return table


PaperFigure = OverDistance | MirrorOverDistance | OverAzimuth | OffSpecular


@dataclass(frozen=True)
class Peaks:
    """Where a material's curves peak under theta_i, all in deg, and G at the peak of f_r.

    `extended` and `extended_away` are under the arc, the normal tilted towards `up` and away from it.
    """

    material: Material
    theta_i_deg: float
    f_r_deg: float
    lobe_flat_deg: float
    extended_deg: float
    extended_away_deg: float
    attenuation: float


def over_distance(number: int, material: Material, theta_i_deg: float, theta_r_deg: float) -> OverDistance:
    """Return Figure 6 or 7."""
    a_mm = np.geomspace(NEAREST_MM, FARTHEST_MM, 120)
    spots = patches(a_mm, theta_i_deg, theta_r_deg)
    extended = reflected_radiance_extended(
        spots.points_mm, spots.normals, spots.omega_r, ARC, material, nodes=2 * NODES
    )
    point = _point(spots, material)
    return OverDistance(
        number, material, theta_i_deg, theta_r_deg, a_mm, extended / extended[0], point / extended[0]
    )


def mirror_over_distance(number: int, theta_deg: float) -> MirrorOverDistance:
    """Return Figure 8: SUS304 under theta_i = theta_r, measured to the middle of what it sees of the arc."""
    a_mm = np.geomspace(NEAREST_MM, FARTHEST_MM, 120)
    spots = patches(a_mm, theta_deg, theta_deg, aim_mm=MIDDLE_MM)
    extended = irradiance_extended(spots.points_mm, spots.normals, ARC, nodes=2 * NODES)
    point = irradiance_point(spots.points_mm, spots.normals, point_source(spots.points_mm, ARC))
    image = (
        reflected_radiance_extended(spots.points_mm, spots.normals, spots.omega_r, ARC, SUS304) / SUS304.rho
    )
    return MirrorOverDistance(
        number=number,
        mirror=SUS304,
        theta_i_deg=theta_deg,
        theta_r_deg=theta_deg,
        a_mm=a_mm,
        extended=extended / extended[0],
        point=point / extended[0],
        image=image,
    )


def over_azimuth(number: int, material: Material, theta_i_deg: float, theta_r_deg: float) -> OverAzimuth:
    """Return Figure 9 or 10."""
    phi_r_deg = np.linspace(-90.0, 90.0, 181)
    spots = patches(DISTANCE_MM, theta_i_deg, theta_r_deg, phi_r_deg)
    extended, point = _extended(spots, material), _point(spots, material)
    in_plane = len(phi_r_deg) // 2
    return OverAzimuth(
        number,
        material,
        theta_i_deg,
        theta_r_deg,
        phi_r_deg,
        extended / extended[in_plane],
        point / point[in_plane],
    )


def off_specular(number: int, theta_i_deg: float) -> OffSpecular:
    """Return Figure 11 or 12."""
    theta_r_deg = np.linspace(0.0, 88.0, 353)
    spots = patches(DISTANCE_MM, theta_i_deg, theta_r_deg)
    return OffSpecular(
        number,
        theta_i_deg,
        theta_r_deg,
        tuple(
            OverViewingAngle(
                material,
                *(_to_peak(curve(spots, material)) for curve in (_f_r, _lobe_flat, _extended)),
            )
            for material in (MILD_STEEL, ZN_COATED)
        ),
    )


FIGURES: dict[int, Callable[[], PaperFigure]] = {
    6: lambda: over_distance(6, MILD_STEEL, 70.0, 20.0),
    7: lambda: over_distance(7, ZN_COATED, 30.0, 60.0),
    8: lambda: mirror_over_distance(8, 50.0),
    9: lambda: over_azimuth(9, MILD_STEEL, 55.0, 45.0),
    10: lambda: over_azimuth(10, ZN_COATED, 55.0, 45.0),
    11: lambda: off_specular(11, 60.0),
    12: lambda: off_specular(12, 30.0),
}
"""What computes each figure, by its number in the paper."""


def point_error(curves: OverDistance | MirrorOverDistance) -> Float64:
    """Return how far the point source is off (N,): point / extended - 1."""
    return np.asarray(curves.point / curves.extended - 1.0)


def agrees_from_mm(curves: OverDistance | MirrorOverDistance, tolerance: float) -> float:
    """Return the distance a, mm, from which on point source and extended arc agree within a tolerance."""
    error = np.abs(point_error(curves))
    last = int(np.flatnonzero(error > tolerance)[-1])
    step = np.log(error[last] / tolerance) / np.log(error[last] / error[last + 1])
    return float(curves.a_mm[last] * (curves.a_mm[last + 1] / curves.a_mm[last]) ** step)


def off_specular_peaks(material: Material, theta_i_deg: float) -> Peaks:
    """Return where a material's curves of Figures 11 and 12 peak, to 0.01 deg."""

    def peak_of(curve: Callable[[Patches, Material], Float64], towards_up: bool = True) -> float:
        def over(theta_r_deg: Float64) -> Float64:
            spots = patches(DISTANCE_MM, theta_i_deg, theta_r_deg, towards_up=towards_up)
            return curve(spots, material)

        return _peak_deg(over)

    f_r_deg = peak_of(_f_r)
    there = patches(DISTANCE_MM, theta_i_deg, f_r_deg)
    return Peaks(
        material,
        theta_i_deg,
        f_r_deg,
        peak_of(_lobe_flat),
        peak_of(_extended),
        peak_of(_extended, towards_up=False),
        float(geometrical_attenuation(there.omega_i, there.omega_r, there.normals)[0]),
    )


def lobe_over_diffuse(material: Material, theta_deg: float) -> float:
    """Return what the lobe reflects over what the diffuse part does, in the mirror direction at theta."""
    spots = patches(DISTANCE_MM, theta_deg, theta_deg)
    return float(_f_r(spots, material)[0] / material.kappa_diff - 1.0)


def _f_r(spots: Patches, material: Material) -> Float64:
    return reflectance(
        spots.omega_i, spots.omega_r, spots.normals, material.kappa_diff, material.kappa_spec, material.c2
    )


def _lobe_flat(spots: Patches, material: Material) -> Float64:
    cos_r = np.sum(spots.omega_r * spots.normals, axis=-1)
    return np.asarray(material.kappa_diff + cos_r * (_f_r(spots, material) - material.kappa_diff))


def _extended(spots: Patches, material: Material) -> Float64:
    return reflected_radiance_extended(
        spots.points_mm, spots.normals, spots.omega_r, ARC, material, nodes=NODES
    )


def _point(spots: Patches, material: Material) -> Float64:
    source = point_source(spots.points_mm, ARC)
    return reflected_radiance_point(spots.points_mm, spots.normals, spots.omega_r, source, material)


def _to_peak(values: Float64) -> Float64:
    return np.asarray(values / values.max())


def _peak_deg(over: Callable[[Float64], Float64]) -> float:
    """Return where a curve over theta_r, deg, is highest: on a coarse grid, then on finer ones about it."""
    peak, half = 44.5, 44.0
    for _ in range(4):
        theta_r_deg = np.linspace(max(peak - half, 0.0), min(peak + half, 89.0), 61)
        peak = float(theta_r_deg[over(theta_r_deg).argmax()])
        half = 2.0 * (theta_r_deg[1] - theta_r_deg[0])
    return peak


def _unit(vectors: Float64) -> Float64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
