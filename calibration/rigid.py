"""Many rigid poses at once, and small motions of them.

A motion is a twist (6,): a rotation vector about the frame's origin, rad, then a translation, mm. It is
applied from the left: p -> R(rotation) p + translation.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64


def inverse(T: Float64) -> Float64:
    """Return the inverses of rigid poses (..., 4, 4)."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = R
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", R, T[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def transform_each(T_a_b: Float64, points_b: Float64) -> Float64:
    """Return points (n, 3) of frames b in frame a, each by a pose (n, 4, 4) of its own."""
    return np.asarray(np.einsum("nij,nj->ni", T_a_b[:, :3, :3], points_b) + T_a_b[:, :3, 3])


def motions(twists: Float64) -> Float64:
    """Return the poses (n, 4, 4) of twists (n, 6)."""
    T = np.tile(np.eye(4), (len(twists), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    T[:, :3, 3] = twists[:, 3:]
    return T


def twists(T: Float64) -> Float64:
    """Return the twists (n, 6) of poses (n, 4, 4)."""
    return np.column_stack([Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), T[:, :3, 3]])


def adjoints(T_a_b: Float64) -> Float64:
    """Return the matrices (n, 6, 6) that take a small motion in frame b to the same one in frame a."""
    R, t = T_a_b[:, :3, :3], T_a_b[:, :3, 3]
    result = np.zeros((len(t), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = R
    result[:, 3:, :3] = cross_matrices(t) @ R
    return result


def cross_matrices(vectors: Float64) -> Float64:
    """Return the matrices (n, 3, 3) whose product with a vector is the cross product of (n, 3) with it."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def mean_pose(T: Float64) -> Float64:
    """Return the mean (4, 4) of poses (n, 4, 4): rotations by their chords, places by their coordinates."""
    mean = np.eye(4)
    mean[:3, :3] = Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix()
    mean[:3, 3] = T[:, :3, 3].mean(axis=0)
    return mean
