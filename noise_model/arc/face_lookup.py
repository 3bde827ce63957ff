"""Face of a plain section that a camera's ray meets, read off a list of what the eye sees.

A plain section is the same at every station, so which face a ray meets first is said by its direction across
the seam alone: between two neighbouring vertex lines, as the eye sees them, it is always the same one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.ray import ArcKernel, direction, follow
from noise_model.compiled.arrays import Float64, Int64, Point
from noise_model.compiled.kernel import kernel
from noise_model.surface.faces import Strip
from noise_model.surface.ray_casting import first_hit


class VisibleFaces(NamedTuple):
    """A plain section's faces that the eye sees: `faces` (n + 1,) between sorted `slopes` (n,), dy/-dz."""

    slopes: Float64
    faces: Int64


@kernel(allocates=True)
def sight(k: ArcKernel) -> VisibleFaces:
    """Return the visible faces of a scene, its corrugation left out."""
    slopes, n = np.empty(k.vertices.shape[0]), 0
    for i in range(k.vertices.shape[0]):
        down = k.eye[2] - k.vertices[i, 1]
        if down <= 0.0:
            continue
        slope = (k.vertices[i, 0] - k.eye[1]) / down
        place = n
        while place > 0 and slopes[place - 1] > slope:
            slopes[place] = slopes[place - 1]
            place -= 1
        slopes[place] = slope
        n += 1
    faces = np.empty(n + 1, dtype=np.int64)
    for i in range(n + 1):
        low = slopes[max(i - 1, 0)] - (1.0 if i == 0 else 0.0)
        high = slopes[min(i, n - 1)] + (1.0 if i == n else 0.0)
        _, faces[i] = first_hit(k.eye, (0.0, 0.5 * (low + high), -1.0), k.vertices, np.zeros(3))
    return VisibleFaces(slopes[:n].copy(), faces)


@kernel(inline=True)
def meet_plane(k: ArcKernel, x: float, y: float, on: Strip) -> tuple[Point, bool]:
    """Return the place of a camera's ray (x, y, 1) in a strip's plane, mm, and True if it is ahead."""
    y_0, z_0, ty, tz, _ = on
    d, eye = direction(k, x, y), k.eye
    t = (ty * (z_0 - eye[2]) - tz * (y_0 - eye[1])) / (ty * d[2] - tz * d[1])
    return (eye[0] + t * d[0], eye[1] + t * d[1], eye[2] + t * d[2]), t > 0.0


@kernel(inline=True)
def face_seen(k: ArcKernel, seen: VisibleFaces, x: float, y: float) -> int:
    """Return the face that a ray (x, y, 1) of the camera meets, `ray_casting.MISS` for none.

    Rays that are listed nowhere, level ones or those through an edge itself, are followed.
    """
    d = direction(k, x, y)
    slope = -d[1] / d[2] if d[2] < 0.0 else math.nan
    low, high = 0, seen.slopes.shape[0]
    while low < high:
        middle = (low + high) // 2
        if seen.slopes[middle] < slope:
            low = middle + 1
        else:
            high = middle
    if math.isnan(slope) or (low < seen.slopes.shape[0] and seen.slopes[low] == slope):
        _, face = follow(k, x, y)
    else:
        face = seen.faces[low]
    return face
