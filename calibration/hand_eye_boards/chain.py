"""Board pose in the camera from the robot's poses, and its derivatives.

*holder* is what carries the camera: the tool (eye in hand), or base (eye to hand). *mount* is what the
board is fixed to: base, or the tool. The robot's pose is off by a small motion xi in the tool's frame:

    eye in hand   T_camera_board = T_holder_camera^-1 exp(-xi) T_base_tool^-1 T_mount_board
    eye to hand   T_camera_board = T_holder_camera^-1 T_base_tool exp(xi) T_mount_board
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.rigid import adjoints, inverse, motions
from noise_model.compiled.arrays import Float64

POSES = 12
"""The motions of camera and board come first among the unknowns."""


@dataclass(frozen=True)
class Chain:
    """The two unknown poses between the robot's poses and the board's.

    `T_base_tool` (V, 4, 4) is as the controller reports it, mm. `T_holder_camera` (4, 4) is the camera in the
    tool, `T_mount_board` (4, 4) the board in base; eye to hand, the camera is in base and the board in the
    tool. A pose has a repeatable error, too: the small motion of the tool `per_coefficient` times
    `coefficients` (k,), rad and mm. The blocks (V, 6, k_b) of `repeatable` are its derivatives; the
    coefficients of each have a prior about 0 with one sigma.
    """

    T_base_tool: Float64
    T_holder_camera: Float64
    T_mount_board: Float64
    is_eye_to_hand: bool
    repeatable: tuple[Float64, ...] = ()
    coefficients: Float64 = field(default_factory=lambda: np.zeros(0))

    @property
    def per_coefficient(self) -> Float64:
        """Derivatives (V, 6, k) of the tool's motion by the coefficients of the repeatable error."""
        return np.concatenate([np.zeros((len(self.T_base_tool), 6, 0)), *self.repeatable], axis=2)

    @property
    def T_base_tool_corrected(self) -> Float64:
        """The robot's poses (V, 4, 4) without their repeatable error."""
        return np.asarray(self.T_base_tool @ motions(self.per_coefficient @ self.coefficients))

    @property
    def T_holder_mount(self) -> Float64:
        """The robot's pose (V, 4, 4) from what the board is fixed to, to what carries the camera."""
        T = self.T_base_tool_corrected
        return T if self.is_eye_to_hand else inverse(T)

    @property
    def T_camera_board(self) -> Float64:
        """The board's pose (V, 4, 4) in the camera, mm, of a robot that is where it says."""
        return np.asarray(inverse(self.T_holder_camera) @ self.T_holder_mount @ self.T_mount_board)

    def per_unknown(self) -> Float64:
        """Return derivatives (V, 6, 12 + k) of the board's motion in the camera.

        They are by the two poses' own motions, and by the coefficients of the repeatable error.
        """
        T = self.T_camera_board
        by_robot = self.per_robot_error() @ self.per_coefficient
        return np.concatenate([np.tile(-np.eye(6), (len(T), 1, 1)), adjoints(T), by_robot], axis=2)

    def per_robot_error(self) -> Float64:
        """Return derivatives (V, 6, 6) of the board's motion in the camera by xi."""
        T_camera_holder = inverse(self.T_holder_camera)
        if self.is_eye_to_hand:
            return adjoints(T_camera_holder @ self.T_base_tool_corrected)
        return np.tile(-adjoints(T_camera_holder[np.newaxis]), (len(self.T_base_tool), 1, 1))

    def moved(self, step: Float64) -> Chain:
        """Return the chain with both poses moved in their own frames, and the coefficients, by (12 + k,)."""
        camera, board = motions(step[:POSES].reshape(2, 6))
        return replace(
            self,
            T_holder_camera=self.T_holder_camera @ camera,
            T_mount_board=self.T_mount_board @ board,
            coefficients=self.coefficients + step[POSES:],
        )

    def select_views(self, chosen: list[int]) -> Chain:
        """Return the chain of some of the robot's poses."""
        blocks = tuple(block[chosen] for block in self.repeatable)
        return replace(self, T_base_tool=self.T_base_tool[chosen], repeatable=blocks)

    def with_repeatable(self, blocks: Sequence[Float64]) -> Chain:
        """Return the chain with a repeatable error whose coefficients are 0."""
        count = sum(block.shape[2] for block in blocks)
        return replace(self, repeatable=tuple(blocks), coefficients=np.zeros(count))
