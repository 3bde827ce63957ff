"""Seam as a track and its pose place it: input of the watch over the poses."""

import math

import numpy as np

from arctrack.control.innovation import SeamMeasurement
from noise_model.setup import Setup
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, transform
from tracker.seam.locate import seam_displacement
from tracker.state import Pose, Track


def seam_measurement(
    setup: Setup, track: Track, pose: Pose | None, calibration_variance_mm2: tuple[float, float]
) -> SeamMeasurement | None:
    """Return the seam that a track saw, placed by its pose; None where it saw none.

    Its sigma leaves out the calibration's error, which turns with the tool and is common to all frames;
    `calibration_variance_mm2` is that error's part in the variances of the track's (y, z).
    """
    if pose is None or not math.isfinite(track.seam_tool_mm[1]):
        return None
    seam_tool = np.array(track.seam_tool_mm)
    seam_base = transform(pose.T_base_tool, seam_tool)
    T_base_joint = seam_frame(setup.joint, seam_base)
    T_joint_tool = invert(T_base_joint) @ pose.T_base_tool
    station_mm, displacement = seam_displacement(setup, T_joint_tool, seam_tool)
    y_mm, z_mm = displacement.tolist()
    sigma_y_mm, sigma_z_mm = (
        math.sqrt(max(0.0, sigma_mm**2 - of_calibration))
        for sigma_mm, of_calibration in zip(
            (track.sigma_y_mm, track.sigma_z_mm), calibration_variance_mm2, strict=True
        )
    )
    (y_x, z_x), (y_y, z_y), (y_z, z_z) = T_base_joint[:3, 1:3].tolist()
    axes_base, lever_mm = ((y_x, y_y, y_z), (z_x, z_y, z_z)), math.hypot(*track.seam_tool_mm)
    return SeamMeasurement(station_mm, (y_mm, z_mm), (sigma_y_mm, sigma_z_mm), axes_base, lever_mm)
