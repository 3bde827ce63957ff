"""The laser sheet's calibration as recording.toml holds it."""

import numpy as np
from scipy.linalg import block_diag

from arctrack.recording import CalibrationValues, SetupFile
from arctrack.recording.calibrated import Value
from arctrack.recording.toml_text import rounded
from calibration.laser.beam import Beam
from calibration.laser.calibrate import LaserCalibration
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import invert

MADE_BY = "arctrack calibrate laser"
PARAMETERS = ("n_x", "n_y", "n_z", "d_mm")
BOW = "bow"
ORIGIN = ("origin_x_mm", "origin_y_mm", "origin_z_mm")
FAN = (*ORIGIN, "fan_half_angle_deg")


def laser_record(result: LaserCalibration, beam: Beam, setup: Setup) -> CalibrationValues:
    """Return the sheet as values of `[laser]`, with their covariance.

    The setup's camera pose takes the sheet to the tool frame; the stated origin is projected onto it. Bow,
    angle and thickness are added where they are known.
    """
    plane, bow, covariance = result.in_tool(setup.camera.T_tool_camera, setup.laser.plane)
    values = sheet_values(plane, beam.origin_mm) | {"bow": rounded(bow, 6)}
    names, whole = [*PARAMETERS, BOW], np.asarray(covariance)
    about: dict[str, float | int | str] = {
        "pairs": len(result.names),
        "points": sum(map(len, result.points_mm)),
        "rms_mm": rounded(result.rms_mm, 4),
    }
    if result.bow is not None:
        about["bow_mm"] = rounded(abs(result.bow.value) * result.ends_mm, 4)
        about["held_out_flat_mm"], about["held_out_bowed_mm"] = (
            rounded(each, 4) for each in result.bow.held_out_mm
        )
    if not isinstance(beam.fan, str):
        values["fan_half_angle_deg"] = rounded(beam.fan.half_angle_deg, 6)
        about["fan_turn_deg"] = rounded(beam.fan.turn_deg, 4)
        assert beam.covariance is not None
        names, whole = [*names, *FAN], beam.covariance
    if not bow:
        names.remove(BOW)
        whole = np.delete(np.delete(whole, len(PARAMETERS), 0), len(PARAMETERS), 1)
    if not isinstance(beam.width, str):
        if beam.width.at_height_mm is not None:
            sigma_mm, error_mm = beam.width.at_height_mm
            values["stripe_sigma_mm"] = rounded(sigma_mm, 5)
            names, whole = [*names, "stripe_sigma_mm"], block_diag(whole, error_mm**2)
        if beam.width.waist is not None:
            waist = beam.width.waist
            about["waist_depth_mm"], about["waist_sigma_mm"] = (
                rounded(value, 5) for value, _ in (waist.depth_mm, waist.sigma_mm)
            )
            about["rayleigh_mm"] = rounded(waist.rayleigh_mm[0], 5)
    return CalibrationValues("laser", values, tuple(names), whole, MADE_BY, about)


def sheet_values(plane: Float64, origin_mm: Float64) -> dict[str, Value]:
    """Return plane (4,) and origin (3,) of a sheet as values of `[laser]`."""
    return {
        "plane_in_tool": [rounded(value, 9) for value in plane],
        "origin_in_tool_mm": [round(float(value), 4) for value in origin_mm],
    }


def moved_with_camera(stated: SetupFile, T_tool_camera: Float64) -> CalibrationValues | None:
    """Return a calibrated sheet in the tool where the camera's pose in it becomes `T_tool_camera` (4, 4), mm.

    The sheet is measured in the camera's frame: camera and laser are one body. `stated` has the pose that the
    sheet was taken to the tool with. None for a setup whose sheet was never calibrated.
    """
    record = stated.calibrations.get("laser")
    if record is None or tuple(record.parameters[:4]) != PARAMETERS:
        return None
    T_new_old = T_tool_camera @ invert(stated.setup.camera.T_tool_camera)
    R, t = T_new_old[:3, :3], T_new_old[:3, 3]
    whole = np.eye(len(record.parameters))
    whole[:3, :3], whole[3, :3] = R, -t @ R
    if ORIGIN[0] in record.parameters:
        first = record.parameters.index(ORIGIN[0])
        whole[first : first + 3, first : first + 3] = R
    laser = stated.setup.laser.in_frame(T_new_old)
    about = dict(record.model_extra or {})
    return CalibrationValues(
        "laser",
        sheet_values(laser.plane, laser.origin_mm),
        tuple(record.parameters),
        whole @ np.array(record.covariance) @ whole.T,
        str(about.pop("made_by", MADE_BY)),
        about,
    )
