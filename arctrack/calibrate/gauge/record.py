"""The laser sheet from a gauge as recording.toml holds it."""

from __future__ import annotations

import numpy as np

from arctrack.calibrate.laser.record import PARAMETERS, sheet_values
from arctrack.recording import CalibrationValues
from arctrack.recording.toml_text import rounded
from calibration.gauge.calibrate import GaugeCalibration
from calibration.laser.plane import foot_on
from noise_model.setup import Setup


def gauge_record(result: GaugeCalibration, setup: Setup) -> CalibrationValues:
    """Return the plane as values of `[laser]`, with its covariance.

    The stated origin is projected onto the plane.
    """
    plane = result.plane
    origin = foot_on(plane, setup.laser.origin_mm)
    robot_mm, form_mm = result.fitted.noise_mm.tolist()
    return CalibrationValues(
        "laser",
        sheet_values(plane, origin),
        PARAMETERS,
        np.asarray(result.covariance),
        "arctrack calibrate gauge",
        {
            "gauge": str(result.problem.gauge),
            "images": len(result.problem.sightings),
            "robot_mm": rounded(robot_mm, 4),
            "form_mm": rounded(form_mm, 4),
        },
    )
