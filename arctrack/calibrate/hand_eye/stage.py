"""Calibration of the camera's pose from board images and the robot's poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.calibrate.hand_eye.hand_eye_poses import other_meanings, read_posed_boards
from arctrack.calibrate.hand_eye.page import hand_eye_page
from arctrack.calibrate.laser.record import moved_with_camera
from arctrack.calibrate.robot_poses import PoseSource, read_robot_poses
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import in_file
from arctrack.recording import CalibrationValues, SetupFile
from arctrack.recording.calibrated import Value
from arctrack.recording.importing.image_files import find_images
from arctrack.recording.toml_text import rounded
from calibration.boards.board import Board
from calibration.camera.enough import UndeterminedError
from calibration.hand_eye_boards.calibrate import HandEyeCalibration, calibrate_hand_eye
from calibration.hand_eye_boards.enough import InconsistentError
from calibration.hand_eye_boards.robot_error import JOINTS
from noise_model.calibration_errors import POSE
from noise_model.compiled.arrays import Float64

MADE_BY = "arctrack calibrate hand-eye"


def hand_eye_record(result: HandEyeCalibration) -> CalibrationValues:
    """Return the pose as values of `[camera.pose_in_tool]`, with its covariance.

    The covariance is that of a small motion of the camera in its own frame, deg and mm. A camera that stands
    still has no pose in the tool: its pose in base is kept next to its covariance.
    """
    pose = pose_values(result.T_holder_camera)
    lens = result.refined.boards.scene.lens
    about: dict[str, Value | str | list[str]] = {
        "board": str(result.refined.boards.seen.board),
        "poses": len(result.names),
        "poses_left_out": len(result.left_out),
        "corner_sigma_px": rounded(result.corner_sigma_px, 4),
        "robot_sigma_deg": rounded(result.robot_deg, 4),
        "robot_sigma_mm": rounded(result.robot_mm, 4),
        "robot_error": result.robot_error.name,
        "held_out_mm": rounded(result.robot_error.rms_mm, 4),
    }
    if result.robot_error.name == JOINTS:
        about["joints"] = list(result.joints)
        about["joint_offsets_deg"] = [rounded(value, 4) for value in result.joint_offsets[0].tolist()]
    if result.lens_covariance.any():
        about["lens_parameters"] = list(lens.names)
        about |= {
            f"{name}_per_lens": [rounded(value, 6) for value in row]
            for name, row in zip(POSE, result.per_lens, strict=True)
        }
    if result.is_eye_to_hand:
        return CalibrationValues(
            "camera", {}, POSE, result.covariance, MADE_BY, {**pose, **about}, "camera_in_base"
        )
    return CalibrationValues("camera.pose_in_tool", pose, POSE, result.covariance, MADE_BY, about, "hand_eye")


def pose_values(T_holder_camera: Float64) -> dict[str, list[float]]:
    """Return translation_mm and quaternion_xyzw of a pose (4, 4), mm."""
    quaternion = Rotation.from_matrix(T_holder_camera[:3, :3]).as_quat()
    return {
        "translation_mm": [round(float(value), 6) for value in T_holder_camera[:3, 3]],
        "quaternion_xyzw": [round(float(value), 12) for value in np.asarray(quaternion)],
    }


CHECK = (
    "check how rotations are written (--rotation), units, which pose is of which image, and the squares' side"
)

LOOKS_UP = (
    "the camera looks up in the poses' own frame, as in that of a flange or a tool with z into the part: "
    "state what lies between that and arctrack's tool in [robot.controllertool_to_tool] of the setup"
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

    ArctrackError where the poses do not determine the camera, with the motion that is missing, contradict
    the boards, or are of a frame whose z points into the part.
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
    # The camera's view goes along the third axis.
    if not is_eye_to_hand and result.T_holder_camera[2, 2] >= 0.0:
        raise in_file(source.path, LOOKS_UP)
    if result.no_joints is not None:
        warn([f"{source.path}: its joint angles are not used: {result.no_joints}"])
    warn(left_out(result.left_out))
    sheet = None if is_eye_to_hand else moved_with_camera(stated, result.T_holder_camera)
    page = hand_eye_page(result, posed, stated.setup, moves_sheet=sheet is not None)
    return CalibrationStage(result, page, (hand_eye_record(result), *([] if sheet is None else [sheet])))
