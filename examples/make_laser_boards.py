"""Draw pairs of pictures of a chessboard, without and with a laser stripe: make_laser_boards.py FOLDER.

Camera and sheet are those of examples/v_groove: the sheet stands upright, 35 mm ahead of the tool, and fans
out from 140 mm above it. Its light falls off across the sheet as a Gaussian, ends where the fan ends, and is
reflected as room light is. Two more pictures show a board and the stripe at once. Nothing here is arctrack's
own.
`truth.txt` in the folder says what was drawn.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from make_boards import BLUR_PX, NOISE_E_PER_DN, SAMPLES, Array, Camera, Chessboard, draw, rays, turned

CAMERA = Camera(640, 480, 2190.0, 2190.0, 319.5, 239.5)
BOARD = Chessboard(8, 6, 2.5)

CAMERA_IN_TOOL_MM = np.array([95.0, 0.0, 130.0])
CAMERA_IN_TOOL_XYZW = (0.691123398934, -0.691123398934, -0.149493971269, 0.149493971269)
SHEET_IN_TOOL = np.array([1.0, 0.0, 0.0, -35.0])
"""The sheet n.p + d = 0, mm."""

ORIGIN_IN_TOOL_MM = np.array([35.0, 0.0, 140.0])

FAN_HALF_ANGLE_DEG = 3.0

SHEET_SIGMA_MM, STRIPE_DN, ROOM_LIGHT = 0.25, 90.0, 0.5
"""1 sigma of half the sheet's thickness at tool height, the stripe's peak on white there, room light over
make_boards'.
"""

POSES = (
    (-8.0, 2.5, 0, 0, 0),
    (-4.0, 0.0, 20, 10, 10),
    (0.0, 0.0, -20, 5, -20),
    (4.0, 0.0, 10, -15, 30),
    (8.0, 2.5, 0, 0, 5),
    (12.0, -2.5, -15, -10, -10),
    (-12.0, 0.0, 15, 15, 20),
    (2.0, 1.25, 25, -5, 90),
    (6.0, 1.25, -10, 10, 15),
    (-6.0, 2.5, 10, -10, -5),
)
"""The board's middle in the sheet: how high over the tool's origin, how far aside, mm; the turns, deg."""

WITH_BOTH = 2
"""Of so many at the end there is no picture without the laser."""


def rotation(x: float, y: float, z: float, w: float) -> Array:
    """Return the rotation of a unit quaternion."""
    axis = np.array([x, y, z])
    length = float(np.linalg.norm(axis))
    return np.asarray(cv2.Rodrigues(2.0 * np.arctan2(length, w) * axis / length)[0])


def with_stripe(picture: Array, R_tool_camera: Array, R: Array, t: Array, rng: np.random.Generator) -> Array:
    """Return a picture of a board at R and t with the stripe on it."""
    directions = rays(CAMERA)
    normal = R[:, 2]
    points = directions * (normal @ t / np.tensordot(normal, directions, axes=1))
    in_tool = np.tensordot(R_tool_camera, points, axes=1) + CAMERA_IN_TOOL_MM[:, None, None]
    off_mm = np.tensordot(SHEET_IN_TOOL[:3], in_tool, axes=1) + SHEET_IN_TOOL[3]
    away = in_tool - ORIGIN_IN_TOOL_MM[:, None, None]
    depth = -away[2]
    sigma_mm = SHEET_SIGMA_MM * depth / ORIGIN_IN_TOOL_MM[2]
    light = np.exp(-0.5 * (off_mm / sigma_mm) ** 2) * (ORIGIN_IN_TOOL_MM[2] / depth) ** 2
    light *= np.abs(away[1]) <= np.tan(np.radians(FAN_HALF_ANGLE_DEG)) * depth
    light = light.reshape(CAMERA.height, SAMPLES, CAMERA.width, SAMPLES).mean(axis=(1, 3))
    light = cv2.GaussianBlur(light, (0, 0), BLUR_PX)
    reflected = picture / (ROOM_LIGHT * 180.0) * STRIPE_DN * light
    return np.asarray(picture + rng.poisson(reflected * NOISE_E_PER_DN) / NOISE_E_PER_DN)


def main(folder: Path) -> None:
    """Draw the pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(6)
    R_tool_camera = rotation(*CAMERA_IN_TOOL_XYZW)
    middle_of_board = np.array([0.5 * BOARD.span_mm[0], 0.5 * BOARD.span_mm[1], 0.0])
    for n, (height_mm, aside_mm, *angles) in enumerate(POSES):
        middle = R_tool_camera.T @ (np.array([35.0, aside_mm, height_mm]) - CAMERA_IN_TOOL_MM)
        R = turned(*map(float, angles))
        t = middle - R @ middle_of_board
        off, room = (draw(CAMERA, BOARD, R, t, rng, ROOM_LIGHT) for _ in range(2))
        lit = with_stripe(room.astype(np.float64), R_tool_camera, R, t, rng)
        on = lit.clip(0, 255).round().astype(np.uint8)
        if n < len(POSES) - WITH_BOTH:
            cv2.imwrite(str(folder / f"board_{n:02d}.png"), off)
        cv2.imwrite(str(folder / f"laser_{n:02d}.png"), on)
    (folder / "truth.txt").write_text(
        f"{CAMERA}\n{BOARD}\nsheet in tool: {SHEET_IN_TOOL}, from {ORIGIN_IN_TOOL_MM} mm, "
        f"{FAN_HALF_ANGLE_DEG} deg to either side, sigma {SHEET_SIGMA_MM} mm\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
