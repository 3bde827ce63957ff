"""A camera's calibration as recording.toml holds it."""

import numpy as np

from arctrack.recording import CalibrationValues
from arctrack.recording.toml_text import rounded
from calibration.camera.calibrate import CameraCalibration
from noise_model.calibration_errors import OPENCV
from noise_model.setup_keys import COEFFICIENTS


def calibrated_camera(result: CameraCalibration) -> CalibrationValues:
    """Return the calibrated values of `[camera]`, with their covariance."""
    lens = result.scene.lens
    n = len(lens.names)
    used = max((OPENCV.index(name) + 1 for name in lens.names[4:]), default=0)
    count = next(count for count in COEFFICIENTS if count >= used)
    fx, fy, cx, cy = (rounded(value, 9) for value in lens.values[:4])
    return CalibrationValues(
        "camera",
        {
            "width": lens.width,
            "height": lens.height,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
            "distortion": [rounded(value, 9) for value in lens.distortion[:count]],
        },
        lens.names,
        result.covariance[:n, :n],
        "arctrack calibrate camera",
        {
            "board": str(result.seen.board),
            "images": len(result.seen.names),
            "corners": len(result.seen),
            "rms_px": rounded(result.rms_px, 4),
            "corner_sigma_px": rounded(float(np.mean(result.noise.sigma_px)), 4),
        },
    )
