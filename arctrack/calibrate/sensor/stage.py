"""Calibration of the sensor from flat and dark frames, or a recording of a still stripe."""

from pathlib import Path

from arctrack.calibrate.sensor.flat_frames import find_flat_frames, read_levels
from arctrack.calibrate.sensor.page import sensor_page
from arctrack.calibrate.sensor.record import flat_record, still_record
from arctrack.calibrate.sensor.still_page import still_page
from arctrack.calibrate.sensor.still_recording import read_still_frames
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn
from arctrack.errors import in_file
from arctrack.recording import Recording, SetupFile, read_recording
from arctrack.recording.importing.grey import channel_of_laser
from arctrack.recording.setup_writer import FILE_NAME
from calibration.sensor.flat_fields import SensorCalibration, calibrate_sensor
from calibration.sensor.still import StillCalibration, calibrate_still


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
