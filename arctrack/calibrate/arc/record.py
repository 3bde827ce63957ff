"""Values of the arc's calibration for a setup: `[arc]`, `[material]`, and their covariance."""

import numpy as np

from arctrack.recording import CalibrationValues
from arctrack.recording.calibrated import Value
from calibration.arc.calibrate import KEYS, ArcCalibration

MADE_BY = "arctrack calibrate arc"


def arc_records(result: ArcCalibration) -> tuple[CalibrationValues, ...]:
    """Return the determined values; what was refused stays as it is."""
    radius, *center, radiance, kappa_diff, kappa_spec, c2 = (float(f"{value:.8g}") for value in result.values)
    about: dict[str, float | int | str] = {
        "frames": len(result.problem.frames),
        "pixels": len(result.problem.charge_e),
        "texture": round(result.pixel_sigma, 5),
        "flicker": round(result.flicker, 5),
        "held_as_stated": ", ".join(result.held_keys),
    }
    arc: dict[str, Value] = {"radius_mm": radius, "center_in_tool_mm": center, "radiance_e": radiance}
    material: dict[str, Value] = {"kappa_diff": kappa_diff, "kappa_spec": kappa_spec, "c2": c2}
    determined = [
        {key: value for key, value in table.items() if key not in result.held_keys}
        for table in (arc, material)
    ]
    n_arc, radiance_at = 5, KEYS.index("radiance_e")
    # A variance in e-^2 would exceed the numbers that a setup holds, so it is relative.
    scale = np.ones(len(KEYS))
    scale[radiance_at] = 1.0 / radiance
    C = result.covariance * np.outer(scale, scale)
    names = tuple("radiance_rel" if key == "radiance_e" else key for key in KEYS)
    return (
        CalibrationValues("arc", determined[0], names[:n_arc], C[:n_arc, :n_arc], MADE_BY, about),
        CalibrationValues("material", determined[1], names[n_arc:], C[n_arc:, n_arc:], MADE_BY, about),
    )
