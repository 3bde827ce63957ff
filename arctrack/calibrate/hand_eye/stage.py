"""Calibration of the camera's pose from board images and the robot's poses."""

from collections.abc import Sequence
from pathlib import Path

from arctrack.calibrate.hand_eye.hand_eye_meaning import other_meanings
from arctrack.calibrate.hand_eye.hand_eye_poses import read_posed_boards
from arctrack.calibrate.hand_eye.page import hand_eye_page
from arctrack.calibrate.hand_eye.record import hand_eye_record
from arctrack.calibrate.laser.record import moved_with_camera
from arctrack.calibrate.robot_poses import PoseSource, read_robot_poses
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import in_file
from arctrack.recording import SetupFile
from arctrack.recording.importing.image_files import find_images
from calibration.boards.board import Board
from calibration.camera.enough import UndeterminedError
from calibration.hand_eye_boards.calibrate import HandEyeCalibration, calibrate_hand_eye
from calibration.hand_eye_boards.enough import InconsistentError
from noise_model.compiled.arrays import Float64

CHECK = (
    "check how rotations are written (--rotation), units, which pose is of which image, and the squares' side"
)


def hand_eye_stage(
    sources: Sequence[Path],
    board: Board,
    stated: SetupFile,
    source: PoseSource,
    steps: Steps,
    warn: Warn,
    is_eye_to_hand: bool = False,
) -> CalibrationStage[HandEyeCalibration]:
    """Find the camera's pose in the tool; in base if the camera stands still and the robot carries the board.

    ArctrackError where the poses do not determine the camera, with the motion that is missing, or contradict
    the boards.
    """
    posed = read_posed_boards(sources, board, stated, source, steps("looking for the board", "images"))
    warn(posed.warnings)
    warn(left_out(posed.left_out))
    try:
        result = calibrate_hand_eye(
            posed.scene,
            posed.seen,
            posed.T_base_tool,
            is_eye_to_hand=is_eye_to_hand,
            lens_covariance=posed.lens_covariance,
            joint_rad=posed.joint_rad,
            progress=steps("fitting the camera's pose", "steps"),
        )
    except UndeterminedError as error:
        # Readings that fit are named: numbers alone do not say which convention they follow.
        def reread(other: PoseSource) -> Float64:
            return read_robot_poses(other, find_images(sources), stated).at(posed.rows)

        meanings = other_meanings(posed, source, reread, is_eye_to_hand=is_eye_to_hand)
        fits = f"the poses fit the boards if they are read otherwise: {'; or '.join(meanings)}"
        if isinstance(error, InconsistentError):
            raise in_file(source.path, f"{error}: {fits if meanings else CHECK}") from None
        raise in_file(source.path, fits if meanings else str(error)) from None
    if result.no_joints is not None:
        warn([f"{source.path}: its joint angles are not used: {result.no_joints}"])
    warn(left_out(result.left_out))
    sheet = None if is_eye_to_hand else moved_with_camera(stated, result.T_holder_camera)
    page = hand_eye_page(result, posed, stated.setup, moves_sheet=sheet is not None)
    return CalibrationStage(result, page, (hand_eye_record(result), *([] if sheet is None else [sheet])))
