"""Calibration of the delay between poses and frames from a recording with motion."""

import numpy as np

from arctrack.calibrate.delay.page import delay_page
from arctrack.calibrate.stage import CalibrationStage, Steps
from arctrack.errors import in_file
from arctrack.recording import CalibrationValues, Recording
from calibration.pose_delay import PoseDelay, PoseTrack, estimate_pose_delay


def delay_stage(read: Recording, steps: Steps) -> CalibrationStage[PoseDelay]:
    """Calibrate the delay between poses and frames, from a recording whose tool weaves or rises.

    It is refused where the motion does not determine the delay. Raises ArctrackError where too few frames
    show the seam.
    """
    frames, bad_frames = read.readable_frames()
    track = PoseTrack.through(read.poses.timestamps_s, read.poses.T_base_tool)
    try:
        result = estimate_pose_delay(read.setup, frames, track, steps("rounds", "rounds"))
    except ValueError as error:
        raise in_file(read.path, str(error)) from None
    refusal = None if result.unestimated is None else f"the delay is unestimated: {result.unestimated}"
    records = () if refusal is not None else (_delay_record(result),)
    return CalibrationStage(result, delay_page(result, read), records, refusal, bad_frames)


def _delay_record(result: PoseDelay) -> CalibrationValues:
    """Return a delay that was estimated, to the microsecond."""
    return CalibrationValues(
        "effects.pose_delay",
        {"delay_s": round(result.delay_s, 6)},
        ("delay_s",),
        np.array([[result.sigma_s**2]]),
        "arctrack calibrate delay",
        {"frames": len(result.observations.timestamps_s)},
        name="pose_delay",
    )
