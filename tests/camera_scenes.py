"""Boards before cameras whose truth is known: their corners, and pictures of them.

The projection is written out from OpenCV's documentation. Nothing here is the estimator's.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calibration.boards.board import Board, BoardKind
from calibration.camera.sightings import BoardView
from noise_model.compiled.arrays import Float64, UInt8

BOARD = Board(BoardKind.CHESSBOARD, 7, 6, 10.0)
SIZE = (800, 600)
LENS = {"fx": 1000.0, "fy": 1003.0, "cx": 410.0, "cy": 290.0, "k1": -0.12, "k2": 0.2}
WARP_MM = np.array([0.15, -0.1])


def project(lens: dict[str, float], points: Float64) -> Float64:
    """Return where points (N, 3) are seen (N, 2), px."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, p1, p2 = (lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2"))
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.column_stack([lens["fx"] * u + lens["cx"], lens["fy"] * v + lens["cy"]])


def bent_board(print_mm: Float64 | float = 0.0) -> Float64:
    """Return the corners of a board that is bent by `WARP_MM`, each off its place by `print_mm` (42, 2)."""
    points = BOARD.points_mm.copy()
    x, y = (2.0 * points[:, n] / points[:, n].max() - 1.0 for n in (0, 1))
    points[:, :2] += print_mm
    points[:, 2] = WARP_MM[0] * (1.0 - x**2) + WARP_MM[1] * (1.0 - y**2)
    return points


@dataclass(frozen=True)
class Held:
    """How a board is held: its middle in the image (shares of its size), its depth and its turns."""

    place: tuple[float, float]
    depth_mm: float
    about_x_deg: float = 0.0
    about_y_deg: float = 0.0
    about_z_deg: float = 0.0


VARIED = tuple(
    Held((0.5 + 0.22 * dx, 0.5 + 0.22 * dy), depth, 35.0 * lean_x, 35.0 * lean_y, spin)
    for dx, dy, depth, lean_x, lean_y, spin in (
        (0, 0, 130, 1, 0, 0),
        (-1, -1, 200, 0, 1, 10),
        (1, -1, 200, 0, -1, -10),
        (-1, 1, 210, -1, 0, 5),
        (1, 1, 210, 1, 1, 0),
        (0, -1, 190, -1, 0.5, 175),
        (0, 1, 180, 0.6, -0.6, 0),
        (-1, 0, 190, 0, 0, 90),
        (1, 0, 190, -0.5, -1, -90),
        (0, 0, 160, -0.7, 0.7, 20),
    )
)
"""Ten boards that determine a lens."""


def pose(held: Held, lens: dict[str, float] = LENS) -> tuple[Rotation, Float64]:
    """Return a board's rotation and translation, mm, in the camera frame."""
    turn = Rotation.from_euler("XYZ", [held.about_x_deg, held.about_y_deg, held.about_z_deg], degrees=True)
    ray = [
        (held.place[0] * SIZE[0] - lens["cx"]) / lens["fx"],
        (held.place[1] * SIZE[1] - lens["cy"]) / lens["fy"],
        1.0,
    ]
    return turn, held.depth_mm * np.array(ray) - turn.apply(bent_board().mean(axis=0))


def views(
    held: tuple[Held, ...] = VARIED,
    sigma_px: float = 0.1,
    seed: int = 1,
    lens: dict[str, float] = LENS,
    print_mm: Float64 | float = 0.0,
) -> list[BoardView]:
    """Return what a camera sees of boards so held."""
    rng = np.random.default_rng(seed)
    points, seen = bent_board(print_mm), []
    for n, each in enumerate(held):
        turn = Rotation.from_euler(
            "XYZ", [each.about_x_deg, each.about_y_deg, each.about_z_deg], degrees=True
        )
        ray = [
            (each.place[0] * SIZE[0] - lens["cx"]) / lens["fx"],
            (each.place[1] * SIZE[1] - lens["cy"]) / lens["fy"],
            1.0,
        ]
        camera = turn.apply(points - points.mean(axis=0)) + each.depth_mm * np.array(ray)
        image = project(lens, camera)
        seen.append(
            BoardView(f"{n}", np.arange(len(image)), image + sigma_px * rng.standard_normal(image.shape))
        )
    return seen


SAMPLES = 3
"""Samples of a pixel along each axis."""


def picture(homography: Float64, size: tuple[int, int], seed: int = 1) -> UInt8:
    """Return a picture of a flat chessboard: each pixel is the mean of samples of the board's plane.

    `homography` (3, 3) takes places on the board, mm, to the image, px.
    """
    u, v = ((np.arange(size[n] * SAMPLES) + 0.5) / SAMPLES - 0.5 for n in (0, 1))
    x, y, w = (a * u + (b * v + c)[:, np.newaxis] for a, b, c in np.linalg.inv(homography))
    column, row = (np.floor(along / w / BOARD.square_mm) for along in (x, y))
    inside = (column >= -1) & (column < BOARD.columns) & (row >= -1) & (row < BOARD.rows)
    level = np.where(inside & ((column + row) % 2 == 0), 40.0, 200.0)
    level = level.reshape(size[1], SAMPLES, size[0], SAMPLES).mean(axis=(1, 3))
    noise = np.random.default_rng(seed).normal(0.0, 1.0, level.shape)
    return (cv2.GaussianBlur(level, (0, 0), 0.7) + noise).clip(0, 255).astype(np.uint8)


def picture_of(held: Held, lens: dict[str, float]) -> UInt8:
    """Return a picture of the flat board, held so, through a lens without distortion."""
    turn, move = pose(held, lens)
    matrix = np.array([[lens["fx"], 0.0, lens["cx"]], [0.0, lens["fy"], lens["cy"]], [0.0, 0.0, 1.0]])
    columns = turn.as_matrix()
    return picture(matrix @ np.column_stack([columns[:, 0], columns[:, 1], move]), SIZE)
