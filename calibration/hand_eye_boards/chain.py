"""Board pose in the camera from the robot's poses, and its derivatives.

*holder* is what carries the camera: the tool (eye in hand), or base (eye to hand). *mount* is what the
board is fixed to: base, or the tool. The robot's pose is off by a small motion xi in the tool's frame:

    eye in hand   T_camera_board = T_holder_camera^-1 exp(-xi) T_base_tool^-1 T_mount_board
    eye to hand   T_camera_board = T_holder_camera^-1 T_base_tool exp(xi) T_mount_board
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.rigid import adjoints, inverse, motions
from noise_model.compiled.arrays import Float64


@dataclass(frozen=True)
class Chain:
    """The two unknown poses between the robot's poses and the board's.

    `T_base_tool` (V, 4, 4) is as the controller reports it, mm. `T_holder_camera` (4, 4) is the camera in the
    tool, `T_mount_board` (4, 4) the board in base; eye to hand, the camera is in base and the board in the
    tool.
    """

    T_base_tool: Float64
    T_holder_camera: Float64
    T_mount_board: Float64
    is_eye_to_hand: bool

    @property
    def T_holder_mount(self) -> Float64:
        """The robot's pose (V, 4, 4) from what the board is fixed to, to what carries the camera."""
        return self.T_base_tool if self.is_eye_to_hand else inverse(self.T_base_tool)

    @property
    def T_camera_board(self) -> Float64:
        """The board's pose (V, 4, 4) in the camera, mm, of a robot that is where it says."""
        return np.asarray(inverse(self.T_holder_camera) @ self.T_holder_mount @ self.T_mount_board)

    def per_unknown(self) -> Float64:
        """Return derivatives (V, 6, 12) of the board's motion in the camera by the two poses' own motions."""
        T = self.T_camera_board
        return np.concatenate([np.tile(-np.eye(6), (len(T), 1, 1)), adjoints(T)], axis=2)

    def per_robot_error(self) -> Float64:
        """Return derivatives (V, 6, 6) of the board's motion in the camera by xi."""
        T_camera_holder = inverse(self.T_holder_camera)
        if self.is_eye_to_hand:
            return adjoints(T_camera_holder @ self.T_base_tool)
        return np.tile(-adjoints(T_camera_holder[np.newaxis]), (len(self.T_base_tool), 1, 1))

    def moved(self, step: Float64) -> Chain:
        """Return the chain with both poses moved in their own frames, by (12,)."""
        camera, board = motions(step.reshape(2, 6))
        return replace(
            self, T_holder_camera=self.T_holder_camera @ camera, T_mount_board=self.T_mount_board @ board
        )

    def select_views(self, chosen: list[int]) -> Chain:
        """Return the chain of some of the robot's poses."""
        return replace(self, T_base_tool=self.T_base_tool[chosen])
