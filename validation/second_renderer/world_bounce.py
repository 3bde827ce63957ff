"""Light that bounces between the faces of a true joint, gathered over nodes on its metal.

A node j of area A_j hands a point i the irradiance L_j cos(theta_i) cos(theta_j) A_j / (r^2 + A_j / pi) where
nothing lies between: the disc's form factor, which stays finite in a corner (Glassner 1995, Principles of
Digital Image Synthesis). The first bounce is the metal's own reflectance, what bounces again goes evenly
(a Lambertian surface of the same albedo). Absolute reflectance is `scale` times the stated, relative one.
Good to about a tenth of the bounced light: nodes stand some 0.6 mm apart at the seam, and a face that is
narrower than `STEP_PX` in the image gets none.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import newton

from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.transforms import invert, transform
from validation.second_renderer.world_light import Studio, WorldSight, digest
from validation.second_renderer.world_rays import GOLDEN, TILE, ArcBody

STEP_PX = 10
"""Bounced light is gathered at every so many pixels and is linear between them, face by face."""

BEHIND_MM, AHEAD_MM, ASIDE_MM = 40.0, 90.0, 40.0
ALONG_MM, ALONG_FINE_MM, UNDER_MM = 2.0, 1.0, 12.0
"""Steps of the nodes along the seam, and those within `UNDER_MM` of the arc."""

FINE_MM, GROWTH = 0.6, 1.2
SHEET_STEPS = np.linspace(-2.0, 2.0, 5)
"""Where the sheet is sampled across, in its sigmas."""

PATCHES, NEAR_RADII = 16, 6.0
"""A node so many radii from the arc and nearer sees it as so many patches: they come from all sides."""

AT_ONCE = 400


@dataclass(frozen=True, eq=False)
class Nodes:
    """Patches of metal: points (n, 3), mm, unit normals (n, 3), areas (n,), mm^2."""

    points: Float64
    normals: Float64
    area_mm2: Float64


@dataclass(frozen=True, eq=False)
class Lit:
    """Nodes, their irradiance (k, n) from each patch of a source and the unit vectors (k, n, 3) to it."""

    nodes: Nodes
    E: Float64
    omega_i: Float64


@dataclass(frozen=True)
class Bounces:
    """How light bounces: `scale` as above, `most` bounces, `glossy` or evenly by kappa_diff alone."""

    scale: float
    most: int = 6
    glossy: bool = True


def bounced_light(
    studio: Studio, sight: WorldSight, arc: ArcBody, bounces: Bounces
) -> tuple[Float64, Float64]:
    """Return the bounced light (H, W) of the arc at nominal current and of the laser, e-; kept on disk."""
    setup = studio.world.setup
    metal = setup.material
    key = digest(
        sight.key,
        sight.T_joint_tool,
        arc.center_mm,
        replace(setup.laser, peak_e=1.0),
        (arc.radius_mm, metal.kappa_diff, metal.kappa_spec, metal.c2, studio.world.lobe),
        bounces,
        (STEP_PX, ALONG_FINE_MM, PATCHES),
    )
    by_arc, by_laser = studio.keep(f"bounced_{key}", lambda: _bounced_light(studio, sight, arc, bounces))
    cos4 = sight.cos4.reshape(sight.shape)
    laser_unit = setup.laser.peak_e / studio.stripe_on_plate
    return setup.arc.radiance_e * cos4 * by_arc, laser_unit * cos4 * by_laser


def _bounced_light(
    studio: Studio, sight: WorldSight, arc: ArcBody, bounces: Bounces
) -> tuple[Float32, Float32]:
    nodes = _grid(studio, float(arc.center_mm[0]))
    faces, pixels = sight.faces.reshape(sight.shape), np.arange(sight.faces.size).reshape(sight.shape)
    coarse = slice(STEP_PX // 2, None, STEP_PX)
    grid = faces[coarse, coarse]
    receivers = pixels[coarse, coarse][grid >= 0]
    images = []
    for lit in (_by_arc(studio, nodes, arc), _by_laser(studio, sight)):
        again = _bounced_again(studio, nodes, lit, bounces)
        values = np.zeros(grid.shape)
        values[grid >= 0] = _gather(studio, sight, receivers, lit, nodes, again, bounces)
        images.append(_between(values, grid, sight).astype(np.float32))
    return images[0], images[1]


def _grid(studio: Studio, arc_x_mm: float) -> Nodes:
    """Return nodes on all faces about the arc and ahead of it, fine where a face begins at the seam."""
    x, dx = _stations(arc_x_mm)
    outline = studio.surface.outline_mm()
    parts = []
    for face, (a, b) in enumerate(itertools.pairwise(outline)):
        s, ds = _along_face(a, b)
        edge = (b - a) / np.linalg.norm(b - a)
        n, along = np.indices((len(x), len(s))).reshape(2, -1)
        parts.append(_on_face(studio, face, x[n], a + s[along, np.newaxis] * edge, dx[n] * ds[along]))
    return _joined(parts)


def _stations(arc_x_mm: float) -> tuple[Float64, Float64]:
    """Return stations about the arc (n,), mm, and the lengths (n,) that they stand for."""
    edges = arc_x_mm + np.concatenate(
        [
            np.arange(-BEHIND_MM, -UNDER_MM, ALONG_MM),
            np.arange(-UNDER_MM, UNDER_MM, ALONG_FINE_MM),
            np.arange(UNDER_MM, AHEAD_MM + ALONG_MM, ALONG_MM),
        ]
    )
    return 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)


def _along_face(a: Float64, b: Float64) -> tuple[Float64, Float64]:
    """Return places along the edge a to b (k,), mm from a, and the lengths (k,) that they stand for."""
    length = float(np.linalg.norm(b - a))
    endless = length > 2.0 * ASIDE_MM
    if not endless:
        edges = np.linspace(0.0, length, 1 + max(2, math.ceil(length / FINE_MM)))
    else:
        edges = np.array([0.0])
        while edges[-1] < ASIDE_MM:
            edges = np.append(edges, edges[-1] + FINE_MM * GROWTH ** (len(edges) - 1))
        if abs(a[0]) > abs(b[0]):
            edges = length - edges[::-1]
    return 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)


def _on_face(studio: Studio, face: int, x: Float64, yz: Float64, area: Float64) -> Nodes:
    surface = studio.surface
    aside, lift = surface.departure.y_mm(x)[0], surface.lift_mm(x)[0]
    points = np.column_stack([x, yz[:, 0] + aside, yz[:, 1] + lift])
    _, gradient = surface.level(points, np.full(len(x), face))
    size = np.linalg.norm(gradient, axis=1)
    return Nodes(points, gradient / size[:, np.newaxis], area * size)


def _joined(parts: list[Nodes]) -> Nodes:
    return Nodes(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.area_mm2 for part in parts]),
    )


def _by_arc(studio: Studio, nodes: Nodes, arc: ArcBody) -> Lit:
    world = studio.world
    tile = np.arange(len(nodes.points)) % TILE
    D, _ = studio.caster.arc_light(
        nodes.points, nodes.normals, nodes.normals, tile, arc, world.setup.material.c2, world.lobe
    )
    return Lit(nodes, *_from_patches(studio, nodes, arc, D.astype(np.float64)))


def _from_patches(studio: Studio, nodes: Nodes, arc: ArcBody, D: Float64) -> tuple[Float64, Float64]:
    """Return the irradiance D (n,) by patches of the arc (k, n), and the unit vectors (k, n, 3) to them.

    Far off the half ball's light comes as from its middle, all of it in the first patch.
    """
    middle = arc.center_mm + np.array([0.0, 0.0, 0.4 * arc.radius_mm])
    n = len(nodes.points)
    near = np.linalg.norm(nodes.points - arc.center_mm, axis=1) < NEAR_RADII * arc.radius_mm
    weight, omega = np.zeros((PATCHES, n)), np.tile(_unit(middle - nodes.points), (PATCHES, 1, 1))
    points, normals = nodes.points[near], nodes.normals[near]
    for k in range(PATCHES):
        cos_tau, turn = 1.0 - (k + 0.5) / PATCHES, GOLDEN * k
        sin_tau = math.sqrt(1.0 - cos_tau**2)
        out = np.array([sin_tau * math.cos(turn), sin_tau * math.sin(turn), cos_tau])
        patch = arc.center_mm + arc.radius_mm * out
        omega[k, near] = _unit(patch - points)
        shines = np.maximum(-omega[k, near] @ out, 0.0)
        cos_i = np.maximum(np.sum(omega[k, near] * normals, axis=1), 0.0)
        open_ = studio.caster.open_ways(points, normals, np.broadcast_to(patch, points.shape))
        weight[k, near] = shines * cos_i * open_ / np.sum((patch - points) ** 2, axis=1)
    total = weight.sum(axis=0)
    seen = total > 0.0
    omega[0, ~seen] = _unit(middle - nodes.points[~seen])
    weight[0, ~seen] = total[~seen] = 1.0
    return D * weight / total, omega


def _by_laser(studio: Studio, sight: WorldSight) -> Lit:
    """Return nodes along the sheet's trace on every face, lit by it."""
    laser, surface = studio.world.setup.laser, studio.surface
    T_tool_joint = invert(sight.T_joint_tool)
    outline = surface.outline_mm()
    origin = transform(sight.T_joint_tool, laser.origin_mm)
    parts = []
    for face, (a, b) in enumerate(itertools.pairwise(outline)):
        s, ds = _along_face(a, b)
        yz = a + s[:, np.newaxis] * (b - a) / np.linalg.norm(b - a)

        def aside(x: Float64, corner: Float64 = yz) -> Float64:
            lifted = [x, corner[:, 0] + surface.departure.y_mm(x)[0], corner[:, 1] + surface.lift_mm(x)[0]]
            return laser.off_mm(transform(T_tool_joint, np.column_stack(lifted)))

        trace = np.asarray(newton(aside, np.full(len(s), origin[0]), tol=1e-6, maxiter=60))
        step = laser.stripe_sigma_mm * (SHEET_STEPS[1] - SHEET_STEPS[0])
        parts += [
            _on_face(studio, face, trace + offset, yz, step * ds)
            for offset in laser.stripe_sigma_mm * SHEET_STEPS
        ]
    nodes = _joined(parts)
    targets = np.broadcast_to(origin, nodes.points.shape)
    E = studio.sheet(nodes.points, nodes.normals, sight.T_joint_tool)
    E = E * studio.caster.open_ways(nodes.points, nodes.normals, targets)
    return Lit(nodes, E[np.newaxis], _unit(origin - nodes.points)[np.newaxis])


def _bounced_again(studio: Studio, nodes: Nodes, lit: Lit, bounces: Bounces) -> Float64:
    """Return the radiance (n,) that nodes send out evenly after two bounces and more; 0 for one bounce."""
    if bounces.most < 2:
        return np.zeros(len(nodes.points))
    metal = studio.world.setup.material
    # A lobe's own albedo at normal incidence: the integral of kappa_spec exp(-c2 theta^2 / 4) d omega.
    even = bounces.scale * (metal.kappa_diff + 4.0 * metal.kappa_spec / metal.c2)
    first = np.concatenate(
        [
            np.sum(_arriving(studio, nodes.points[part], nodes.normals[part], lit, bounces)[0], axis=1)
            for part in _parts(len(nodes.points))
        ]
    )
    between = np.concatenate(
        [
            _exchange(studio, nodes.points[part], nodes.normals[part], nodes)[0]
            for part in _parts(len(nodes.points))
        ]
    )
    E, total = first, first.copy()
    for _ in range(bounces.most - 2):
        E = even * (between @ E)
        total += E
    return even * total


def _gather(
    studio: Studio,
    sight: WorldSight,
    receivers: Int64,
    lit: Lit,
    nodes: Nodes,
    again: Float64,
    bounces: Bounces,
) -> Float64:
    """Return what pixels (m,) send to the camera of bounced light, per unit of the source."""
    metal = studio.world.setup.material
    value = np.zeros(len(receivers))
    for part in _parts(len(receivers)):
        pixels = receivers[part]
        points, normals, towards = sight.points[pixels], sight.normals[pixels], -sight.directions[pixels]
        for is_first in (True, False):
            if is_first:
                E, omega_i = _arriving(studio, points, normals, lit, bounces)
            else:
                exchange, omega_i = _exchange(studio, points, normals, nodes)
                E = exchange * again
            some = np.nonzero(E > 0.0)
            lobe = studio.caster.lobe(
                normals[some[0]], omega_i[some], towards[some[0]], metal.c2, studio.world.lobe
            )
            f_r = metal.kappa_diff + metal.kappa_spec * lobe
            value[part] += np.bincount(some[0], f_r * E[some], minlength=len(pixels))
    return value


def _arriving(
    studio: Studio, points: Float64, normals: Float64, lit: Lit, bounces: Bounces
) -> tuple[Float64, Float64]:
    """Return irradiance (m, n) of points (m, 3) by each node after its first bounce, and directions."""
    metal = studio.world.setup.material
    exchange, omega = _exchange(studio, points, normals, lit.nodes)
    value = np.zeros_like(exchange)
    for E, omega_i in zip(lit.E, lit.omega_i, strict=True):
        light = exchange * E
        some = np.nonzero(light)
        f_r = np.full(len(some[0]), metal.kappa_diff)
        if bounces.glossy:
            lobe = studio.caster.lobe(
                lit.nodes.normals[some[1]], omega_i[some[1]], -omega[some], metal.c2, studio.world.lobe
            )
            f_r += metal.kappa_spec * lobe
        value[some] += f_r * light[some]
    return bounces.scale * value, omega


def _exchange(studio: Studio, points: Float64, normals: Float64, nodes: Nodes) -> tuple[Float64, Float64]:
    """Return irradiance (m, n) of points (m, 3) per unit of the nodes' radiance, and unit vectors to them."""
    way = nodes.points - points[:, np.newaxis]
    square = np.sum(way**2, axis=-1)
    omega = way / np.sqrt(np.maximum(square, 1e-12))[..., np.newaxis]
    cos_i = np.einsum("mnk,mk->mn", omega, normals)
    cos_j = -np.einsum("mnk,nk->mn", omega, nodes.normals)
    value = cos_i * cos_j * nodes.area_mm2 / (square + nodes.area_mm2 / math.pi)
    value[(cos_i <= 0.0) | (cos_j <= 0.0)] = 0.0
    i, j = np.nonzero(value > 0.0)
    value[i, j] *= studio.caster.open_ways(points[i], normals[i], nodes.points[j] + 5e-3 * nodes.normals[j])
    return value, omega


def _between(coarse: Float64, faces: Int64, sight: WorldSight) -> Float64:
    """Return a coarse image at every pixel (H, W): linear between the nodes of the pixel's own face."""
    height, width = sight.shape
    v = np.clip((np.arange(height) - STEP_PX // 2) / STEP_PX, 0.0, coarse.shape[0] - 1.0)
    u = np.clip((np.arange(width) - STEP_PX // 2) / STEP_PX, 0.0, coarse.shape[1] - 1.0)
    v0, u0 = np.minimum(v.astype(int), coarse.shape[0] - 2), np.minimum(u.astype(int), coarse.shape[1] - 2)
    fv, fu = (v - v0)[:, np.newaxis], (u - u0)[np.newaxis]
    face = sight.faces.reshape(sight.shape)
    total, weight = np.zeros(sight.shape), np.zeros(sight.shape)
    for dv in (0, 1):
        for du in (0, 1):
            corner = np.ix_(v0 + dv, u0 + du)
            w = (fv if dv else 1.0 - fv) * (fu if du else 1.0 - fu) * (faces[corner] == face)
            total += w * coarse[corner]
            weight += w
    return np.where((weight > 0.0) & (face >= 0), total / np.maximum(weight, 1e-12), 0.0)


def _parts(n: int) -> list[slice]:
    return [slice(first, min(first + AT_ONCE, n)) for first in range(0, n, AT_ONCE)]


def _unit(vectors: Float64) -> Float64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
