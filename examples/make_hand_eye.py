"""Draw pictures of a chessboard from a robot's hand, and its poses: python examples/make_hand_eye.py FOLDER.

The camera is that of examples/v_groove in its tool. The board lies on a table, and the robot shows it to
the camera from nine sides. Its true poses are off the reported ones by its repeatability. `poses.csv`
holds the reported ones as KUKA writes them, beside the images' names. Nothing here is arctrack's own.
`truth.txt` says what was drawn.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from make_boards import Array, Camera, Chessboard, draw, turned
from make_laser_boards import CAMERA_IN_TOOL_MM, CAMERA_IN_TOOL_XYZW, rotation

CAMERA = Camera(640, 480, 2190.0, 2190.0, 319.5, 239.5)
BOARD = Chessboard(9, 6, 4.0)

BOARD_IN_BASE_MM = np.array([820.0, -140.0, 60.0])
BOARD_TURN = turned(180.0, 4.0, 25.0)
"""Where the board's first corner lies in base, and how: its z points away from who looks at it."""

REPEATABILITY_MM, REPEATABILITY_DEG = 0.05, 0.01

VIEWS = (
    (0.50, 0.50, 185, 0, 0, 0),
    (0.45, 0.55, 190, 25, 5, 20),
    (0.55, 0.45, 195, -25, 0, -25),
    (0.50, 0.52, 190, 0, 28, 45),
    (0.48, 0.50, 200, 5, -28, -50),
    (0.52, 0.48, 185, 20, 20, 80),
    (0.50, 0.50, 195, -20, 20, -80),
    (0.53, 0.50, 200, -20, -20, 30),
    (0.50, 0.50, 190, -10, 30, 120),
)
"""Where the board's middle is in the image (shares), how far away, mm, and how it is turned, deg."""


def rigid(R: Array, t: Array) -> Array:
    """Return the pose (4, 4) of a rotation and a translation, mm."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def board_in_camera(x: float, y: float, depth_mm: float, *angles: float) -> Array:
    """Return the pose of a board that is held as `VIEWS` say."""
    R = turned(*angles)
    ray = [(x * CAMERA.width - CAMERA.cx) / CAMERA.fx, (y * CAMERA.height - CAMERA.cy) / CAMERA.fy, 1.0]
    middle = np.array([0.5 * BOARD.span_mm[0], 0.5 * BOARD.span_mm[1], 0.0])
    return rigid(R, depth_mm * np.array(ray) - R @ middle)


def kuka_deg(R: Array) -> tuple[float, float, float]:
    """Return A, B, C: R = Rz(A) Ry(B) Rx(C)."""
    a, c = np.arctan2(R[1, 0], R[0, 0]), np.arctan2(R[2, 1], R[2, 2])
    b = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    return float(np.degrees(a)), float(np.degrees(b)), float(np.degrees(c))


def main(folder: Path) -> None:
    """Draw the pictures, and write the poses."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)
    T_tool_camera = rigid(rotation(*CAMERA_IN_TOOL_XYZW), CAMERA_IN_TOOL_MM)
    T_base_board = rigid(BOARD_TURN, BOARD_IN_BASE_MM)
    rows = ["file,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg"]
    for n, view in enumerate(VIEWS):
        T_camera_board = board_in_camera(*map(float, view))
        true = T_base_board @ np.linalg.inv(T_camera_board) @ np.linalg.inv(T_tool_camera)
        error = np.radians(REPEATABILITY_DEG) * rng.standard_normal(3)
        off = rigid(np.asarray(cv2.Rodrigues(error)[0]), REPEATABILITY_MM * rng.standard_normal(3))
        reported = true @ off
        name = f"board_{n:02d}.png"
        numbers = (*reported[:3, 3], *kuka_deg(reported[:3, :3]))
        rows.append(",".join([name, *(f"{number:.4f}" for number in numbers)]))
        picture = draw(CAMERA, BOARD, T_camera_board[:3, :3], T_camera_board[:3, 3], rng)
        cv2.imwrite(str(folder / name), picture)
    (folder / "poses.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    truth = f"{CAMERA}\n{BOARD}\ncamera in tool: {CAMERA_IN_TOOL_MM} mm, {CAMERA_IN_TOOL_XYZW}\n"
    (folder / "truth.txt").write_text(truth, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
