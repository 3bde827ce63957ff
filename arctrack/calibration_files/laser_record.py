"""The laser sheet's calibration as recording.toml holds it."""

from __future__ import annotations

import numpy as np

from arctrack.recording import Calibrated
from arctrack.recording.toml_text import rounded
from calibration.laser.calibrate import LaserCalibration
from noise_model.arrays import Float64
from noise_model.setup import Setup

MADE_BY = "arctrack calibrate laser"
PARAMETERS = ("n_x", "n_y", "n_z", "d_mm")


def plane_in_tool(result: LaserCalibration, setup: Setup) -> tuple[Float64, Float64]:
    """Return the plane (4,) in the tool frame and its covariance (4, 4); n points as the stated one does."""
    plane, covariance = result.in_tool(setup.camera.T_tool_camera)
    sign = 1.0 if plane[:3] @ setup.laser.plane[:3] >= 0.0 else -1.0
    return sign * plane, covariance


def laser_record(result: LaserCalibration, setup: Setup) -> Calibrated:
    """Return the plane as values of `[laser]`, with its covariance; the stated origin is moved into it.

    Parameters
    ----------
    result : LaserCalibration
        The calibration.
    setup : Setup
        The setup that it belongs to: the camera's pose takes the plane to the tool frame.

    Returns
    -------
    Calibrated
        The plane, and the point of it that is nearest to the origin stated.
    """
    plane, covariance = plane_in_tool(result, setup)
    origin = setup.laser.origin_mm - (plane[:3] @ setup.laser.origin_mm + plane[3]) * plane[:3]
    return Calibrated(
        "laser",
        {
            "plane_in_tool": [rounded(value, 9) for value in plane],
            "origin_in_tool_mm": [round(float(value), 4) for value in origin],
        },
        PARAMETERS,
        np.asarray(covariance),
        MADE_BY,
        {
            "pairs": len(result.names),
            "points": sum(map(len, result.points_mm)),
            "rms_mm": rounded(result.rms_mm, 4),
            "bow_mm": rounded(result.bow.bow_mm, 4),
        },
    )
