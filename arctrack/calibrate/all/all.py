"""All calibrations of a folder in their order, each on what the earlier ones wrote, and the certificate."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from arctrack.calibrate.all.folder import CalibrationSources, by_keys
from arctrack.calibrate.arc.stage import arc_stage
from arctrack.calibrate.camera.stage import camera_stage
from arctrack.calibrate.delay.stage import delay_stage
from arctrack.calibrate.geometry_record import geometry_records
from arctrack.calibrate.hand_eye.stage import hand_eye_stage
from arctrack.calibrate.laser.stage import laser_stage
from arctrack.calibrate.sensor.stage import sensor_stage
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn
from arctrack.errors import ArctrackError
from arctrack.recording import CalibrationValues, Recording, SetupFile, read_recording, with_calibrated
from arctrack.recording.setup_file import parse_setup
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


@dataclass
class Calibrations:
    """Results of a folder's calibrations.

    `stated` is the setup with all calibrated values, `records` are these values. `refused` maps calibrations
    to the reason; the setup keeps its own values there. `certificate` is the seam's uncertainty, None without
    a laser sheet; `unmeasured` says what it takes as stated, and from where.
    """

    stated: SetupFile
    records: list[CalibrationValues] = field(default_factory=list)
    stages: dict[str, CalibrationStage[Any]] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    certificate: Certificate | None = None
    unmeasured: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, make: Callable[[], CalibrationStage[Any]]) -> None:
        """Do a calibration, and put its values into the setup; one that is refused leaves them alone."""
        try:
            stage = make()
            self.keep(*(() if stage.refusal is not None else stage.records))
        except ArctrackError as error:
            self.refused[name] = by_keys(name, error)
            return
        self.stages[name] = stage
        if stage.refusal is not None:
            self.refused[name] = stage.refusal

    def keep(self, *records: CalibrationValues) -> None:
        """Put values into the setup; ArctrackError, and nothing changes, where it does not take them."""
        records_before = [*self.records, *records]
        self.stated = parse_setup(with_calibrated(self.stated.path, *records_before), self.stated.path)
        self.records = records_before


def calibrate_folder(raw: CalibrationSources, stated: SetupFile, steps: Steps, warn: Warn) -> Calibrations:
    """Run every calibration that a folder holds files for, starting from the stated setup.

    `steps` begins a step of the progress; `warn` is told at once what is left out.
    """
    result = Calibrations(stated)
    if raw.sensor is not None:
        sensor = raw.sensor
        result.add("sensor", lambda: sensor_stage(sensor.source, result.stated, steps, warn, sensor.gamma))
    if raw.camera is not None:
        camera = raw.camera
        result.add(
            "camera",
            lambda: camera_stage(
                camera.sources, camera.board, result.stated, steps, warn, camera.orders, camera.tilted
            ),
        )
    if "camera" in result.refused:
        result.refused |= {
            name: "needs the camera, which was refused"
            for name in ("hand_eye", "laser")
            if getattr(raw, name) is not None
        }
    else:
        if raw.hand_eye is not None:
            posed = raw.hand_eye
            result.add(
                "hand_eye",
                lambda: hand_eye_stage(
                    posed.sources, posed.board, result.stated, posed.poses, steps, warn, posed.is_eye_to_hand
                ),
            )
        if raw.laser is not None:
            pairs = raw.laser
            result.add("laser", lambda: laser_stage(pairs.sources, pairs.board, result.stated, steps, warn))
    for name, path, make in (("delay", raw.delay, delay_stage), ("arc", raw.arc, arc_stage)):
        if path is not None:
            result.add(name, partial(_of_recording, make, path, result.stated, steps, warn))
    geometry = certified_geometry(result.stages, result.stated)
    if geometry is not None:
        result.certificate, result.unmeasured = geometry.certificate, dict(geometry.unmeasured)
        result.keep(*geometry.records)
    return result


def _of_recording(
    make: Callable[[Recording, Steps], CalibrationStage[Any]],
    path: Path,
    stated: SetupFile,
    steps: Steps,
    warn: Warn,
) -> CalibrationStage[Any]:
    """Calibrate with a recording, and the setup that the calibrations have made so far."""
    read = replace(read_recording(path, stated.path), setup=stated.setup)
    warn(read.warnings)
    stage = make(read, steps)
    complaint = read.complaint(stage.bad_frames, "the values are those of the others")
    warn([] if complaint is None else [complaint])
    return stage
