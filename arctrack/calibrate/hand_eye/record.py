"""The camera's pose on a robot as recording.toml holds it."""

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.recording import CalibrationValues
from arctrack.recording.calibrated import Value
from arctrack.recording.toml_text import rounded
from calibration.hand_eye_boards.calibrate import HandEyeCalibration
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
