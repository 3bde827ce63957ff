"""A robot that shows a board to a camera, or a camera to a board; its poses, corners and pictures.

Board, camera and projection are those of `camera_scenes`. Nothing here is the estimator's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from camera_scenes import BOARD, LENS, SIZE, Held, bent_board, project
from scipy.spatial.transform import Rotation

from calibration.boards.board import Board
from calibration.camera.lens import Lens
from calibration.camera.sightings import BoardView
from noise_model.compiled.arrays import Float64

TRUE_LENS = Lens(*SIZE, tuple(LENS), np.array([*LENS.values()]))

ROBOT_MM, ROBOT_DEG, CORNER_PX = 0.05, 0.02, 0.05

HELD = tuple(
    Held((0.5 + dx, 0.5 - dx), 170.0 + 15.0 * (n % 3), lean_x, lean_y, spin)
    for n, (dx, lean_x, lean_y, spin) in enumerate(
        (
            (0.0, 0.0, 0.0, 0.0),
            (0.05, 30.0, 5.0, 20.0),
            (-0.05, -30.0, 0.0, -30.0),
            (0.02, 0.0, 32.0, 60.0),
            (-0.02, 5.0, -32.0, -70.0),
            (0.04, 22.0, 22.0, 90.0),
            (-0.04, -22.0, 22.0, 10.0),
            (0.0, 22.0, -22.0, -15.0),
            (0.03, -22.0, -22.0, 130.0),
        )
    )
)
"""How the board stands before the camera in nine images."""


def rigid(turn: Rotation, place_mm: Float64) -> Float64:
    """Return the pose (4, 4) of a rotation and a translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), place_mm
    return T


T_HOLDER_CAMERA = rigid(
    Rotation.from_euler("xyz", [150, 10, 80], degrees=True), np.array([90.0, 10.0, 120.0])
)
T_MOUNT_BOARD = rigid(Rotation.from_euler("xyz", [170, -5, 25], degrees=True), np.array([700.0, 40.0, -20.0]))


def board_in_camera(held: Held) -> Float64:
    """Return a board's pose (4, 4) in the camera."""
    turn = Rotation.from_euler("XYZ", [held.about_x_deg, held.about_y_deg, held.about_z_deg], degrees=True)
    ray = [
        (held.place[0] * SIZE[0] - LENS["cx"]) / LENS["fx"],
        (held.place[1] * SIZE[1] - LENS["cy"]) / LENS["fy"],
        1.0,
    ]
    return rigid(turn, held.depth_mm * np.array(ray) - turn.apply(BOARD.points_mm.mean(axis=0)))


@dataclass(frozen=True)
class Shown:
    """The robot's poses (V, 4, 4) as reported, and the corners in each image."""

    T_base_tool: Float64
    views: list[BoardView]


def shown(
    boards: list[Float64] | None = None,
    *,
    is_eye_to_hand: bool = False,
    noise: float = 1.0,
    seed: int = 1,
    board: Board = BOARD,
) -> Shown:
    """Return what is seen of boards at poses in the camera; `noise` scales that of robot and corners."""
    rng = np.random.default_rng(seed)
    boards = [board_in_camera(held) for held in HELD] if boards is None else boards
    points = bent_board() if board is BOARD else board.points_mm
    poses, views = [], []
    for n, T_camera_board in enumerate(boards):
        T_holder_mount = T_HOLDER_CAMERA @ T_camera_board @ np.linalg.inv(T_MOUNT_BOARD)
        T_base_tool = T_holder_mount if is_eye_to_hand else np.linalg.inv(T_holder_mount)
        turn_deg, move_mm = (
            noise * ROBOT_DEG * rng.standard_normal(3),
            noise * ROBOT_MM * rng.standard_normal(3),
        )
        poses.append(T_base_tool @ rigid(Rotation.from_rotvec(turn_deg, degrees=True), move_mm))
        image = project(LENS, points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])
        image = image + noise * CORNER_PX * rng.standard_normal(image.shape)
        views.append(BoardView(f"{n}", np.arange(len(image)), image))
    return Shown(np.array(poses), views)


def off(T_holder_camera: Float64) -> Float64:
    """Return by what motion (6,) in its own frame a camera is off the true one, deg and mm."""
    T = np.linalg.inv(T_holder_camera) @ T_HOLDER_CAMERA
    return np.array([*Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True), *T[:3, 3]])
