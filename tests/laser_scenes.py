"""Boards with a laser stripe before a camera whose truth is known: corners and points, and pictures.

The boards are those of `camera_scenes`. Nothing here is the estimator's.
"""

from __future__ import annotations

import numpy as np
from camera_scenes import BOARD, SIZE, Held, picture_of, pose, project
from scipy.spatial.transform import Rotation

from calibration.camera.sightings import BoardView
from calibration.laser.plane import LaserStand
from calibration.laser.stripe import BoardStripe
from noise_model.compiled.arrays import Float64, UInt8

PINHOLE = {"fx": 1000.0, "fy": 1003.0, "cx": 410.0, "cy": 290.0}
PLANE = np.array([np.cos(0.4), 0.0, np.sin(0.4), -175.0 * np.sin(0.4)])
"""The sheet n.X + d = 0, mm, in the camera frame."""

_AHEAD = np.array([-np.sin(0.4), 0.0, np.cos(0.4)])
STAND = LaserStand(np.array([0.0, 0.0, 175.0]) - 175.0 * _AHEAD, -_AHEAD)
"""The laser stands as far off the boards as the camera does."""

SHEET_SIGMA_MM, STRIPE_DN = 0.25, 100.0

BOARDS = (
    Held((0.5, 0.5), 155.0, 0.0, 0.0, 0.0),
    Held((0.52, 0.48), 175.0, 20.0, -10.0, 10.0),
    Held((0.48, 0.5), 195.0, -20.0, 0.0, 80.0),
    Held((0.5, 0.52), 185.0, 10.0, 20.0, -30.0),
    Held((0.52, 0.5), 165.0, -15.0, -15.0, 40.0),
)
"""Five boards that determine the sheet."""

LEVEL = tuple(Held((0.5, 0.5), 175.0, about_z_deg=turn) for turn in (0.0, 20.0, 40.0, 60.0))
"""Boards that are all at one height: their stripes lie on one line."""


def flat_pose(held: Held) -> tuple[Rotation, Float64]:
    """Return a flat board's rotation and translation, mm, in the camera frame."""
    return pose(held, PINHOLE)


def views(boards: tuple[Held, ...] = BOARDS, sigma_px: float = 0.05, seed: int = 1) -> list[BoardView]:
    """Return the corners of boards."""
    rng, seen = np.random.default_rng(seed), []
    for n, held in enumerate(boards):
        turn, move = flat_pose(held)
        image = project(PINHOLE, turn.apply(BOARD.points_mm) + move)
        seen.append(
            BoardView(f"{n}", np.arange(len(image)), image + sigma_px * rng.standard_normal(image.shape))
        )
    return seen


def stripe_points(held: Held, bow: float = 0.0) -> Float64:
    """Return 200 points (n, 3), mm, of the stripe's middle on a board, camera frame."""
    turn, move = flat_pose(held)
    m, middle = turn.apply([0.0, 0.0, 1.0]), turn.apply(BOARD.points_mm.mean(axis=0)) + move
    along = np.cross(PLANE[:3], m)
    along /= np.linalg.norm(along)
    # The point of the line that is nearest to the board's middle.
    rows, right = np.stack([PLANE[:3], m, along]), np.array([-PLANE[3], m @ middle, along @ middle])
    points = np.linalg.solve(rows, right) + np.linspace(-22.0, 22.0, 200)[:, np.newaxis] * along
    # Across the line, on the board, to where the sheet is off its plane.
    across, line = np.cross(m, along), points
    for _ in range(5):
        away, side = points - STAND.origin_mm, np.array([0.0, 1.0, 0.0])
        rise = bow * (away @ side) ** 2 / -(away @ STAND.up)
        points = line + np.outer(rise / (PLANE[:3] @ across), across)
    return np.asarray(points)


def stripes(
    boards: tuple[Held, ...] = BOARDS,
    sigma_px: float = 0.2,
    wrong_share: float = 0.0,
    seed: int = 2,
    bow: float = 0.0,
) -> dict[str, BoardStripe]:
    """Return the stripes of boards, upright in the image; some of their points may be wrong."""
    rng, seen = np.random.default_rng(seed), {}
    for n, held in enumerate(boards):
        image = project(PINHOLE, stripe_points(held, bow))
        image = image[np.argsort(image[:, 1])]
        image[:, 0] += sigma_px * rng.standard_normal(len(image))
        wrong = rng.random(len(image)) < wrong_share
        image[wrong, 0] += rng.uniform(3.0, 15.0, wrong.sum())
        seen[f"{n}"] = BoardStripe(image, along_rows=False, scale_px=1.5)
    return seen


def pictures(held: Held, seed: int, flicker: float = 1.0, *, with_laser: bool = True) -> tuple[UInt8, UInt8]:
    """Return a board's picture without the laser and with it; room light differs by a factor."""
    room = 0.6 * picture_of(held, PINHOLE)
    turn, move = flat_pose(held)
    m = turn.apply([0.0, 0.0, 1.0])
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([(u - PINHOLE["cx"]) / PINHOLE["fx"], (v - PINHOLE["cy"]) / PINHOLE["fy"], 1.0 + 0.0 * u])
    points = rays * (m @ move) / np.tensordot(m, rays, axes=1)
    off_mm = np.tensordot(PLANE[:3], points, axes=1) + PLANE[3]
    laser = STRIPE_DN * np.exp(-0.5 * (off_mm / SHEET_SIGMA_MM) ** 2) * room / room.max() * with_laser
    rng = np.random.default_rng(seed)
    noisy = [light + rng.normal(0.0, 1.0, light.shape) for light in (room, flicker * room + laser)]
    without, lit = (light.clip(0.0, 255.0).round().astype(np.uint8) for light in noisy)
    return without, lit
