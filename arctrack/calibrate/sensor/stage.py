"""Calibration of the sensor from flat and dark frames, or a recording of a still stripe."""

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from arctrack.calibrate.sensor.flat_frames import find_flat_frames, read_levels
from arctrack.calibrate.sensor.page import sensor_page, still_page
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn
from arctrack.errors import in_file
from arctrack.recording import CalibrationValues, Recording, SetupFile, read_recording
from arctrack.recording.importing.grey import channel_of_laser
from arctrack.recording.setup_writer import FILE_NAME
from arctrack.recording.toml_text import rounded
from calibration.sensor.flat_fields import KEYS, SensorCalibration, calibrate_sensor
from calibration.sensor.still import KEYS as STILL_KEYS
from calibration.sensor.still import StillCalibration, calibrate_still
from noise_model.compiled.arrays import Integers
from tracker.state import frame_misfit


def read_still_frames(
    recording: Recording, progress: Callable[[int, int], None]
) -> tuple[list[Integers], list[str]]:
    """Return the images (H, W) of the laser alone, of the commonest exposure, and what could not be read.

    `progress` is called with the images read and their number.
    """
    alone = [n for n, row in enumerate(recording.rows) if row.laser_on and not row.arc_on]
    exposures = Counter(recording.rows[n].exposure_s for n in alone)
    wanted = [n for n in alone if recording.rows[n].exposure_s == exposures.most_common(1)[0][0]]
    images, problems = [], []
    for done, image in enumerate(recording.images(wanted)):
        if isinstance(image, str):
            problems.append(image)
        else:
            images.append(image)
        progress(done + 1, len(wanted))
    # Frames that were cut off or turned are no part of one scene, those of fewer bits of another sensor's.
    misfits = [frame_misfit(image.shape, image.dtype, recording.setup) for image in images]
    unlike = [misfit for misfit in misfits if misfit is not None]
    if unlike:
        problems.append(f"{recording.path}: {len(unlike)} frames are left out; the first {unlike[0]}")
    return [image for image, misfit in zip(images, misfits, strict=True) if misfit is None], problems


MADE_BY = "arctrack calibrate sensor"

DIGITS = 7
"""Significant digits that are written: nobody knows a sensor better."""


def flat_record(result: SensorCalibration) -> CalibrationValues:
    """Return the values of flat and dark frames, with DSNU, PRNU and linearity as remarks."""
    about = {}
    for name in ("dsnu_e", "prnu_rel", "linearity_rel"):
        about[name] = rounded(result[name].value, DIGITS)
        about[f"{name}_sigma"] = rounded(result[name].sigma, DIGITS)
    return CalibrationValues(
        "sensor",
        {name: rounded(result[name].value, DIGITS) for name in KEYS},
        KEYS,
        result.covariance,
        MADE_BY,
        {**about, "levels": int(result.levels.is_lit.sum()), "pixels": result.levels.n_pixels},
    )


def still_record(result: StillCalibration) -> CalibrationValues:
    """Return the values of a still stripe, with its speckle as remarks."""
    about: dict[str, float | int | str] = {"frames": result.statistics.n_frames}
    if result.speckle is not None:
        about |= {f"speckle_{name}": rounded(value, DIGITS) for name, value in asdict(result.speckle).items()}
    return CalibrationValues(
        "sensor",
        # The code of saturation stays: the charge there goes with the gain.
        {
            **{name: rounded(result[name].value, DIGITS) for name in STILL_KEYS},
            "full_well_e": rounded(result.sensor.full_well_e, DIGITS),
        },
        STILL_KEYS,
        result.covariance,
        MADE_BY,
        about,
    )


def sensor_stage(
    source: Path, stated: SetupFile, steps: Steps, warn: Warn, gamma: float | None = None
) -> CalibrationStage[SensorCalibration] | CalibrationStage[StillCalibration]:
    """Find a sensor's values in flat and dark frames, or in a recording where the folder is one.

    Flat and dark frames give gain, noise and response, or all at a stated gamma; a recording of a still
    stripe gives gain, read noise, black level and speckle. ArctrackError where the frames do not determine
    the values.
    """
    if (source / FILE_NAME).exists():
        return _still_stage(read_recording(source, stated.path, must_fit=False), steps, warn)
    files, vague = find_flat_frames(source)
    warn(vague)
    bits = stated.setup.sensor.bits
    try:
        levels, lossy = read_levels(
            files, channel_of_laser(stated.setup), bits, steps("reading exposures", "exposures")
        )
        result = calibrate_sensor(levels, bits, gamma)
    except ValueError as error:
        raise in_file(source, str(error)) from None
    warn(lossy)
    return CalibrationStage(result, sensor_page(result, levels, source.name, lossy), (flat_record(result),))


def _still_stage(read: Recording, steps: Steps, warn: Warn) -> CalibrationStage[StillCalibration]:
    try:
        frames, problems = read_still_frames(read, steps(read.name, "frames"))
        result = calibrate_still(frames, read.setup.sensor)
    except ValueError as error:
        raise in_file(read.path, str(error)) from None
    warn(problems)
    return CalibrationStage(result, still_page(result, read.name, problems), (still_record(result),))
