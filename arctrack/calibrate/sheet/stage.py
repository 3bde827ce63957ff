"""Calibration of the laser sheet from recordings of its stripe on a flat plate."""

from collections.abc import Sequence

from arctrack.calibrate.gauge.record import robot_noise, sheet_records
from arctrack.calibrate.sheet.page import plate_page
from arctrack.calibrate.sheet.plate_frames import PlateFrames, read_plate_frames
from arctrack.calibrate.stage import CalibrationStage, Steps, Warn, left_out
from arctrack.errors import in_file
from arctrack.recording import Recording, SetupFile
from calibration.camera.enough import UndeterminedError
from calibration.gauge.plate import PlateCalibration, calibrate_by_plate


def sheet_stage(
    recordings: Sequence[Recording], stated: SetupFile, plate_mm: float | None, steps: Steps, warn: Warn
) -> CalibrationStage[PlateCalibration]:
    """Correct the laser sheet by a plate that stands still in base in all recordings.

    ArctrackError says why not, with the motion that is missing where the poses tell nothing of the sheet.
    """
    frames = read_plate_frames(recordings, stated.setup, steps("looking for the stripe", "frames"))
    warn(left_out(frames.left_out))
    robot_mm = robot_noise(stated).move_mm or None
    try:
        if frames.poses == 1:
            raise UndeterminedError("all frames are of one pose: raise, tilt or move the tool between them")
        result = calibrate_by_plate(stated.setup, frames.sightings, plate_mm, robot_mm)
    except UndeterminedError as error:
        raise in_file(recordings[0].path, f"{error}{_example(frames)}") from None
    warn(left_out(result.left_out))
    records, certificate = sheet_records(result, stated, "arctrack calibrate sheet")
    page = plate_page(result, certificate, frames)
    return CalibrationStage(result, page, records, bad_frames=frames.bad_frames)


def _example(frames: PlateFrames) -> str:
    """Return the reason of the first frame that is not used, for the end of a refusal."""
    reasons = {**frames.left_out, **{str(bad.path): bad.problem for bad in frames.bad_frames}}
    for name, reason in reasons.items():
        return f"; {len(reasons)} frames are left out, {name} {reason}"
    return ""
