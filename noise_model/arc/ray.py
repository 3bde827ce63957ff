"""The arc's light that one surface point sends to the camera, and one ray of the camera with it."""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.arc.lap_light import lap_light
from noise_model.arc.quadrature import DiscRule, Hiding, Patch, arc_light
from noise_model.arc.scratch import ArcScratch, Record
from noise_model.arc.slices import SlicedSheets
from noise_model.compiled.arrays import Float32, Float64, Point, Vector
from noise_model.compiled.kernel import kernel
from noise_model.surface.brdf import LobeNumbers
from noise_model.surface.faces import face_normal
from noise_model.surface.ray_casting import MISS, first_hit
from noise_model.surface.visibility import Bend, bent, is_curved_lap, lap_planes, sky_planes
from noise_model.surface.wave import corrugation_of


class ArcKernel(NamedTuple):
    """A scene's numbers as the kernels take them.

    `rotation` (3, 3) and `eye` are the camera's in the joint frame, mm; `radiance_e` the arc's at its level;
    `bend` is the scene's; `metal_cuts` says that a corrugation may cut into the arc; `reach` between which x
    and which y the camera sees the plate, mm; `rule` says at which nodes light is integrated.
    """

    rotation: Float64
    eye: Point
    center: Point
    bend: Bend
    radius: float
    radiance_e: float
    vertices: Float64
    corrugation: Float64
    horizon_start: float
    horizons: Float64
    metal_cuts: bool
    reach: tuple[float, float, float, float]
    material: LobeNumbers
    rule: DiscRule


@kernel(inline=True)
def is_outside_radius(P: Point, center: Point, radius: float) -> bool:
    """Return True if a point stands farther than the radius from the arc's axis."""
    x, y = center[0] - P[0], center[1] - P[1]
    return x * x + y * y > radius * radius


@kernel(inline=True)
def _light_on_lap(k: ArcKernel, patch: Patch, face: int, planes: Float64, slices: Float32) -> float:
    """Return `light_at` for a lap whose edge is no straight line; the point stands outside the arc's disc."""
    P, normal, _ = patch
    vertices, center, radius = k.vertices, k.center, k.radius
    n_planes, crest_x = lap_planes(
        P=P,
        normal=normal,
        face=face,
        center=center,
        radius=radius,
        bend=k.bend,
        vertices=vertices,
        corrugation=k.corrugation,
        horizon_start=k.horizon_start,
        horizons=k.horizons,
        planes=planes,
    )
    edge_y = vertices[1, 0]
    slope, curve = bent(P, center, radius, k.bend)
    edge_hides = (face == 2 and (curve != 0.0 or center[1] - radius < edge_y + k.bend[1])) or (
        face == 0 and (curve != 0.0 or center[1] + radius > edge_y + k.bend[1])
    )
    sheets = SlicedSheets(
        corrugation_of(k.corrugation),
        (edge_y, slope, curve, vertices[1, 1] - vertices[2, 1]),
        crest_x,
        edge_hides,
        k.metal_cuts,
        face == 0,
    )
    light = lap_light(
        patch=patch,
        center=center,
        radius=radius,
        planes=planes,
        n_planes=n_planes,
        sheets=sheets,
        material=k.material,
        rule=k.rule,
        room=slices,
    )
    return k.radiance_e * light


@kernel(inline=True)
def light_at(k: ArcKernel, P: Point, face: int, work: ArcScratch) -> float:
    """Return the arc's light, e- without the lens' fall-off, that a point of a face sends to the camera.

    `P` may lie on the face's plane beyond its edges.
    """
    normal = face_normal(face, P[0], k.vertices, k.corrugation)
    rx, ry, rz = k.eye[0] - P[0], k.eye[1] - P[1], k.eye[2] - P[2]
    inverse = 1.0 / math.sqrt(rx * rx + ry * ry + rz * rz)
    patch = Patch(P, normal, (rx * inverse, ry * inverse, rz * inverse))
    return _light_of(k, patch, face, work.records[0], work.slices)


@kernel(inline=True)
def _light_of(k: ArcKernel, patch: Patch, face: int, room: Record, slices: Float32 | None) -> float:
    """Return `light_at` by the integral that the section needs."""
    P, normal, _ = patch
    # numba leaves out what follows where there is no room for slices.
    if slices is not None:  # noqa: SIM102
        if is_curved_lap(k.vertices, k.corrugation, k.bend) and is_outside_radius(P, k.center, k.radius):
            return _light_on_lap(k, patch, face, room.planes[:], slices)
    planes, ledges = room.planes[:], room.ledges[:]
    n_planes, n_ledges = sky_planes(
        P=P,
        normal=normal,
        face=face,
        center=k.center,
        radius=k.radius,
        bend=k.bend,
        vertices=k.vertices,
        planes=planes,
        ledges=ledges,
    )
    light = arc_light(
        patch, k.center, k.radius, Hiding(planes, n_planes, ledges, n_ledges), k.material, k.rule, room
    )
    return k.radiance_e * light


@kernel(inline=True)
def direction(k: ArcKernel, x: float, y: float) -> Vector:
    """Return the direction, joint frame, of a ray (x, y, 1) of the camera."""
    R = k.rotation
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2],
        R[1, 0] * x + R[1, 1] * y + R[1, 2],
        R[2, 0] * x + R[2, 1] * y + R[2, 2],
    )


@kernel
def follow(k: ArcKernel, x: float, y: float) -> tuple[Point, int]:
    """Return the end of a ray (x, y, 1) of the camera, joint frame, mm, and the face; MISS for none."""
    d = direction(k, x, y)
    t, face = first_hit(k.eye, d, k.vertices, k.corrugation)
    if face == MISS:
        return (math.nan, math.nan, math.nan), face
    return (k.eye[0] + t * d[0], k.eye[1] + t * d[1], k.eye[2] + t * d[2]), face
