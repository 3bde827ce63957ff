"""First hits of rays on the joint, and straight ways over it that are free."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Bool, Float64, Int32, Integers, Vector
from noise_model.compiled.kernel import kernel
from noise_model.surface.faces import face_normal, ridge

MISS = -1
"""The face of a ray that looks past the workpiece."""


@kernel
def _meet_ridge(
    origin: Vector, d: Vector, y_k: float, width: float, z_k: float, slope: float, corrugation: Float64
) -> float:
    """Return the distance along a ray to a corrugated strip, in units of d, or inf.

    Looked at is the ray's way within the strip, between its base and its raised plane.
    """
    height = corrugation[0]
    base, climb = origin[2] - z_k - slope * (origin[1] - y_k), d[2] - slope * d[1]
    near, far = 0.0, math.inf
    for speed, to_low, to_high in (
        (d[1], y_k - origin[1], y_k + width - origin[1]),
        (climb, -base, height - base),
    ):
        if speed == 0.0:
            if not to_low <= 0.0 <= to_high:
                return math.inf
            continue
        t_low, t_high = to_low / speed, to_high / speed
        near, far = max(near, min(t_low, t_high)), min(far, max(t_low, t_high))
    if near > far:
        return math.inf
    if climb == 0.0 and d[0] != 0.0:
        # Level along the strip it meets within a pitch what it ever meets.
        far = min(far, near + corrugation[2] / abs(d[0]))
    if far == math.inf:
        return math.inf
    steps = 1
    if abs(d[0]) * math.pi * height / corrugation[1] >= abs(climb):
        # In how many steps per width of a corrugation a ray that may meet it more than once is followed.
        steps = min(4096, 1 + int(64 * abs(d[0]) * (far - near) / corrugation[1]))
    c, _ = ridge(origin[0] + near * d[0], corrugation)
    gap = base + near * climb - c
    from_below = gap < 0.0 or (climb > 0.0 and base + near * climb <= 1e-9)
    sign = -1.0 if from_below else 1.0
    if sign * gap <= 1e-9 and near > 0.0:
        return near
    last, curve = near, height * (math.pi / corrugation[1]) ** 2
    for i in range(steps):
        t = near + (far - near) * (i + 1) / steps
        c, dc = ridge(origin[0] + t * d[0], corrugation)
        gap = sign * (base + t * climb - c)
        if gap > 1e-9:
            last = t
            continue
        low, high = last, t
        for _ in range(40):
            slope_gap = sign * (climb - dc * d[0])
            step = t - gap / slope_gap if slope_gap < 0.0 else low
            if slope_gap < 0.0 and curve * ((step - t) * d[0]) ** 2 < 1e-9:
                # Less than that, mm, a step of Newton's leaves of the gap.
                return min(max(step, last), far)
            t_next = step if low < step < high else 0.5 * (low + high)
            if abs(t_next - t) < 1e-9 * far:
                return t_next
            t = t_next
            c, dc = ridge(origin[0] + t * d[0], corrugation)
            gap = sign * (base + t * climb - c)
            if gap > 0.0:
                low = t
            else:
                high = t
        return t
    return math.inf


@kernel
def first_hit(origin: Vector, d: Vector, vertices: Float64, corrugation: Float64) -> tuple[float, int]:
    """Return the distance along a ray (joint frame, mm) to the surface, in units of d, and the face.

    The face is the number of the section's strip, MISS where the ray looks past the workpiece.
    """
    best, face = math.inf, MISS
    for k in range(vertices.shape[0] - 1):
        y_k, z_k = vertices[k, 0], vertices[k, 1]
        width, rise = vertices[k + 1, 0] - y_k, vertices[k + 1, 1] - z_k
        if corrugation[0] > 0.0 and width > 0.0:
            t = _meet_ridge(origin, d, y_k, width, z_k, rise / width, corrugation)
            if 0.0 < t < best:
                best, face = t, k
            continue
        across = d[2] * width - d[1] * rise
        if across == 0.0:
            continue
        t = -((origin[2] - z_k) * width - (origin[1] - y_k) * rise) / across
        if not 0.0 < t < best:
            continue
        if width > abs(rise):
            share = (origin[1] + t * d[1] - y_k) / width
        else:
            c, _ = ridge(origin[0] + t * d[0], corrugation)
            share = (origin[2] + t * d[2] - c - z_k) / rise
        if 0.0 <= share <= 1.0:
            best, face = t, k
    return best, face


@kernel
def trace(
    xy: npt.NDArray[np.floating],
    which: Integers,
    T_joint_camera: Float64,
    vertices: Float64,
    corrugation: Float64,
    points: Float64,
    normals: Float64,
    faces: Int32,
) -> None:
    """Follow rays to the surface.

    `xy` (n, 2) are normalised rays of a camera, `which` (n,) says from which of its poses (m, 4, 4) each of
    them comes. Written are, in the joint frame, `points` (n, 3) mm and `normals` (n, 3), NaN for a miss, and
    `faces` (n,) int32.
    """
    for i in range(which.shape[0]):
        T, x, y = T_joint_camera[which[i]], xy[i, 0], xy[i, 1]
        origin = T[0, 3], T[1, 3], T[2, 3]
        d = (
            T[0, 0] * x + T[0, 1] * y + T[0, 2],
            T[1, 0] * x + T[1, 1] * y + T[1, 2],
            T[2, 0] * x + T[2, 1] * y + T[2, 2],
        )
        t, face = first_hit(origin, d, vertices, corrugation)
        faces[i] = face
        if face == MISS:
            points[i, :] = np.nan
            normals[i, :] = np.nan
            continue
        for j in range(3):
            points[i, j] = origin[j] + t * d[j]
        nx, ny, nz = face_normal(face, points[i, 0], vertices, corrugation)
        normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz


@kernel(allocates=True)
def way_is_open(P: Float64, Q: Float64, vertices: Float64, corrugation: Float64) -> bool:
    """Return True if the straight way from a surface point P up to a point Q, both (3,) mm, is free."""
    for k in range(1, vertices.shape[0] - 1):
        y_k = vertices[k, 0]
        if not min(P[1], Q[1]) < y_k < max(P[1], Q[1]):
            continue
        share = (y_k - P[1]) / (Q[1] - P[1])
        c, _ = ridge(P[0] + share * (Q[0] - P[0]), corrugation)
        if P[2] + share * (Q[2] - P[2]) < vertices[k, 1] + c - 1e-9:
            return False
    if corrugation[0] == 0.0:
        return True
    steps = 64
    top = corrugation[0] + vertices[:, 1].max()
    reach = min(1.0, max(0.0, (top - P[2]) / (Q[2] - P[2]))) if Q[2] > P[2] else 1.0
    for i in range(1, steps + 1):
        share = reach * i / steps
        c, _ = ridge(P[0] + share * (Q[0] - P[0]), corrugation)
        # Only a lap is corrugated: its upper sheet ends at vertex 1.
        sheet = vertices[1, 1] if P[1] + share * (Q[1] - P[1]) < vertices[1, 0] else vertices[2, 1]
        if P[2] + share * (Q[2] - P[2]) < sheet + c - 1e-6:
            return False
    return True


@kernel(allocates=True)
def ways_are_open(
    points: Float64, Q: Float64, vertices: Float64, corrugation: Float64, is_free: Bool
) -> None:
    """Write for each surface point (n, 3) whether its way up to Q is free."""
    for i in range(points.shape[0]):
        is_free[i] = way_is_open(points[i], Q, vertices, corrugation)
