"""A robot's kinematics from joint angles and the poses that its controller makes of them.

Both come from the controller, so they agree to rounding, whatever the arm's true pose is. With d the angles
less those of a reference station, a_i and p_i the axes and points on them there,

    T = exp(a_1 p_1, d_1) ... exp(a_n p_n, d_n) M

(Brockett, Robotic manipulators and the product of exponentials formula, 1984). Rotations are free of p and
M's place, and their axes begin as the least squares of R = exp(sum a_i d_i) R_0. With the axes known, places
are linear in p and M's.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.camera.enough import UndeterminedError
from calibration.rigid import inverse
from noise_model.compiled.arrays import Float64

MIN_TURN_RAD = math.radians(2.0)
"""RMS angle below which a joint's axis is not known well enough for its offset."""

MAX_OFF_RAD, MAX_OFF_MM = math.radians(0.05), 0.5
"""RMS misfit of poses and joint angles: some ten times what controllers round, a tenth of what offsets do."""

COUPLINGS = (0.0, 1.0, -1.0)
"""Shares of the second angle in the third: controllers state the forearm's by the upper arm, or by base."""


def joint_motions(joint_rad: Float64, T_base_tool: Float64) -> tuple[tuple[int, ...], Float64]:
    """Return joints, and the tool's motions (V, 6, k) by their offsets, rad and mm per rad, in its frame.

    `joint_rad` (V, n) are the angles at the poses (V, 4, 4). Joints count from 1; the first and the last
    are left out, and those that hardly turn. Raises UndeterminedError, which says why, for too few poses, and
    where joint angles and poses contradict each other.
    """
    count, n = joint_rad.shape
    # Rotations have 3 equations a pose, 2 unknowns an axis and 3 of M; one pose more to tell a misfit.
    needed = math.ceil((2 * n + 3) / 3) + 2
    if count < needed:
        raise UndeterminedError(f"{count} poses with joint angles: {needed} at least are needed")
    fits = []
    for share in COUPLINGS:
        angles = joint_rad.copy()
        angles[:, 2] += share * angles[:, 1]
        fits.append(_fit(angles, T_base_tool))
    # Axes that are parallel turn the tool alike with the second angle in the third: places tell.
    best = min(fits, key=lambda fit: fit.off_mm)
    if not best.is_good:
        raise UndeterminedError(
            f"joint angles and poses contradict each other by {math.degrees(best.off_rad):.2g} deg and "
            f"{best.off_mm:.2g} mm (RMS): check their units, and that both are of one moment"
        )
    turns = np.std(joint_rad, axis=0) >= MIN_TURN_RAD
    turns[[0, -1]] = False
    joints = np.flatnonzero(turns)
    return tuple((joints + 1).tolist()), best.per_joint[:, :, joints]


@dataclass(frozen=True)
class _KinematicFit:
    """Kinematics: their misfit (RMS), and the tool's motions (V, 6, n) by each joint."""

    off_rad: float
    off_mm: float
    per_joint: Float64

    @property
    def is_good(self) -> bool:
        return self.off_rad < MAX_OFF_RAD and self.off_mm < MAX_OFF_MM


def _fit(angles: Float64, T_base_tool: Float64) -> _KinematicFit:
    R = Rotation.from_matrix(T_base_tool[:, :3, :3])
    spread = np.linalg.norm(angles - angles.mean(axis=0), axis=1)
    best: tuple[float, Float64, Float64] | None = None
    # The axes of small turns are the start. What is small depends on the reference.
    for reference in np.argsort(spread)[:5].tolist():
        d = angles - angles[reference]
        turned = (R * R[reference].inv()).as_rotvec()
        first = np.linalg.lstsq(d, turned, rcond=1e-3)[0]
        lengths = np.linalg.norm(first, axis=1, keepdims=True)
        axes = np.where(lengths > 0.1, first / np.maximum(lengths, 1e-9), [0.0, 0.0, 1.0])

        def residual(x: Float64, d: Float64 = d) -> Float64:
            axes = x[:-3].reshape(-1, 3)
            axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
            M = Rotation.from_rotvec(x[-3:])
            return np.asarray((_products(axes, d)[-1] * M * R.inv()).as_rotvec().ravel())

        start = np.concatenate([axes.ravel(), R[reference].as_rotvec()])
        result = least_squares(residual, start, x_scale=0.1, max_nfev=60)
        off = math.sqrt(2.0 * float(result.cost) / len(R))
        if best is None or off < best[0]:
            axes = result.x[:-3].reshape(-1, 3)
            best = off, axes / np.linalg.norm(axes, axis=1, keepdims=True), d
        if off < MAX_OFF_RAD:
            break
    assert best is not None
    off_rad, axes, d = best
    return _with_places(off_rad, axes, d, T_base_tool)


def _products(axes: Float64, d: Float64) -> list[Rotation]:
    """Return the rotations (V,) of the joints before each, and of all."""
    products = [Rotation.identity(len(d))]
    for axis, angle in zip(axes, d.T, strict=True):
        products.append(products[-1] * Rotation.from_rotvec(angle[:, np.newaxis] * axis))
    return products


def _with_places(off_rad: float, axes: Float64, d: Float64, T_base_tool: Float64) -> _KinematicFit:
    count, n = d.shape
    before = np.stack([each.as_matrix() for each in _products(axes, d)], axis=1)
    # t = sum over joints of (Q_i - Q_i+1) p_i, and Q_n+1 t_M.
    columns = np.concatenate([*(before[:, :-1] - before[:, 1:]).swapaxes(0, 1), before[:, -1]], axis=-1)
    t = T_base_tool[:, :3, 3]
    solved = np.linalg.lstsq(columns.reshape(-1, 3 * n + 3), t.ravel(), rcond=1e-9)[0]
    off_mm = float(np.sqrt(np.mean(np.sum((columns @ solved - t) ** 2, axis=1))))
    points = solved[:-3].reshape(n, 3)
    to_tool = inverse(T_base_tool)[:, :3, :3]
    motions, placed = [], np.zeros((count, 3))
    for i in range(n):
        turn = before[:, i] @ axes[i]
        on_axis = placed + before[:, i] @ points[i]
        motions.append(np.concatenate([turn, np.cross(turn, t - on_axis)], axis=1))
        placed = placed + (before[:, i] - before[:, i + 1]) @ points[i]
    per_joint = np.stack(motions, axis=2).reshape(count, 2, 3, n)
    return _KinematicFit(
        off_rad, off_mm, np.einsum("vij,vhjn->vhin", to_tool, per_joint).reshape(count, 6, n)
    )
