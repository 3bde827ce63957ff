"""Rays of the made recordings: first hits, open ways and the arc's light, on Mitsuba 3's ray casting.

The arc is a sum over points spread evenly over its upper half (a spiral of the golden angle), each with a
shadow ray. Neighbouring pixels turn the spiral: 4 x 4 of them together see `TILE` times as many points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from validation.second_renderer.path_traced import load_mitsuba
from validation.second_renderer.world_metal import LobeShape, specular
from validation.second_renderer.world_surface import TrueSurface

ARC_POINTS = 160
"""Points on the arc's upper half, of which a pixel sees about half."""

TILE = 16

OFF_MM, SHORT = 2e-3, 1e-3
"""Shadow rays leave the metal by so much and end that share before the arc."""

GOLDEN = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class ArcBody:
    """A luminous upper half of a spheroid: centre (3,), mm, joint frame, radius, and height over radius."""

    center_mm: Float64
    radius_mm: float
    height_ratio: float = 1.0


class Caster:
    """Casts rays at a true surface; joint frame, mm. Raises ImportError where Mitsuba cannot start."""

    def __init__(self, surface: TrueSurface, from_x_mm: float, to_x_mm: float) -> None:
        self.surface = surface
        self._mi = mi = load_mitsuba()
        vertices, triangles, self._faces = surface.mesh(from_x_mm, to_x_mm)
        mesh = mi.Mesh("joint", len(vertices), len(triangles))
        values = mi.traverse(mesh)
        values["vertex_positions"] = mi.Float(vertices.ravel().astype(np.float32))
        values["faces"] = mi.UInt32(triangles.ravel().astype(np.uint32))
        values.update()
        # Robust: otherwise a ray now and then slips between two triangles.
        self._scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "joint": mesh})

    def first_hits(self, origin_mm: Float64, directions: Float64) -> tuple[Float64, Float64, Int64]:
        """Return points (n, 3), unit normals (n, 3) and faces (n,) met from (3,) along unit vectors (n, 3).

        NaN, NaN and -1 for a ray that looks past the metal.
        """
        mi = self._mi
        origin = mi.Point3f(*(self._opaque(value) for value in origin_mm))
        met = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, self._vectors(directions)))
        valid = np.array(met.is_valid(), dtype=bool)
        length, triangle = np.array(met.t, dtype=np.float64), np.array(met.prim_index, dtype=np.int64)
        points, normals = np.full_like(directions, np.nan), np.full_like(directions, np.nan)
        faces = np.full(len(directions), -1)
        faces[valid] = self._faces[triangle[valid]]
        points[valid], normals[valid] = self.surface.settle(
            origin_mm, directions[valid], length[valid], faces[valid]
        )
        return points, normals, faces

    def open_ways(self, points_mm: Float64, normals: Float64, targets_mm: Float64) -> Bool:
        """Return whether nothing lies between points (n, 3) and targets (n, 3) or (3,), mm."""
        mi = self._mi
        if len(points_mm) == 0:
            return np.zeros(0, dtype=bool)
        start = points_mm + OFF_MM * normals
        way = targets_mm - start
        length = np.linalg.norm(way, axis=1)
        ray = mi.Ray3f(self._points(start), self._vectors(way / length[:, np.newaxis]))
        ray.maxt = mi.Float(((1.0 - SHORT) * length).astype(np.float32))
        return ~np.array(self._scene.ray_test(ray), dtype=bool)

    def arc_light(
        self,
        points_mm: Float64,
        normals: Float64,
        towards_camera: Float64,
        tile: Int64,
        arc: ArcBody,
        c2: float,
        lobe: LobeShape,
        n_points: int = ARC_POINTS,
    ) -> tuple[Float32, Float32]:
        """Return D and S (n,): the integrals of cos(phi) cos(theta_i) / r^2 dA times 1 and the lobe's S.

        `tile` (n,) from 0 to TILE - 1 says how a pixel's spiral is turned. What the arc's own surface hides
        (cos(phi) < 0), the metal hides or lies below the patch's horizon does not count.
        """
        import drjit as dr

        mi = self._mi
        p, n, omega_r = self._points(points_mm), self._vectors(normals), self._vectors(towards_camera)
        c = mi.Point3f(*(self._opaque(value) for value in arc.center_mm))
        radius, height = self._opaque(arc.radius_mm), self._opaque(arc.height_ratio)
        turned = mi.Float(tile.astype(np.float32)) / TILE
        shift = mi.Float(_bit_reversed(tile).astype(np.float32)) / TILE

        def body(k: Any, D: Any, S: Any) -> tuple[Any, Any, Any]:
            cos_tau = 1.0 - (mi.Float(k) + shift + 0.5 / TILE) / n_points
            sin_tau = dr.sqrt(dr.maximum(1.0 - cos_tau * cos_tau, 0.0))
            sin_d, cos_d = dr.sincos(GOLDEN * mi.Float(k) + 2.0 * math.pi * turned)
            out = mi.Vector3f(sin_tau * cos_d, sin_tau * sin_d, cos_tau)
            place, facing = out, out
            if arc.height_ratio != 1.0:
                # A spheroid's patch over the sphere's is its normal, not of unit length.
                place = mi.Vector3f(out.x, out.y, height * out.z)
                facing = mi.Vector3f(height * out.x, height * out.y, out.z)
            way = c + radius * place - p
            r = dr.norm(way)
            omega_i = way / r
            cos_phi, cos_i = -dr.dot(omega_i, facing), dr.dot(omega_i, n)
            active = (cos_phi > 0.0) & (cos_i > 0.0)
            ray = mi.Ray3f(p + OFF_MM * n, omega_i)
            ray.maxt = (1.0 - SHORT) * r
            active &= ~self._scene.ray_test(ray, active)
            weight = dr.select(active, cos_phi * cos_i / (r * r), 0.0)
            return k + 1, D + weight, S + weight * specular(c2, lobe, n, omega_i, omega_r)

        zero = dr.zeros(mi.Float, len(points_mm))
        _, D, S = dr.while_loop(
            (dr.zeros(mi.UInt32, len(points_mm)), zero, mi.Float(zero)),
            lambda k, D, S: k < n_points,
            body,
        )
        area = 2.0 * math.pi * arc.radius_mm**2 / n_points
        dr.eval(D, S)
        return np.array(D, dtype=np.float32) * area, np.array(S, dtype=np.float32) * area

    def lobe(
        self, normals: Float64, omega_i: Float64, omega_r: Float64, c2: float, shape: LobeShape
    ) -> Float64:
        """Return the lobe's S (n,) for unit vectors (n, 3)."""
        if len(normals) == 0:
            return np.zeros(0)
        value = specular(c2, shape, *(self._vectors(v) for v in (normals, omega_i, omega_r)))
        return np.array(value, dtype=np.float64)

    def _opaque(self, value: float) -> Any:
        # A number that is part of the kernel would compile it anew for each pose.
        import drjit as dr

        return dr.opaque(self._mi.Float, float(value))

    def _points(self, points_mm: Float64) -> Any:
        return self._mi.Point3f(np.ascontiguousarray(points_mm.T, dtype=np.float32))

    def _vectors(self, vectors: Float64) -> Any:
        return self._mi.Vector3f(np.ascontiguousarray(vectors.T, dtype=np.float32))


def _bit_reversed(tile: Int64) -> Int64:
    """Return the four bits of a number (n,) below 16 in reverse: neighbours land far apart."""
    return ((tile & 1) << 3) | ((tile & 2) << 1) | ((tile & 4) >> 1) | ((tile & 8) >> 3)
