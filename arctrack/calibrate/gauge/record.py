"""The laser sheet from a gauge or a plate as recording.toml holds it."""

from dataclasses import replace

import numpy as np

from arctrack.calibrate.geometry_record import geometry_records
from arctrack.calibrate.laser.record import PARAMETERS, sheet_values
from arctrack.recording import CalibrationValues, SetupFile
from arctrack.recording.toml_text import rounded
from calibration.camera.known_lens import lens_from_camera
from calibration.certificate import HAND_EYE, LASER, Certificate, RobotNoise, certify
from calibration.gauge.calibrate import GaugeCalibration
from calibration.gauge.joint_covariance import sheet_shares
from noise_model.calibration_errors import CalibrationCovariance


def sheet_records(
    result: GaugeCalibration, stated: SetupFile, made_by: str
) -> tuple[tuple[CalibrationValues, ...], Certificate]:
    """Return the sheet as values of `[laser]`, the joint covariance of camera and sheet, and the certificate.

    The stated origin is projected onto the plane.
    """
    problem, laser = result.problem, result.fitted.state.laser
    robot_mm, form_mm = result.fitted.noise_mm.tolist()
    sheet = CalibrationValues(
        "laser",
        sheet_values(laser.plane, laser.origin_mm),
        PARAMETERS,
        np.asarray(result.covariance),
        made_by,
        {
            "gauge": str(problem.gauge),
            "images": len(problem.sightings),
            "robot_mm": rounded(robot_mm, 4),
            "form_mm": rounded(form_mm, 4),
        },
    )
    by_camera, own = sheet_shares(result, stated.setup)
    certificate = certify(
        replace(stated.setup, laser=laser),
        {HAND_EYE: by_camera, LASER: own},
        lens_from_camera(stated.setup.camera).project(
            np.concatenate([each.rays for each in problem.sightings])
        ),
        robot_noise(stated),
    )
    joint = CalibrationCovariance.sum((by_camera, own))
    return (sheet, *geometry_records(joint, certificate, made_by)), certificate


def robot_noise(stated: SetupFile) -> RobotNoise:
    """Return the robot's error as the calibration of the camera's pose has found it, else none."""
    hand_eye = stated.calibrations.get("hand_eye")
    about = {} if hand_eye is None else hand_eye.model_extra or {}
    return RobotNoise(*(float(about.get(f"robot_sigma_{unit}", 0.0)) for unit in ("deg", "mm")))
