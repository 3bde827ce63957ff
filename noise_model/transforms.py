"""Rigid poses: `T_a_b` takes points from frame b to frame a, as 4x4 float64 matrices in mm."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64, Vector
from noise_model.compiled.kernel import kernel


def pose_matrix(translation_mm: npt.ArrayLike, quaternion_xyzw: npt.ArrayLike) -> Float64:
    """Return the 4x4 pose of a translation (mm) and a quaternion (x y z w, normalised here).

    Raises ValueError if a value is not finite or the quaternion is not a rotation (norm off 1 by > 1 %).
    """
    translation = np.asarray(translation_mm, dtype=np.float64)
    quaternion = np.asarray(quaternion_xyzw, dtype=np.float64)
    if translation.shape != (3,) or quaternion.shape != (4,):
        raise ValueError("a pose needs 3 translations in mm and 4 quaternion components x y z w")
    if not (np.isfinite(translation).all() and np.isfinite(quaternion).all()):
        raise ValueError("a pose must be finite")
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > 0.01:
        raise ValueError(f"the quaternion's norm is {norm:.4f}, not 1: it is no rotation")
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = Rotation.from_quat(quaternion / norm).as_matrix()
    T_a_b[:3, 3] = translation
    return T_a_b


def invert(T_a_b: Float64) -> Float64:
    """Return T_b_a of a rigid T_a_b."""
    R_b_a, T_b_a = T_a_b[:3, :3].T, np.empty((4, 4))
    T_b_a[:3, :3] = R_b_a
    T_b_a[:3, 3] = -(R_b_a @ T_a_b[:3, 3])
    T_b_a[3] = 0.0, 0.0, 0.0, 1.0
    return T_b_a


def moved(T_a_b: Float64, turn_deg: npt.ArrayLike, move_mm: npt.ArrayLike) -> Float64:
    """Return T_a_b turned by a rotation vector (3,), deg, and moved by (3,) mm, both in b's own frame."""
    T_b_moved = np.eye(4)
    T_b_moved[:3, :3] = Rotation.from_rotvec(np.asarray(turn_deg), degrees=True).as_matrix()
    T_b_moved[:3, 3] = move_mm
    return np.asarray(T_a_b @ T_b_moved)


def cross(a: Vector, b: Vector) -> Float64:
    """Return the cross product of two vectors (3,): `numpy.cross` takes ten times as long for one pair."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def transform(T_a_b: Float64, points_b: Float64) -> Float64:
    """Return points (..., 3) of frame b in frame a."""
    return np.asarray(points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


@kernel(allocates=True)
def inverted(T_a_b: Float64) -> Float64:
    """Return T_b_a of a rigid T_a_b, for kernels."""
    T_b_a = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            T_b_a[i, j] = T_a_b[j, i]
            T_b_a[i, 3] -= T_a_b[j, i] * T_a_b[j, 3]
    T_b_a[3, 3] = 1.0
    return T_b_a


@kernel(allocates=True)
def multiplied(T_a_b: Float64, T_b_c: Float64) -> Float64:
    """Return T_a_c, for kernels: of so small matrices a library's call takes longer."""
    T_a_c = np.zeros((4, 4))
    for i in range(4):
        for j in range(4):
            for k in range(4):
                T_a_c[i, j] += T_a_b[i, k] * T_b_c[k, j]
    return T_a_c


@kernel(allocates=True)
def moved_point(T_a_b: Float64, point_b: Float64) -> Float64:
    """Return a point (3,) of frame b in frame a, for kernels."""
    point_a = np.empty(3)
    for i in range(3):
        point_a[i] = (
            T_a_b[i, 0] * point_b[0] + T_a_b[i, 1] * point_b[1] + T_a_b[i, 2] * point_b[2] + T_a_b[i, 3]
        )
    return point_a
