"""The joint's faces as the kernels take them: a section's strips, drawn along the seam and corrugated.

A place on a face is the station x and the way s across it, mm, joint frame. A corrugation raises the whole
section by c(x), so s is counted along the plain strip.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Float64, Point, Vector
from noise_model.compiled.kernel import kernel

Strip = tuple[float, float, float, float, float]
"""Origin of s (y, z), its unit direction (y, z) in the section, and the face's width, mm."""


RAISED_COSINE = (
    1.0000000000019997,
    -0.467401100495796,
    0.09455386667088718,
    -0.011122585390665594,
    0.0008664175883633607,
    -4.834739744244467e-05,
    2.11716280647801e-06,
    -9.310384235279762e-08,
)
"""The series of `raised_cosine`, from the constant up; a fit here would differ by processor."""


@kernel(inline=True)
def raised_cosine(v: float) -> tuple[float, float]:
    """Return (1 + cos(pi sqrt(v))) / 2, v from 0 to 1, and its derivative by v; 0 beyond 1.

    (1 - v)^2 times a polynomial of degree 7, 2e-11 off at most: a fifth of what cosine and sine take.
    """
    rest = max(1.0 - v, 0.0)
    g = RAISED_COSINE[5] + v * (RAISED_COSINE[6] + v * RAISED_COSINE[7])
    g = RAISED_COSINE[0] + v * (
        RAISED_COSINE[1] + v * (RAISED_COSINE[2] + v * (RAISED_COSINE[3] + v * (RAISED_COSINE[4] + v * g)))
    )
    dg = 5.0 * RAISED_COSINE[5] + v * (6.0 * RAISED_COSINE[6] + v * 7.0 * RAISED_COSINE[7])
    dg = RAISED_COSINE[1] + v * (
        2.0 * RAISED_COSINE[2] + v * (3.0 * RAISED_COSINE[3] + v * (4.0 * RAISED_COSINE[4] + v * dg))
    )
    return rest * rest * g, rest * (rest * dg - 2.0 * g)


@kernel(inline=True)
def raised(x: float, height: float, width: float, pitch: float) -> tuple[float, float]:
    """Return the height c(x), mm, of a corrugation of these dimensions and its slope c'(x)."""
    if height == 0.0:
        return 0.0, 0.0
    u = x - pitch * np.floor(x / pitch + 0.5)
    share = 2.0 / width * u
    c, by_v = raised_cosine(share * share)
    return height * c, 4.0 * height / width * share * by_v


@kernel(inline=True)
def ridge(x: float, corrugation: Float64) -> tuple[float, float]:
    """Return the corrugation's height c(x), mm, and its slope c'(x)."""
    return raised(x, corrugation[0], corrugation[1], corrugation[2])


@kernel(inline=True)
def strip(face: int, vertices: Float64) -> Strip:
    """Return a face's strip, s counted from its first vertex; y does not decrease along s."""
    y_0, z_0 = vertices[face, 0], vertices[face, 1]
    dy, dz = vertices[face + 1, 0] - y_0, vertices[face + 1, 1] - z_0
    width = math.sqrt(dy * dy + dz * dz)
    return y_0, z_0, dy / width, dz / width, width


@kernel
def face_under(y: float, face: int, vertices: Float64) -> int:
    """Return the face of a section (n, 2), y rising, under y; it is sought from one on that is not beyond."""
    while face < vertices.shape[0] - 2 and y >= vertices[face + 1, 0]:
        face += 1
    return face


@kernel
def slope_across(face: int, vertices: Float64) -> float:
    """Return dz/dy of a face, 0 of a wall."""
    width = vertices[face + 1, 0] - vertices[face, 0]
    return (vertices[face + 1, 1] - vertices[face, 1]) / width if width > 0.0 else 0.0


@kernel
def height_under(x: float, y: float, vertices: Float64, corrugation: Float64) -> float:
    """Return a section's height, mm, at a place in plan; beyond its ends that of these."""
    k = face_under(y, 0, vertices)
    share = (y - vertices[k, 0]) / (vertices[k + 1, 0] - vertices[k, 0])
    plain = vertices[k, 1] + min(max(share, 0.0), 1.0) * (vertices[k + 1, 1] - vertices[k, 1])
    return float(plain + ridge(x, corrugation)[0])


@kernel
def across(P: Vector, on: Strip, corrugation: Float64) -> float:
    """Return a point's way s across a strip."""
    y_0, z_0, ty, tz, _ = on
    if tz == 0.0:
        return (P[1] - y_0) * ty
    c, _ = ridge(P[0], corrugation)
    return (P[1] - y_0) * ty + (P[2] - c - z_0) * tz


@kernel
def face_point(x: float, s: float, on: Strip, corrugation: Float64) -> Point:
    """Return the point (mm, joint frame) of a place on a strip."""
    y_0, z_0, ty, tz, _ = on
    c, _ = ridge(x, corrugation)
    return x, y_0 + s * ty, z_0 + s * tz + c


@kernel(inline=True)
def slanted(slope: float, on: Strip) -> tuple[Point, float]:
    """Return a strip's unit normal where the corrugation has a slope, and its area over dx ds."""
    _, _, ty, tz, _ = on
    area = math.sqrt(1.0 + ty * ty * slope * slope)
    return (-slope * ty / area, -tz / area, ty / area), area


@kernel(inline=True)
def face_normal(face: int, x: float, vertices: Float64, corrugation: Float64) -> Point:
    """Return the unit normal of a face at station x, joint frame."""
    _, slope = ridge(x, corrugation)
    normal, _ = slanted(slope, strip(face, vertices))
    return normal
