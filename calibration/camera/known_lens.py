"""Boards before a lens that is known: the lens that a setup states, and the boards' poses before it."""

from collections.abc import Sequence

import numpy as np

from calibration.boards.board import Board
from calibration.boards.detect import MIN_CORNERS
from calibration.camera.adjustment import BoardScene, adjust
from calibration.camera.enough import UndeterminedError
from calibration.camera.lens import Lens
from calibration.camera.noise import wrong_corners
from calibration.camera.sightings import BoardView, Sightings
from calibration.camera.start import with_better_poses
from calibration.threads import one_thread
from noise_model.calibration_errors import OPENCV, PINHOLE
from noise_model.instrument.camera import Camera

FAR_MM = 1e3
"""Initial distance of boards."""


def lens_from_camera(camera: Camera, free: Sequence[str] = ()) -> Lens:
    """Return a stated camera's lens, with the coefficients that are not 0, or that are `free`."""
    stated = dict(zip(OPENCV, camera.distortion, strict=False))
    names = tuple(name for name in OPENCV if stated.get(name, 0.0) != 0.0 or name in free)
    values = [camera.fx, camera.fy, camera.cx, camera.cy, *(stated.get(name, 0.0) for name in names)]
    return Lens(camera.width, camera.height, (*PINHOLE, *names), np.array(values))


def board_poses(board: Board, views: Sequence[BoardView], lens: Lens) -> tuple[BoardScene, Sightings]:
    """Return the boards' poses before a known lens, and the corners that are where the board has them."""
    seen = Sightings.of(board, views)
    far = np.tile(np.eye(4), (len(views), 1, 1))
    far[:, 2, 3] = FAR_MM
    scene = BoardScene(lens, np.zeros(2), far, np.zeros((len(board.points_mm), 2)))
    with one_thread():
        scene = with_better_poses(scene, seen)
        kept = ~wrong_corners(scene, seen)
        if not kept.all() and (seen.where(kept).counts >= MIN_CORNERS).all():
            seen = seen.where(kept)
            scene = adjust(scene, seen, np.ones(len(seen)), poses_only=True)
    return scene, seen


def check_corners(scene: BoardScene, seen: Sightings) -> None:
    """Raise UndeterminedError for corners that are not where the stated lens sees them."""
    rms = scene.rms_px(seen)
    if rms > 2.0:
        raise UndeterminedError(
            f"the boards' corners are {rms:.1f} px off where the setup's camera sees them: calibrate the "
            "camera first, `arctrack calibrate camera`; or the board's counts or squares are others"
        )
