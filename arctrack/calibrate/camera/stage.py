"""Calibration of the camera from board images."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.linalg import LinAlgError

from arctrack.calibrate.camera.board_images import read_boards
from arctrack.calibrate.camera.page import camera_page
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import in_file
from arctrack.recording import CalibrationValues, SetupFile
from arctrack.recording.toml_text import rounded
from calibration.boards.board import Board
from calibration.camera.calibrate import CameraCalibration, calibrate_camera
from calibration.camera.enough import UndeterminedError
from calibration.camera.lens import ORDERS
from noise_model.calibration_errors import OPENCV
from noise_model.setup_keys import COEFFICIENTS


def calibrated_camera(result: CameraCalibration) -> CalibrationValues:
    """Return the calibrated values of `[camera]`, with their covariance."""
    lens = result.scene.lens
    n = len(lens.names)
    used = max((OPENCV.index(name) + 1 for name in lens.names[4:]), default=0)
    count = next(count for count in COEFFICIENTS if count >= used)
    fx, fy, cx, cy = (rounded(value, 9) for value in lens.values[:4])
    return CalibrationValues(
        "camera",
        {
            "width": lens.width,
            "height": lens.height,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
            "distortion": [rounded(value, 9) for value in lens.distortion[:count]],
        },
        lens.names,
        result.covariance[:n, :n],
        "arctrack calibrate camera",
        {
            "board": str(result.seen.board),
            "images": len(result.seen.names),
            "corners": len(result.seen),
            "rms_px": rounded(result.rms_px, 4),
            "corner_sigma_px": rounded(float(np.mean(result.noise.sigma_px)), 4),
        },
    )


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
