"""Test of equal rotations of robot and board between two images, without positions and their unit."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64


def turn_mismatch_deg(T_holder_mount: Float64, T_camera_board: Float64) -> float:
    """Return the median difference of robot and board rotations between two images, deg.

    Their rotation vectors differ by one rotation only, that of the camera in its holder (Park and Martin,
    Robot sensor calibration: solving AX = XB on the Euclidean group, 1994). It is fitted to all pairs, and
    then to the half that agrees best: a pose of another image spoils some of them. `T_holder_mount` (V, 4, 4)
    is as in `Chain`.
    """
    first, second = np.triu_indices(len(T_holder_mount), 1)
    robot, board = (
        (turns[first] * turns[second].inv()).as_rotvec(degrees=True)
        for turns in (Rotation.from_matrix(T[:, :3, :3]) for T in (T_holder_mount, T_camera_board))
    )
    agree = np.full(len(first), True)
    for _ in range(2):
        camera = Rotation.align_vectors(board[agree], robot[agree])[0]
        off = np.linalg.norm(board - camera.apply(robot), axis=1)
        agree = off <= np.median(off)
    return float(np.median(off))
