"""What a sensor's calibration writes into a setup: `[sensor]`, and `[calibration.sensor]` beside it."""

from __future__ import annotations

from arctrack.recording import Calibrated
from calibration.sensor.flat_fields import KEYS, SensorCalibration

MADE_BY = "arctrack calibrate sensor"

DIGITS = 7
"""Significant digits that are written: nobody knows a sensor better."""


def flat_record(result: SensorCalibration) -> Calibrated:
    """Return the values of flat and dark frames, with DSNU, PRNU and linearity as remarks."""
    about = {name: rounded(result[name].value) for name in ("dsnu_e", "prnu_rel", "linearity_rel")}
    about |= {
        f"{name}_sigma": rounded(result[name].sigma) for name in ("dsnu_e", "prnu_rel", "linearity_rel")
    }
    return Calibrated(
        "sensor",
        {name: rounded(result[name].value) for name in KEYS},
        KEYS,
        result.covariance,
        MADE_BY,
        {**about, "levels": int(result.levels.is_lit.sum()), "pixels": result.levels.n_pixels},
    )


def rounded(value: float) -> float:
    """Return a value to the digits that are written."""
    return float(f"{value:.{DIGITS}g}")
