"""The arc as a luminous upper half of a hemisphere (Eq. 8-14) and as a point source (Eq. 15-17).

The functions here are the reference: exact limits, float64, no occlusion by the joint. The paper's symbols
are kept: a the distance from the arc's centre to the patch, R the arc's radius, tau and delta the polar angle
and azimuth on the arc, phi the angle at the arc, theta_i at the patch, r the distance between the two.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Bool, Float64
from noise_model.surface.brdf import Material, reflectance
from validation.figures.mirror import Mirror, spike_radiance

TINY = 1e-300
"""Keeps a division by a length of zero finite."""

PIECES = 7
"""Pieces of [0, pi/2] between the eight angles tau of `_tau_edges`."""

NODES_AT_ONCE = 2**18


@dataclass(frozen=True, eq=False)
class Hemisphere:
    """The arc as a luminous body: the upper half of the sphere of `radius_mm` about `center_mm` (3,).

    `up` (3,) is a unit vector; points, normals and directions given with it are in the same frame.
    """

    center_mm: Float64
    radius_mm: float
    up: Float64

    def __post_init__(self) -> None:
        if np.shape(self.center_mm) != (3,) or not np.isfinite(self.center_mm).all():
            raise ValueError("the arc's centre must be three finite numbers, mm")
        if not 0 < self.radius_mm < np.inf:
            raise ValueError(f"the arc's radius R = {self.radius_mm} mm: must be > 0")
        if np.shape(self.up) != (3,) or not abs(float(np.linalg.norm(self.up)) - 1.0) < 1e-6:
            raise ValueError("the arc's up axis must be a unit vector")


@dataclass(frozen=True, eq=False)
class PointSource:
    """A source without extent: where it stands, (3,) or (N, 3) mm, and its radiant intensity, () or (N,).

    The intensity is radiance times mm^2: one per patch, since a hemisphere looks different from each.
    """

    position_mm: Float64
    intensity: Float64


def irradiance_extended(
    points_mm: Float64, normals: Float64, arc: Hemisphere, radiance: float = 1.0, nodes: int = 24
) -> Float64:
    """Return the irradiance E (N,) of patches at points (N, 3), mm, with unit normals (N, 3).

    E = integral of L cos(phi) cos(theta_i) / r^2 dA over the part of the luminous half that the patch sees
    (Eq. 8 with a radiance L; Eq. 9-12). See `reflected_radiance_extended` for what is seen and for `nodes`.
    """
    E = np.zeros(len(points_mm))
    for part in _chunks(len(points_mm), nodes):
        lit = _quadrature(points_mm[part], normals[part], arc, nodes)
        E[part] = np.bincount(lit.patch, lit.weight, minlength=len(points_mm[part]))
    return radiance * E


def reflected_radiance_extended(
    points_mm: Float64,
    normals: Float64,
    omega_r: Float64,
    arc: Hemisphere,
    surface: Material | Mirror,
    radiance: float = 1.0,
    nodes: int = 24,
) -> Float64:
    """Return the radiance (N,) that patches (N, 3), mm, with unit normals (N, 3) send along omega_r (N, 3).

    L_r = integral of L f_r cos(phi) cos(theta_i) / r^2 dA, dA = R^2 sin(tau) d tau d delta, over the part of
    the upper half sphere that faces the patch (cos(phi) > 0) and stands above its horizon (cos(theta_i) > 0),
    with f_r inside the integral (Eq. 8-14, cosines from vectors). Nothing else hides the arc here. tau is
    the angle from `up`, delta the azimuth from the patch's own; the limits of delta are closed forms of tau.
    A mirror shows the arc itself: rho L where it does, 0 beside it. A patch inside the arc's sphere sees none
    of its outer side: 0.

    `nodes` Gauss-Legendre nodes in tau, for each piece between the angles where the limits of delta change
    their form, and as many in delta. The error falls geometrically where f_r is smooth over the arc; a lobe
    much narrower than the arc's apparent size, or a kink of G, asks for more nodes.
    """
    if isinstance(surface, Mirror):
        return _mirrored_arc(points_mm, normals, omega_r, arc, surface, radiance)
    L_r = np.zeros(len(points_mm))
    for part in _chunks(len(points_mm), nodes):
        lit = _quadrature(points_mm[part], normals[part], arc, nodes)
        f_r = reflectance(
            lit.omega_i,
            omega_r[part][lit.patch],
            normals[part][lit.patch],
            surface.kappa_diff,
            surface.kappa_spec,
            surface.c2,
            surface.lobe,
        )
        L_r[part] = np.bincount(lit.patch, f_r * lit.weight, minlength=len(points_mm[part]))
    return radiance * L_r


def is_seen(points_mm: Float64, directions: Float64, arc: Hemisphere) -> Bool:
    """Return whether rays (N,) from points (N, 3), mm, along unit vectors (N, 3) meet the luminous side."""
    from_center = points_mm - arc.center_mm
    along = np.sum(from_center * directions, axis=-1)
    outside = np.sum(from_center**2, axis=-1) - arc.radius_mm**2
    reach = along**2 - outside
    distance = -along - np.sqrt(np.maximum(reach, 0.0))
    height = (from_center + distance[:, np.newaxis] * directions) @ arc.up
    return np.asarray((outside > 0) & (reach > 0) & (along < 0) & (height > 0))


def _mirrored_arc(
    points_mm: Float64, normals: Float64, omega_r: Float64, arc: Hemisphere, mirror: Mirror, radiance: float
) -> Float64:
    def incoming(omega_i: Float64) -> Float64:
        return np.where(is_seen(points_mm, omega_i, arc), radiance, 0.0)

    return spike_radiance(mirror, omega_r, normals, incoming)


def apparent_area(points_mm: Float64, arc: Hemisphere) -> Float64:
    """Return A_eff (N,), mm^2: the luminous half's projected area as points (N, 3), mm, see it from far away.

    A_eff = pi R^2 / 2 (1 + cos(tau_p)), tau_p the angle between `up` and the direction to the point: a half
    disc, plus or minus half of the base's ellipse. pi R^2 / 2 on a plate through the centre.
    """
    direction, _ = _direction_to(points_mm, arc)
    return np.asarray(0.5 * np.pi * arc.radius_mm**2 * (1.0 + direction @ arc.up))


def point_source(points_mm: Float64, arc: Hemisphere, radiance: float = 1.0) -> PointSource:
    """Return the point source that agrees with the hemisphere far away, for each of the points (N, 3), mm.

    Its intensity is I = L A_eff (Eq. 15). It stands at the centroid of the figure that the point sees, which
    is (4 R / 3 pi) (1 - cos(tau_p)) from the centre, across the line of sight towards `up`: were it at the
    centre, a plate through the centre would get no light at all, at any distance.
    """
    direction, cos_tau_p = _direction_to(points_mm, arc)
    across = arc.up - cos_tau_p[:, np.newaxis] * direction
    sin_tau_p = np.linalg.norm(across, axis=-1)
    shift = 4.0 * arc.radius_mm / (3.0 * np.pi) * (1.0 - cos_tau_p) / np.maximum(sin_tau_p, TINY)
    position = arc.center_mm + shift[:, np.newaxis] * across
    return PointSource(position, radiance * apparent_area(points_mm, arc))


def irradiance_point(points_mm: Float64, normals: Float64, source: PointSource) -> Float64:
    """Return the irradiance (N,) of patches (N, 3) under a point source: I cos(theta_i) / r^2 (Eq. 16)."""
    omega_i, r = _unit(source.position_mm - points_mm)
    cos_theta_i = np.sum(omega_i * normals, axis=-1)
    return np.asarray(source.intensity * np.maximum(cos_theta_i, 0.0) / r**2)


def reflected_radiance_point(
    points_mm: Float64, normals: Float64, omega_r: Float64, source: PointSource, material: Material
) -> Float64:
    """Return the radiance (N,) along omega_r (N, 3) under a point source: f_r I cos(theta_i)/r^2 (Eq. 17)."""
    omega_i, _ = _unit(source.position_mm - points_mm)
    f_r = reflectance(
        omega_i, omega_r, normals, material.kappa_diff, material.kappa_spec, material.c2, material.lobe
    )
    return f_r * irradiance_point(points_mm, normals, source)


def point_source_criterion(points_mm: Float64, arc: Hemisphere) -> Float64:
    """Return A_eff / a^2 (N,), the figure that the paper wants << 1 before it takes the arc for a point."""
    a = np.linalg.norm(points_mm - arc.center_mm, axis=-1)
    return np.asarray(apparent_area(points_mm, arc) / a**2)


def point_source_error(
    points_mm: Float64,
    normals: Float64,
    omega_r: Float64,
    arc: Hemisphere,
    material: Material,
    nodes: int = 24,
) -> Float64:
    """Return by how much (N,) the point source is off: L_point / L_extended - 1.

    Patches and directions as in `reflected_radiance_extended`; NaN where the arc sends nothing.
    """
    extended = reflected_radiance_extended(points_mm, normals, omega_r, arc, material, nodes=nodes)
    point = reflected_radiance_point(points_mm, normals, omega_r, point_source(points_mm, arc), material)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(extended > 0, point / extended - 1.0, np.nan)


def point_source_distance(
    direction: Float64,
    normal: Float64,
    omega_r: Float64,
    arc: Hemisphere,
    material: Material,
    tolerance: float,
    nodes: int = 24,
) -> float:
    """Return the distance a, mm, from which on the point source is good to `tolerance` (relative).

    The patch moves away from the centre along the unit vector `direction` (3,), its normal (3,) and its
    viewing direction (3,) unchanged. The largest distance where the error crosses the tolerance is sought
    between 1.05 R and 1000 R on a logarithmic grid of 2 % steps and interpolated; 1.05 R if it never does.

    Raises ValueError for a tolerance <= 0, for a patch that the arc does not light, and for an error that is
    still above the tolerance at 1000 R.
    """
    if not tolerance > 0:
        raise ValueError(f"tolerance = {tolerance}: must be > 0")
    a = arc.radius_mm * np.geomspace(1.05, 1000.0, 350)
    points_mm = arc.center_mm + a[:, np.newaxis] * direction
    normals, directions = np.broadcast_to(normal, points_mm.shape), np.broadcast_to(omega_r, points_mm.shape)
    error = np.abs(point_source_error(points_mm, normals, directions, arc, material, nodes))
    if np.isnan(error[-1]):
        raise ValueError("the arc does not light a patch of this normal and direction")
    if error[-1] > tolerance:
        raise ValueError(f"the point source's error is still {error[-1]:.2g} at 1000 radii")
    too_large = np.flatnonzero(~(error <= tolerance))
    if too_large.size == 0:
        return float(a[0])
    last = too_large[-1]
    if np.isnan(error[last]):
        return float(a[last + 1])
    step = np.log(error[last] / tolerance) / np.log(error[last] / max(error[last + 1], TINY))
    return float(a[last] * (a[last + 1] / a[last]) ** step)


@dataclass(frozen=True, eq=False)
class _Quadrature:
    """Nodes (K,) on the arc: whose patch, the direction (K, 3) to it, its cos(phi) cos(theta_i) / r^2 dA."""

    patch: npt.NDArray[np.intp]
    omega_i: Float64
    weight: Float64


@dataclass(frozen=True, eq=False)
class _Caps:
    """A cap of the unit sphere per patch: the x with axis.x > cosine, axis (N, 3) in `_patch_axes`."""

    axis: Float64
    cosine: Float64

    def turning_tau(self) -> tuple[Float64, Float64]:
        """Return where the cap's rim is lowest and highest in tau (N,): between them it has two azimuths."""
        polar = np.arccos(np.clip(self.axis[:, 2], -1.0, 1.0))
        opening = np.arccos(np.clip(self.cosine, -1.0, 1.0))
        return np.abs(polar - opening), polar + opening

    def azimuths(self, tau: Float64) -> tuple[Float64, Float64]:
        """Return the centre and half width of the cap's interval of delta at tau (N, ...): 0 to pi wide."""
        ones = (-1,) + (1,) * (tau.ndim - 1)
        along, across, up = (self.axis[:, i].reshape(ones) for i in range(3))
        scale = np.maximum(np.hypot(along, across) * np.sin(tau), TINY)
        with np.errstate(over="ignore"):
            cos_half = (self.cosine.reshape(ones) - up * np.cos(tau)) / scale
        return np.arctan2(across, along), np.arccos(np.clip(cos_half, -1.0, 1.0))


def _chunks(count: int, nodes: int) -> Iterator[slice]:
    """Cut the patches so that a chunk's nodes stay within some tens of megabytes."""
    if nodes < 1:
        raise ValueError(f"nodes = {nodes}: must be >= 1")
    size = max(1, NODES_AT_ONCE // (2 * PIECES * nodes**2))
    for start in range(0, count, size):
        yield slice(start, start + size)


def _quadrature(points_mm: Float64, normals: Float64, arc: Hemisphere, nodes: int) -> _Quadrature:
    """Place the nodes on the part of the arc that each patch sees, with their weights.

    A unit vector x of the sphere faces the patch if x.(P - C) > R and stands above its horizon if
    x.n > n.(P - C) / R: two caps, whose common azimuths at a tau are at most two intervals.
    """
    R = arc.radius_mm
    to_patch = points_mm - arc.center_mm
    axes = _patch_axes(to_patch, arc.up)
    direction, a = _unit(to_patch)
    # Inside the sphere the cosine is above 1, which no x reaches; it is held at 2 to stay finite at C.
    facing = _Caps(np.einsum("nij,nj->ni", axes, direction), R / np.maximum(a, 0.5 * R))
    above = _Caps(np.einsum("nij,nj->ni", axes, normals), np.sum(normals * to_patch, axis=-1) / R)

    x, w = np.polynomial.legendre.leggauss(nodes)
    tau, d_tau = _polar_nodes(_tau_edges(facing, above), x, w)
    lower, upper = _common_azimuths(*facing.azimuths(tau), *above.azimuths(tau))
    half = 0.5 * np.maximum(upper - lower, 0.0)
    delta = (0.5 * (upper + lower))[..., np.newaxis] + half[..., np.newaxis] * x
    d_area = R**2 * (np.sin(tau) * d_tau)[..., np.newaxis, np.newaxis] * half[..., np.newaxis] * w

    used = d_area > 0
    patch = np.nonzero(used)[0]
    tau = np.broadcast_to(tau[..., np.newaxis, np.newaxis], used.shape)[used]
    delta = delta[used]
    local = np.column_stack([np.sin(tau) * np.cos(delta), np.sin(tau) * np.sin(delta), np.cos(tau)])
    on_sphere = np.einsum("ki,kij->kj", local, axes[patch])
    omega_i, r = _unit(R * on_sphere - to_patch[patch])
    cos_phi = np.maximum(-np.sum(omega_i * on_sphere, axis=-1), 0.0)
    cos_theta_i = np.maximum(np.sum(omega_i * normals[patch], axis=-1), 0.0)
    return _Quadrature(patch, omega_i, d_area[used] * cos_phi * cos_theta_i / r**2)


def _tau_edges(facing: _Caps, above: _Caps) -> Float64:
    """Return the sorted angles tau (N, PIECES + 1) between which the limits of delta are smooth.

    Besides 0 and pi/2: where a cap's rim turns back, and where the two rims cross.
    """
    edges = [*facing.turning_tau(), *above.turning_tau(), *_crossing_tau(facing, above)]
    ends = [np.zeros(len(facing.cosine)), np.full(len(facing.cosine), 0.5 * np.pi)]
    return np.sort(np.clip(np.column_stack(ends + edges), 0.0, 0.5 * np.pi), axis=1)


def _crossing_tau(caps: _Caps, other: _Caps) -> tuple[Float64, Float64]:
    """Return tau (N,) of the two points that two rims share, 0 where they share none.

    A shared point is s u + t v +- z (u x v) with u.x and v.x given: two linear equations and |x| = 1.
    """
    cosine = np.sum(caps.axis * other.axis, axis=-1)
    parallel = 1.0 - cosine**2 < 1e-14
    sine2 = np.where(parallel, 1.0, 1.0 - cosine**2)
    s = (caps.cosine - cosine * other.cosine) / sine2
    t = (other.cosine - cosine * caps.cosine) / sine2
    z2 = (1.0 - s * caps.cosine - t * other.cosine) / sine2
    crossing = (z2 >= 0) & ~parallel
    height = s * caps.axis[:, 2] + t * other.axis[:, 2]
    swing = np.sqrt(np.where(crossing, z2, 0.0)) * np.cross(caps.axis, other.axis)[:, 2]
    low, high = (
        np.arccos(np.clip(np.where(crossing, height + side * swing, 1.0), -1, 1)) for side in (-1, 1)
    )
    return low, high


def _polar_nodes(edges: Float64, x: Float64, w: Float64) -> tuple[Float64, Float64]:
    """Return tau and d tau (N, pieces, nodes) for Gauss-Legendre nodes x and weights w on [-1, 1].

    tau = lower + width (1 - cos(s)) / 2 with s in (0, pi): the limits of delta go like a square root at the
    edges, which is smooth in s.
    """
    s = 0.5 * np.pi * (x + 1.0)
    width = np.diff(edges, axis=1)[..., np.newaxis]
    tau = edges[:, :-1, np.newaxis] + width * 0.5 * (1.0 - np.cos(s))
    return tau, width * 0.25 * np.pi * np.sin(s) * w


def _common_azimuths(
    center: Float64, half: Float64, other_center: Float64, other_half: Float64
) -> tuple[Float64, Float64]:
    """Return the limits (..., 2) of delta that two intervals of the circle share; upper <= lower if none.

    Relative to the first one's centre the second one lies within half a turn, so that it meets the first
    as it is or turned once more round.
    """
    apart = np.remainder(other_center - center + np.pi, 2.0 * np.pi) - np.pi
    turned = apart - np.copysign(2.0 * np.pi, apart)
    lower = [np.maximum(-half, offset - other_half) for offset in (apart, turned)]
    upper = [np.minimum(half, offset + other_half) for offset in (apart, turned)]
    return (
        center[..., np.newaxis] + np.stack(lower, axis=-1),
        center[..., np.newaxis] + np.stack(upper, axis=-1),
    )


def _patch_axes(to_patch: Float64, up: Float64) -> Float64:
    """Return right-handed rows (N, 3, 3): level towards the patch (any such on the pole), across, up."""
    level_part = to_patch - (to_patch @ up)[:, np.newaxis] * up
    spare = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    distance = np.linalg.norm(to_patch, axis=-1, keepdims=True)
    level_part = np.where(
        np.linalg.norm(level_part, axis=-1, keepdims=True) > 1e-12 * distance, level_part, spare
    )
    towards, _ = _unit(level_part)
    return np.stack([towards, np.cross(up, towards), np.broadcast_to(up, towards.shape)], axis=1)


def _direction_to(points_mm: Float64, arc: Hemisphere) -> tuple[Float64, Float64]:
    """Return the unit vectors (N, 3) from the arc's centre to points and cos(tau_p) (N,) to `up`."""
    direction, _ = _unit(points_mm - arc.center_mm)
    return direction, direction @ arc.up


def _unit(vectors: Float64) -> tuple[Float64, Float64]:
    """Return vectors (..., 3) of length 1 and what their length (...,) was; a null vector stays one."""
    length = np.linalg.norm(vectors, axis=-1)
    return vectors / np.maximum(length, TINY)[..., np.newaxis], length
