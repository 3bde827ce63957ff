"""Certificate of the seam's position, from the completed calibrations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.optimize import linprog

from arctrack.calibrate.stage import CalibrationStage
from arctrack.recording import CalibrationValues, SetupFile
from arctrack.recording.toml_text import rounded
from calibration.certificate import Certificate, KnownHandEye, KnownLens, KnownSheet, RobotNoise, certify
from calibration.hand_eye_boards.calibrate import HandEyeCalibration
from calibration.laser.calibrate import LaserCalibration
from calibration.pose_delay import PoseDelay
from noise_model.compiled.arrays import Float64
from tracker.seam.locate import moved_variance

UNIT_RAD, UNIT_MM = 1e-3, 0.1
"""The turn and the move whose variances are scaled to the certificate's."""


def certificate_of(
    stages: Mapping[str, CalibrationStage[Any]], stated: SetupFile
) -> tuple[Certificate | None, dict[str, str]]:
    """Return the seam's covariance, None without a measured sheet, and what it takes as stated.

    `stages` are the completed calibrations, `stated` is the setup with their values.
    """
    if "laser" not in stages:
        return None, {}
    sheet: LaserCalibration = stages["laser"].result
    unmeasured = {}
    if not sheet.lens_covariance.any():
        unmeasured["lens"] = "its values are the setup's, and count as exact"
    hand_eye, robot = _hand_eye(stages, stated, len(sheet.lens.values))
    if "hand_eye" not in stages:
        tolerance = stated.setup.tolerance
        unmeasured["camera's pose in the tool"] = (
            f"the setup's, within its tolerance: {tolerance.hand_eye_deg:g}°, {tolerance.hand_eye_mm:g} mm"
        )
        unmeasured["error of the robot's poses"] = "counts as none: poses with a board tell it"
    delay_mm = 0.0
    if "delay" in stages:
        delay: PoseDelay = stages["delay"].result
        delay_mm = delay.sigma_s * delay.motion_mm_s if delay.unestimated is None else 0.0
    if not delay_mm:
        unmeasured["delay of the poses"] = "counts as exact"
    certificate = certify(
        KnownLens(sheet.lens, sheet.lens_covariance),
        KnownSheet(sheet.plane, sheet.own_covariance[:4, :4], sheet.per_lens[:4]),
        hand_eye,
        _points_px(sheet),
        robot,
        delay_mm,
    )
    return certificate, unmeasured


def certificate_record(certificate: Certificate, stated: SetupFile) -> CalibrationValues:
    """Return the tolerance of the camera's pose that makes a track's sigma no smaller than the certificate's.

    A track's sigma has the setup's errors by `hand_eye_deg` and `hand_eye_mm` alone: rotations and
    translations of the camera relative to a fixed sheet. Of all pairs that leave no variance below the
    certificate's, at any of its points, lateral or vertical, the one with the least sum over them is taken: a
    linear programme in the two squares. The covariance returned is that of the seam, lateral and vertical,
    nearest to the tool's axis.
    """
    setup, plane = stated.setup, tuple(stated.setup.laser.plane.tolist())
    wanted = np.square(certificate.sigma_mm[:, 1:]).ravel()
    columns = [
        np.concatenate(
            [
                moved_variance(setup.camera.T_tool_camera, plane, np.eye(4), tuple(point), unit)
                for point in certificate.points_tool_mm.tolist()
            ]
        )
        / wanted
        for unit in ((UNIT_RAD, 0.0), (0.0, UNIT_MM))
    ]
    over = np.column_stack(columns)
    turn2, move2 = linprog(over.sum(axis=0), A_ub=-over, b_ub=-np.ones(len(wanted))).x
    n = certificate.nearest_to_tool
    near = certificate.covariance_mm2[n][1:, 1:]
    return CalibrationValues(
        "tolerance",
        {
            "hand_eye_deg": rounded(math.degrees(UNIT_RAD * math.sqrt(turn2)), 3),
            "hand_eye_mm": rounded(UNIT_MM * math.sqrt(move2), 3),
        },
        ("seam_y_mm", "seam_z_mm"),
        near,
        "arctrack calibrate all",
        {"robot_pose_sigma_mm": [rounded(value, 3) for value in certificate.pose_sigma_mm[n, 1:].tolist()]},
        name="certificate",
    )


def _hand_eye(
    stages: Mapping[str, CalibrationStage[Any]], stated: SetupFile, n_lens: int
) -> tuple[KnownHandEye, RobotNoise]:
    """Return the camera's pose, measured or within the setup's tolerance, and the robot's noise."""
    pose = stated.setup.camera.T_tool_camera
    if "hand_eye" not in stages:
        tolerance = stated.setup.tolerance
        sigma = [math.radians(tolerance.hand_eye_deg)] * 3 + [tolerance.hand_eye_mm] * 3
        known = KnownHandEye(pose, np.diag(np.square(sigma)), np.zeros((6, 6)), np.zeros((6, n_lens)))
        return known, RobotNoise(0.0, 0.0)
    result: HandEyeCalibration = stages["hand_eye"].result
    to_rad = np.array([math.pi / 180.0] * 3 + [1.0] * 3)
    square = np.outer(to_rad, to_rad)
    own, by_robot = result.own_covariance * square, result.by_robot * square
    known = KnownHandEye(pose, own, by_robot, to_rad[:, np.newaxis] * result.per_lens)
    return known, RobotNoise(math.radians(result.robot_deg), result.robot_mm)


def _points_px(sheet: LaserCalibration) -> Float64:
    # Fewer points than that are taken more than once, which changes nothing.
    return np.concatenate(
        [
            stripe.points_px[np.linspace(0, len(stripe.points_px) - 1, 25).round().astype(int)]
            for stripe in sheet.stripes
        ]
    )
