"""The laser stripe that one face of a joint shows mirrored in another."""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Float32, Float64, Int32, Point
from noise_model.compiled.kernel import kernel
from noise_model.instrument.laser import Sheet, sheet_of, sheet_reflected
from noise_model.stripe import stripe_reference
from noise_model.surface.brdf import LobeNumbers, lobe_numbers
from noise_model.surface.faces import face_normal
from noise_model.surface.ray_casting import MISS, first_hit, way_is_open
from noise_model.view import View

OFF_MM = 1e-4
"""A mirrored ray starts so far above the face that it leaves."""


def mirrored_stripe_e(view: View) -> Float32:
    """Return the stripe's light (...,), e-, that a view shows mirrored once by faces that mirror all light.

    The camera sees it in a face, or a face throws it onto another one. Ridges of a corrugation mirror none.
    """
    setup, scene = view.setup, view.scene
    points, normals, faces = view.surface
    light = np.zeros(faces.size)
    _mirror(
        points=points.reshape(-1, 3),
        normals=normals.reshape(-1, 3),
        faces=faces.reshape(-1),
        camera=np.ascontiguousarray(scene.T_joint_camera[:3, 3]),
        sheet=sheet_of(setup.laser, scene.T_joint_tool),
        reach=setup.laser.reach_sigmas,
        material=lobe_numbers(setup.material),
        vertices=scene.shape.vertices,
        corrugation=scene.shape.corrugation,
        light=light,
    )
    unit_e = setup.laser.peak_e / stripe_reference(setup)
    return np.asarray(light.reshape(view.shape) * (unit_e * view.rays.cos4), dtype=np.float32)


@kernel
def _mirrored(d: Point, n: Point) -> Point:
    """Return a direction mirrored in a plane of normal n."""
    along = 2.0 * (d[0] * n[0] + d[1] * n[1] + d[2] * n[2])
    return d[0] - along * n[0], d[1] - along * n[1], d[2] - along * n[2]


@kernel
def _towards(P: Point, Q: Point) -> Point:
    """Return the direction from P to Q."""
    x, y, z = Q[0] - P[0], Q[1] - P[1], Q[2] - P[2]
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@kernel(allocates=True)
def _mirror(
    points: Float64,
    normals: Float64,
    faces: Int32,
    camera: Float64,
    sheet: Sheet,
    reach: float,
    material: LobeNumbers,
    vertices: Float64,
    corrugation: Float64,
    light: Float64,
) -> None:
    """Write the mirrored light (n,) over the sheet's peak at points (n, 3) of faces (n,)."""
    met = np.empty(3)
    eye, laser = (camera[0], camera[1], camera[2]), (sheet.origin[0], sheet.origin[1], sheet.origin[2])
    for i in range(points.shape[0]):
        light[i] = 0.0
        if faces[i] == MISS or corrugation[0] > 0.0:
            continue
        n = normals[i, 0], normals[i, 1], normals[i, 2]
        P = points[i, 0] + OFF_MM * n[0], points[i, 1] + OFF_MM * n[1], points[i, 2] + OFF_MM * n[2]
        seen = _mirrored(_towards(eye, P), n)
        t, face = first_hit(P, seen, vertices, corrugation)
        if face != MISS and face != faces[i]:
            for j in range(3):
                met[j] = P[j] + t * seen[j]
            back = -seen[0], -seen[1], -seen[2]
            there = face_normal(face, met[0], vertices, corrugation)
            stripe = sheet_reflected(sheet, material, met, there, back, reach)
            if stripe > 0.0 and way_is_open(met, sheet.origin, vertices, corrugation):
                light[i] += stripe
        for face in range(vertices.shape[0] - 1):
            m = face_normal(face, P[0], vertices, corrugation)
            # How far P stands in front of the face's plane.
            off = (P[1] - vertices[face, 0]) * m[1] + (P[2] - vertices[face, 1]) * m[2]
            if face == faces[i] or off <= 0.0:
                continue
            # Mirrored together, point, normal and view are lit by the sheet as it is.
            behind = P[0], P[1] - 2.0 * off * m[1], P[2] - 2.0 * off * m[2]
            view = _mirrored(_towards(P, eye), m)
            stripe = sheet_reflected(sheet, material, behind, _mirrored(n, m), view, reach)
            if stripe == 0.0:
                continue
            way = _mirrored(_towards(behind, laser), m)
            t, by = first_hit(P, way, vertices, corrugation)
            for j in range(3):
                met[j] = P[j] + t * way[j]
            if by == face and way_is_open(met, sheet.origin, vertices, corrugation):
                light[i] += stripe
