"""Certificate of the seam's position, from the completed calibrations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from arctrack.calibrate.geometry_record import geometry_records
from arctrack.calibrate.stage import CalibrationStage
from arctrack.recording import CalibrationValues, SetupFile
from calibration.certificate import (
    Certificate,
    KnownHandEye,
    KnownLens,
    KnownSheet,
    RobotNoise,
    certify,
    covariance_shares,
)
from calibration.hand_eye_boards.calibrate import HandEyeCalibration
from calibration.laser.calibrate import LaserCalibration
from calibration.pose_delay import PoseDelay
from noise_model.calibration_errors import CalibrationCovariance
from noise_model.compiled.arrays import Float64

MADE_BY = "arctrack calibrate all"


@dataclass(frozen=True)
class CertifiedGeometry:
    """The joint covariance of a setup's calibrated values, and the seam's by it.

    `unmeasured` says what is taken as stated.
    """

    covariance: CalibrationCovariance
    certificate: Certificate
    unmeasured: Mapping[str, str]

    @property
    def records(self) -> tuple[CalibrationValues, ...]:
        """Both for a setup: by the first a track has its sigma, the second is for people."""
        return geometry_records(self.covariance, self.certificate, MADE_BY)


def certified_geometry(
    stages: Mapping[str, CalibrationStage[Any]], stated: SetupFile
) -> CertifiedGeometry | None:
    """Return what the completed calibrations leave open, None without a measured sheet.

    `stated` is the setup with their values.
    """
    if "laser" not in stages:
        return None
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
    # Of its two directions the setup's normal has the stated one.
    normal_tool = hand_eye.T_tool_camera[:3, :3] @ sheet.plane[:3]
    sign = 1.0 if normal_tool @ stated.setup.laser.plane[:3] >= 0.0 else -1.0
    shares = covariance_shares(
        KnownLens(sheet.lens, sheet.lens_covariance),
        KnownSheet(sign * sheet.plane, sheet.own_covariance, sign * sheet.per_lens),
        hand_eye,
        delay_mm,
    )
    return CertifiedGeometry(
        CalibrationCovariance.sum(shares.values()),
        certify(stated.setup, shares, _points_px(sheet), robot),
        unmeasured,
    )


def _hand_eye(
    stages: Mapping[str, CalibrationStage[Any]], stated: SetupFile, n_lens: int
) -> tuple[KnownHandEye, RobotNoise]:
    """Return the camera's pose, measured or within the setup's tolerance, and the robot's noise."""
    pose = stated.setup.camera.T_tool_camera
    if "hand_eye" not in stages:
        of_tolerance = CalibrationCovariance.of_tolerance(stated.setup.tolerance)
        known = KnownHandEye(pose, of_tolerance.matrix, np.zeros((6, 6)), np.zeros((6, n_lens)))
        return known, RobotNoise(0.0, 0.0)
    result: HandEyeCalibration = stages["hand_eye"].result
    known = KnownHandEye(pose, result.own_covariance, result.by_robot, result.per_lens)
    return known, RobotNoise(*result.pose_sigma)


def _points_px(sheet: LaserCalibration) -> Float64:
    # Fewer points than that are taken more than once, which changes nothing.
    return np.concatenate(
        [
            stripe.points_px[np.linspace(0, len(stripe.points_px) - 1, 25).round().astype(int)]
            for stripe in sheet.stripes
        ]
    )
