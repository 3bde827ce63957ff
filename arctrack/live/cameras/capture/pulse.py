"""Trigger times of a camera in the base phase of a pulsed arc, where its light is least.

The robot states when a base phase began, the period, and how long the phase lasts. A frame is centred in it.
The host's possible error, SLACK_S, must fit on both sides: the age on the bus is rounded to 0.1 ms, the
message waits some 0.5 ms for others, a sleep ends up to 0.2 ms late, and the trigger command takes up to 1
ms.
"""

import math

from arctrack.live.cameras.camera_line import CaptureRequest

SLACK_S = 0.002
"""Largest error of the time of an exposure: the sum of what is named above."""


def is_reached(wanted: CaptureRequest, exposure_s: float, now_s: float) -> bool:
    """Return whether a base phase is known, and is long enough for a frame that the host triggers."""
    return now_s < wanted.pulse_until_s and wanted.base_s >= exposure_s + 2.0 * SLACK_S


def trigger_at_s(wanted: CaptureRequest, exposure_s: float, due_s: float, now_s: float) -> float:
    """Return when the exposure of a due frame begins, s: in the first base phase from `due_s` on.

    It is `due_s` itself where no base phase is known that the exposure fits in.
    """
    if not is_reached(wanted, exposure_s, now_s):
        return due_s
    begin_s = wanted.base_begin_s + (wanted.base_s - exposure_s) / 2.0
    return begin_s + wanted.period_s * math.ceil((due_s - begin_s) / wanted.period_s)
