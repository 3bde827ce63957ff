"""A recording as a camera: each frame comes when its time has come, on the recording's own clock."""

import time
from collections.abc import Callable

from arctrack.live.cameras.camera import PLAYED, UnreadableFrame
from arctrack.recording import BadFrame, Recording
from arctrack.replay.replay_clock import PlaybackClock
from robot_io import LaserState, RobotPulse
from tracker.state import Frame


class RecordingCamera:
    """A recording played at its own pace, which `monotonic_s` measures.

    Its clock is the recording's, and begins with the first frame.
    """

    traits = PLAYED

    def __init__(self, recording: Recording, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        clock = PlaybackClock(recording.rows[0], monotonic_s)
        self.begin, self.now_s = clock.begin, clock.now_s
        self._frames = zip(recording.rows, recording.frames(), strict=True)
        self._next = next(self._frames, None)
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Number of frames that became due and were replaced by a newer one before a request."""
        return self._dropped

    @property
    def is_over(self) -> bool:
        """True once the last frame was handed out."""
        return self._next is None

    def newest(self) -> Frame | UnreadableFrame | None:
        """Return the newest frame whose exposure is over, None where it was handed out before."""
        due = None
        while self._next is not None and self._next[0].exposed_s <= self.now_s():
            self._dropped += due is not None
            due = self._next
            # It is decoded now: when its time has come there is none for it.
            self._next = next(self._frames, None)
        if due is None:
            return None
        row, frame = due
        if isinstance(frame, BadFrame):
            return UnreadableFrame(row.index, row.timestamp_s, frame.message)
        return frame

    def switch_laser(self, is_on: bool) -> LaserState:
        """Do nothing: what the laser did is recorded."""
        return LaserState.UNKNOWN

    def want_exposure(self, exposure_s: float) -> None:
        """Do nothing: exposures are recorded."""

    def tell_pulse(self, pulse: RobotPulse, came_at_s: float) -> None:
        """Do nothing: when frames were taken is recorded."""

    def close(self) -> None:
        """Play no more."""
        self._next = None
