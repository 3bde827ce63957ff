"""Values of the delay's calibration for a setup: `[effects.pose_delay]` and its sigma."""

from __future__ import annotations

import numpy as np

from arctrack.recording import CalibrationValues
from calibration.pose_delay import PoseDelay

MADE_BY = "arctrack calibrate delay"


def delay_record(result: PoseDelay) -> CalibrationValues:
    """Return a delay that was estimated, to the microsecond."""
    return CalibrationValues(
        "effects.pose_delay",
        {"delay_s": round(result.delay_s, 6)},
        ("delay_s",),
        np.array([[result.sigma_s**2]]),
        MADE_BY,
        {"frames": len(result.observations.timestamps_s)},
        name="pose_delay",
    )
