"""Next pose of the board: the one that lowers the projection's variance over the image most."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.boards.board import BoardKind
from calibration.camera.adjustment import BoardScene, linearise
from calibration.camera.projection import Knowledge, image_grid, rms_sigma
from calibration.camera.sightings import BoardView, Sightings
from noise_model.compiled.arrays import Float64

PLACES = (0.2, 0.5, 0.8)
"""Candidate positions of the board's middle in the image, shares of width and height."""

SIZES = (0.35, 0.55, 0.8)
"""Candidate spans of the board over the image's shorter side: how near it is held."""

TILTS_DEG = (0.0, 20.0, 40.0)
ABOUT = {"the image's horizontal": (1.0, 0.0, 0.0), "the image's vertical": (0.0, 1.0, 0.0)}


@dataclass(frozen=True)
class NextBoard:
    """Board pose `T_camera_board` (4, 4), mm, of the most useful further image.

    `points_px` (N, 2) are its corners in the image, `words` say how to hold the board, `sigma_px` is the
    projection's RMS sigma over the image with that image added.
    """

    T_camera_board: Float64
    points_px: Float64
    words: str
    sigma_px: float


def mean_sigma(known: Knowledge, scene: BoardScene, distance_mm: float) -> float:
    """Return the projection's RMS sigma over the image, px."""
    grid, _ = image_grid(scene.lens)
    return float(np.sqrt(np.mean(rms_sigma(known.projection_covariance(scene.lens, grid, distance_mm)) ** 2)))


def best_next_board(
    known: Knowledge, scene: BoardScene, seen: Sightings, sigma_px: float, distance_mm: float
) -> NextBoard | None:
    """Return the candidate pose that lowers the projection's sigma most; None if none can be seen.

    Of a chessboard all corners must be in view, of markers some. `sigma_px` is the new corners' noise,
    `distance_mm` the distance at which the projection matters.
    """
    candidates = [
        candidate
        for place, size, tilt in itertools.product(itertools.product(PLACES, PLACES), SIZES, _tilts())
        if (
            candidate := _candidate(
                known,
                scene,
                seen,
                sigma_px=sigma_px,
                distance_mm=distance_mm,
                place=place,
                size=size,
                tilt=tilt,
            )
        )
        is not None
    ]
    return min(candidates, key=lambda each: each.sigma_px, default=None)


def _tilts() -> list[tuple[float, str]]:
    leaning = [
        (sign * tilt, axis) for tilt, axis, sign in itertools.product(TILTS_DEG[1:], ABOUT, (1.0, -1.0))
    ]
    return [(0.0, next(iter(ABOUT))), *leaning]


def _candidate(
    known: Knowledge,
    scene: BoardScene,
    seen: Sightings,
    sigma_px: float,
    distance_mm: float,
    place: tuple[float, float],
    size: float,
    tilt: tuple[float, str],
) -> NextBoard | None:
    lens, board = scene.lens, seen.board
    middle_px = np.array([[place[0] * (lens.width - 1), place[1] * (lens.height - 1)]])
    span_mm = float(np.max(board.points_mm))
    depth_mm = float(lens.values[0]) * span_mm / (size * min(lens.width, lens.height))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(tilt[0]) * np.array(ABOUT[tilt[1]])).as_matrix()
    T[:3, 3] = lens.rays(middle_px)[0] * depth_mm - T[:3, :3] @ (0.5 * board.points_mm.max(axis=0))
    pose = replace(scene, T_camera_board=T[np.newaxis])
    corners = np.arange(len(board.points_mm))
    blank = Sightings.of(board, [BoardView("", corners, np.zeros((len(corners), 2)))])
    points = lens.project(pose.points_camera(blank))
    inside = np.all((points >= 0.0) & (points <= [lens.width - 1.0, lens.height - 1.0]), axis=1)
    if not inside.all() and (board.kind is BoardKind.CHESSBOARD or inside.sum() < 0.5 * len(inside)):
        return None
    shown = blank.where(inside)
    more = linearise(pose, shown, np.full(len(shown), 1.0 / sigma_px))
    sigma = mean_sigma(known.with_images(more), scene, distance_mm)
    return NextBoard(T, points[inside], _words(place, depth_mm, tilt), sigma)


def _words(place: tuple[float, float], depth_mm: float, tilt: tuple[float, str]) -> str:
    across = {PLACES[0]: "left", PLACES[1]: "", PLACES[2]: "right"}[place[0]]
    down = {PLACES[0]: "upper", PLACES[1]: "", PLACES[2]: "lower"}[place[1]]
    where = " ".join(filter(None, (down, across))) or "middle"
    lean = "parallel to the sensor" if not tilt[0] else f"turned by {tilt[0]:+.0f} deg about {tilt[1]}"
    return f"in the image's {where}, some {depth_mm:.0f} mm from the camera, {lean}"
