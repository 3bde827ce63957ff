"""Calibration of the camera from board images."""

import math
from collections.abc import Sequence
from pathlib import Path

from numpy.linalg import LinAlgError

from arctrack.calibrate.camera.board_images import read_boards
from arctrack.calibrate.camera.page import camera_page
from arctrack.calibrate.camera.record import calibrated_camera
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import in_file
from arctrack.recording import SetupFile
from calibration.boards.board import Board
from calibration.camera.calibrate import CameraCalibration, calibrate_camera
from calibration.camera.enough import UndeterminedError
from calibration.camera.lens import ORDERS

OPEN_VALUE = "the images leave a value of the lens open: add images of the board tilted, beside the middle"


def camera_stage(
    sources: Sequence[Path],
    board: Board,
    stated: SetupFile | None,
    steps: Steps,
    warn: Warn,
    orders: Sequence[str] = tuple(ORDERS),
    tilted: bool = False,
) -> CalibrationStage[CameraCalibration]:
    """Find intrinsics and distortion, the best of some `orders`, in images of a board.

    Where halves of the images contradict each other the calibration is refused. ArctrackError says which
    image is missing where they do not determine the lens.
    """
    images = read_boards(sources, board, steps("looking for the board", "images"))
    warn(left_out(images.left_out))
    warn(images.warnings)
    try:
        result = calibrate_camera(
            board,
            images.views,
            images.size,
            tilted=tilted,
            orders=orders,
            progress=steps("fitting the lens", "steps"),
        )
    except UndeterminedError as error:
        raise in_file(sources[0], "; ".join(filter(None, (str(error), images.too_small)))) from None
    except LinAlgError:
        raise in_file(sources[0], OPEN_VALUE) from None
    warn(left_out(result.left_out))
    return CalibrationStage(
        result, camera_page(result, images, stated), (calibrated_camera(result),), _refusal(result, orders)
    )


def _refusal(result: CameraCalibration, orders: Sequence[str]) -> str | None:
    if result.model_error is None:
        return None
    is_lean = len(orders) == 1 and orders[0] != [*ORDERS][-1] and math.isfinite(result.ratio_of_halves)
    return result.model_error + ("; leave --distortion, which may be too lean" if is_lean else "")
