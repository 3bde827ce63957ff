"""By how much robot and board turn between two images: the same, wherever camera and board are."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from noise_model.arrays import Float64


def angle_mismatch_deg(T_base_tool: Float64, T_camera_board: Float64) -> float:
    """Return the median difference of the turns of robot and board between two images, deg.

    Camera and board are turned in what carries them: a change of axes, which leaves an angle as it is (Tsai
    and Lenz, A new technique for fully autonomous and efficient 3D robotics hand/eye calibration, 1989).

    Parameters
    ----------
    T_base_tool, T_camera_board : array (V, 4, 4)
        The robot's poses and the board's.
    """
    first, second = np.triu_indices(len(T_base_tool), 1)
    angles = []
    for T in (T_base_tool, T_camera_board):
        turns = Rotation.from_matrix(T[:, :3, :3])
        angles.append((turns[first] * turns[second].inv()).magnitude())
    return float(np.degrees(np.median(np.abs(angles[0] - angles[1]))))
