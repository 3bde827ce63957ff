"""Calibration of the laser sheet from images of a gauge, or a check of the setup's sheet."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.calibrate.gauge.gauge_images import GaugeImages, read_gauge_frames, read_gauge_images
from arctrack.calibrate.gauge.page import check_page, gauge_page
from arctrack.calibrate.gauge.record import sheet_records
from arctrack.calibrate.robot_poses import PoseSource
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import ArctrackError, in_file
from arctrack.recording import Recording, SetupFile
from calibration.camera.enough import UndeterminedError
from calibration.gauge.calibrate import (
    FEW_IMAGES,
    GaugeCalibration,
    GaugeCheck,
    calibrate_gauge,
    check_each,
    check_gauge,
)
from calibration.gauge.shape import Gauge
from calibration.gauge.sightings import StatedSensor

GaugeSource = Sequence[Path] | Recording
"""Folders of images, images and patterns; or a recording."""

NO_POSES = "the robot's poses are unknown: give them with --poses, or take a recording; --check needs none"

SHEET_CURE = (
    "the sheet is not where the setup has it: `arctrack calibrate gauge` from twelve poses, or `arctrack "
    "calibrate laser`; if the size stays off, `arctrack calibrate camera`"
)


def gauge_stage(
    source: GaugeSource, gauge: Gauge, stated: SetupFile, poses: PoseSource | None, steps: Steps, warn: Warn
) -> CalibrationStage[GaugeCalibration]:
    """Find the laser sheet from a gauge that stands still, at several poses of the robot.

    The source is image files, or a recording, which has poses of its own. ArctrackError names the motion that
    is missing where the poses do not determine the sheet.
    """
    images = _read(source, gauge, stated, poses, steps, warn)
    if not images.has_poses:
        raise in_file(_path(source), NO_POSES)
    setup = stated.setup
    up = np.array(setup.joint.surface_normal_in_base)
    try:
        result = calibrate_gauge(images.shown, gauge, _sensor(stated, images), up)
    except UndeterminedError as error:
        raise in_file(_path(source), str(error)) from None
    warn(left_out(result.left_out))
    records, _ = sheet_records(result, stated, "arctrack calibrate gauge")
    return CalibrationStage(result, gauge_page(result, images, setup), records)


@dataclass(frozen=True)
class GaugeVerdict:
    """Verdict of a gauge on a setup's sheet, in one line.

    `cure` names what to calibrate again; empty if all is right.
    """

    is_good: bool
    line: str
    cure: str


def check_stage(
    source: GaugeSource,
    gauge: Gauge,
    stated: SetupFile,
    poses: PoseSource | None,
    within_mm: float,
    steps: Steps,
    warn: Warn,
) -> tuple[CalibrationStage[list[GaugeCheck]], GaugeVerdict]:
    """Check by a gauge's size, which may be off by `within_mm`, whether the setup's sheet is right.

    Poses may be unknown. The stage has no values for a setup. ArctrackError where no image shows the gauge,
    or too few to tell.
    """
    images = _read(source, gauge, stated, poses, steps, warn)
    setup, shown = stated.setup, images.shown
    sensor = _sensor(stated, images)
    up = np.array(setup.joint.surface_normal_in_base)
    if not shown:
        name, reason = next(iter(images.left_out.items()))
        raise in_file(_path(source), f"no image shows the gauge: {name} {reason}")
    try:
        if images.has_poses:
            checks = [check_gauge(shown, gauge, sensor, up)]
        else:
            checks = check_each(shown, gauge, sensor)
    except UndeterminedError as error:
        raise in_file(_path(source), str(error)) from None
    for check in checks:
        warn(left_out(check.left_out))
    off_mm, sigma_mm = size_off(checks)
    # Largest sigma of a size, over its limit, that decides whether it is within the limit.
    if sigma_mm > 0.5 * within_mm:
        raise in_file(
            _path(source),
            f"the gauge's size is measured to {sigma_mm:.3f} mm (1 σ), too little to tell {within_mm:g} mm: "
            "add images, upright over the gauge, or give a larger --within",
        )
    verdict = _verdict(gauge, off_mm, sigma_mm, checks, within_mm)
    return CalibrationStage(
        checks, check_page(checks, images, verdict.line, verdict.cure, verdict.is_good), ()
    ), verdict


def size_off(checks: Sequence[GaugeCheck]) -> tuple[float, float]:
    """Return the size's error with its 1 sigma, mm: the weighted mean of checks."""
    weight = np.array([check.sigma_mm**-2.0 for check in checks])
    off = np.array([check.off_mm for check in checks])
    return float(weight @ off / weight.sum()), 1.0 / math.sqrt(float(weight.sum()))


def _verdict(
    gauge: Gauge, off_mm: float, sigma_mm: float, checks: Sequence[GaugeCheck], within_mm: float
) -> GaugeVerdict:
    robot_mm = float(checks[0].fitted.noise_mm[0])
    form_mm = float(np.median([check.fitted.noise_mm[1] for check in checks]))
    has_places = len(checks[0].problem.sightings) >= FEW_IMAGES
    places = f"; from pose to pose it lies within {robot_mm:.3f} mm, 1 σ" if has_places else ""
    size = f"the gauge's {gauge.size_mm:g} mm are measured {off_mm:+.3f} ± {sigma_mm:.3f} mm off{places}"
    if form_mm > within_mm:
        return GaugeVerdict(
            False,
            f"not OK: the stripe's pieces lie {form_mm:.2f} mm off the faces of {gauge}, 1 σ",
            f"is it that gauge? If so, {SHEET_CURE}",
        )
    if abs(off_mm) > within_mm:
        return GaugeVerdict(False, f"not OK: {size}", SHEET_CURE)
    if has_places and robot_mm > within_mm:
        return GaugeVerdict(
            False,
            f"not OK: {size}",
            "sizes are right and places are not: the camera's pose in the tool, or the robot's poses; "
            "`arctrack calibrate hand-eye`, then `arctrack calibrate gauge`",
        )
    return GaugeVerdict(True, f"OK: {size}", "")


def _read(
    source: GaugeSource, gauge: Gauge, stated: SetupFile, poses: PoseSource | None, steps: Steps, warn: Warn
) -> GaugeImages:
    tell = steps("looking for the gauge", "images")
    if isinstance(source, Recording):
        if poses is not None:
            raise ArctrackError("--poses: a recording has its own; leave the option")
        images = read_gauge_frames(source, gauge, stated, tell)
    else:
        images = read_gauge_images(source, gauge, stated, poses, tell)
    warn(left_out(images.left_out))
    return images


def _sensor(stated: SetupFile, images: GaugeImages) -> StatedSensor:
    return StatedSensor(images.lens, stated.setup.camera.T_tool_camera, stated.setup.laser)


def _path(source: GaugeSource) -> Path:
    return source.path if isinstance(source, Recording) else source[0]
