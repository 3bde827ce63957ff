"""Values of a sensor's calibration for a setup: `[sensor]` and `[calibration.sensor]`."""

from dataclasses import asdict

from arctrack.recording import CalibrationValues
from arctrack.recording.toml_text import rounded
from calibration.sensor.flat_fields import KEYS, SensorCalibration
from calibration.sensor.still import KEYS as STILL_KEYS
from calibration.sensor.still import StillCalibration

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
