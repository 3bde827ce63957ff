"""Draw pictures of a chessboard to calibrate a camera with: python examples/make_boards.py FOLDER.

Each pixel is the mean of samples whose rays are cast onto a bent board. Blur, photon noise, rounding follow.
Nothing here is arctrack's own. `truth.txt` in the folder says what was drawn.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

WHITE, BLACK, OUTSIDE = 180.0, 25.0, 110.0
"""Grey levels of the board and of what lies around it."""

BLUR_PX, NOISE_E_PER_DN = 0.7, 60.0
SAMPLES = 3
"""Samples of a pixel along each axis."""

MAX_ROUNDS, UNDISTORTED = 100, 1e-10
BEND_ROUNDS = 4
"""Rounds by which a ray meets the bent board: each is nearer by the bend's slope, some hundredths."""


@dataclass(frozen=True)
class Camera:
    """OpenCV's camera: size and focal lengths in px, radial and tangential distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


@dataclass(frozen=True)
class Chessboard:
    """Inner corners along x and y, a square's side, mm, and how far bending each way lifts the middle, mm."""

    columns: int
    rows: int
    square_mm: float
    warp_mm: tuple[float, float] = (0.0, 0.0)

    @property
    def span_mm(self) -> tuple[float, float]:
        """From the first inner corner to the last, mm."""
        return (self.columns - 1) * self.square_mm, (self.rows - 1) * self.square_mm

    def height_mm(self, x: Array, y: Array) -> Array:
        """Return how high the bent board is."""
        a, b = (2.0 * along / span - 1.0 for along, span in zip((x, y), self.span_mm, strict=True))
        return self.warp_mm[0] * (1.0 - a * a) + self.warp_mm[1] * (1.0 - b * b)


def undistorted(camera: Camera, u: Array, v: Array) -> tuple[Array, Array]:
    """Return the rays (x, y, 1) of image points: OpenCV's distortion, undone by fixed points."""
    to_x, to_y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    x, y = to_x, to_y
    for _ in range(MAX_ROUNDS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
        off_x = 2.0 * camera.p1 * x * y + camera.p2 * (r2 + 2.0 * x * x)
        off_y = camera.p1 * (r2 + 2.0 * y * y) + 2.0 * camera.p2 * x * y
        before, x, y = x, (to_x - off_x) / radial, (to_y - off_y) / radial
        if np.abs(x - before).max() < UNDISTORTED:
            break
    return x, y


@cache
def rays(camera: Camera) -> Array:
    """Return the rays (3, H, W) of all samples of an image."""
    u, v = ((np.arange(size * SAMPLES) + 0.5) / SAMPLES - 0.5 for size in (camera.width, camera.height))
    return np.stack([*undistorted(camera, *np.meshgrid(u, v)), np.ones((len(v), len(u)))])


def draw(
    camera: Camera, board: Chessboard, R: Array, t: Array, rng: np.random.Generator, light: float = 1.0
) -> npt.NDArray[np.uint8]:
    """Return a picture of the board; R and t take its points, mm, to the camera."""
    # In the board's frame a ray starts at the camera's centre and meets z = height.
    eye, direction = -R.T @ t, np.tensordot(R.T, rays(camera), axes=1)
    height = np.zeros(direction.shape[1:])
    for _ in range(BEND_ROUNDS if any(board.warp_mm) else 1):
        reach = (height - eye[2]) / direction[2]
        x, y = eye[0] + reach * direction[0], eye[1] + reach * direction[1]
        height = board.height_mm(x, y)
    column, row = np.floor(x / board.square_mm), np.floor(y / board.square_mm)
    margin = 0.4 * board.square_mm
    on_board = (np.abs(x - 0.5 * board.span_mm[0]) < 0.5 * board.span_mm[0] + board.square_mm + margin) & (
        np.abs(y - 0.5 * board.span_mm[1]) < 0.5 * board.span_mm[1] + board.square_mm + margin
    )
    on_square = (column >= -1) & (column < board.columns) & (row >= -1) & (row < board.rows)
    level = np.where(on_square & ((column + row) % 2 == 0), BLACK, np.where(on_board, WHITE, OUTSIDE))
    level = level.reshape(camera.height, SAMPLES, camera.width, SAMPLES).mean(axis=(1, 3))
    level = light * cv2.GaussianBlur(level, (0, 0), BLUR_PX)
    noisy = rng.poisson(level * NOISE_E_PER_DN) / NOISE_E_PER_DN
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def turned(about_x_deg: float, about_y_deg: float, about_z_deg: float) -> Array:
    """Return the rotation by these angles, about z first."""
    R = np.eye(3)
    for axis, angle in ((2, about_z_deg), (1, about_y_deg), (0, about_x_deg)):
        R = cv2.Rodrigues(np.radians(angle) * np.eye(3)[axis])[0] @ R
    return R


def held(camera: Camera, board: Chessboard, R: Array, place: tuple[float, float], share: float) -> Array:
    """Return the translation, mm, that puts the board's middle at a place of the image (shares of its size).

    `share` is how much of the image's height the board's longer side takes.
    """
    depth = camera.fx * max(board.span_mm) / (share * camera.height)
    ray = np.array(
        [
            (place[0] * camera.width - camera.cx) / camera.fx,
            (place[1] * camera.height - camera.cy) / camera.fy,
            1.0,
        ]
    )
    return depth * ray - R @ np.array([0.5 * board.span_mm[0], 0.5 * board.span_mm[1], 0.0])


CAMERA = Camera(640, 480, 2186.0, 2190.0, 325.5, 236.0, k1=-0.35)
BOARD = Chessboard(9, 6, 4.0, (0.06, -0.04))

POSES = (
    (0.50, 0.50, 0.75, 35, 0, 0),
    (0.27, 0.30, 0.45, 0, 35, 8),
    (0.73, 0.30, 0.45, 5, -40, -8),
    (0.27, 0.70, 0.45, -40, 5, 0),
    (0.73, 0.70, 0.45, 30, 30, 5),
    (0.50, 0.27, 0.45, -35, 20, 175),
    (0.50, 0.73, 0.45, 25, -30, 0),
    (0.28, 0.50, 0.50, 0, 0, 90),
    (0.72, 0.50, 0.50, -20, -40, -90),
    (0.50, 0.50, 0.60, -30, 30, 20),
    (0.30, 0.33, 0.50, 40, -10, 30),
    (0.70, 0.67, 0.50, -10, 40, -25),
    (0.30, 0.67, 0.50, 20, 40, 15),
    (0.70, 0.33, 0.50, -40, -20, 0),
)
"""Where the board's middle is, how large it is, and how it is turned about x, y and z, deg."""


def main(folder: Path, camera: Camera = CAMERA) -> None:
    """Draw the pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    for n, (x, y, share, *angles) in enumerate(POSES):
        R = turned(*map(float, angles))
        picture = draw(camera, BOARD, R, held(camera, BOARD, R, (x, y), share), rng)
        cv2.imwrite(str(folder / f"board_{n:02d}.png"), picture)
    (folder / "truth.txt").write_text(f"{camera}\n{BOARD}\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
