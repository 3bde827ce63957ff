"""Interface of every source of frames for the capture process."""

import time
from collections.abc import Callable
from typing import Protocol

from arctrack.live.cameras.camera_line import CaptureRequest
from tracker.state import Frame

LONGEST_WAIT_S = 0.05
"""Time-out of a source's wait for a frame, s: the laser is asked for as often."""

Ask = Callable[[], CaptureRequest]
"""Returns what the tracker wants now."""


class FrameSource(Protocol):
    """Frames, one after the other, as they are taken.

    A frame's number goes up by one with each frame that was taken; what is lost on the way leaves a gap.
    Times are mid-exposure on the host's monotonic clock.
    """

    @property
    def is_over(self) -> bool:
        """True if no frame will come any more."""

    def begin(self) -> None:
        """Take frames from now on."""

    def read(self) -> Frame | None:
        """Return the next frame; None where none came within LONGEST_WAIT_S, or one was lost.

        Raises ArctrackError if the source fails.
        """

    def close(self) -> None:
        """Take no more frames; the laser goes off where the source has a hold on it."""


def wait_until(due_s: float) -> bool:
    """Sleep until a monotonic time, s, LONGEST_WAIT_S at most; return whether it has come."""
    time.sleep(min(max(due_s - time.monotonic(), 0.0), LONGEST_WAIT_S))
    return time.monotonic() >= due_s
