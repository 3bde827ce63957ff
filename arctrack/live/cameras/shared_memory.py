"""Frames that another process publishes in shared memory, as a camera."""

import time

from arctrack.live.cameras.camera import SHARED, CameraTraits, UnreadableFrame
from arctrack.live.cameras.camera_line import CameraLine
from arctrack.live.cameras.shared_frames import SharedFramesError, SharedFramesReader
from noise_model.setup import Setup
from robot_io import LaserState, RobotPulse
from tracker.state import Frame, frame_misfit

LOOK_AGAIN_S = 0.5
"""Silence after which the writer is checked, s: it may be dead, or another one may have begun."""


class SharedMemoryCamera:
    """The newest frame published under a name; reconnects to a writer that was restarted.

    Without `traits` the publisher is taken to know all of the light. Raises SharedFramesError if nobody
    publishes such frames, or they do not fit the setup.
    """

    def __init__(self, name: str, setup: Setup, traits: CameraTraits = SHARED) -> None:
        self._name, self._setup, self.traits = name, setup, traits
        self._reader: SharedFramesReader | None = SharedFramesReader(name)
        problem = frame_misfit(self._reader.shape, self._reader.dtype, setup)
        if problem is not None:
            self._reader.close()
            raise SharedFramesError(f"frames {name!r}: each {problem}")
        self._line = CameraLine(name)
        self._dropped_before = 0
        self._looked_s = time.monotonic()

    @property
    def dropped(self) -> int:
        """Number of frames taken since `begin` and not handed out."""
        return self._dropped_before + (0 if self._reader is None else self._reader.missed)

    @property
    def is_over(self) -> bool:
        """False: another writer may begin."""
        return False

    @property
    def is_newest_read(self) -> bool:
        """True if no frame waits."""
        return self._reader is None or self._reader.is_newest_read

    def begin(self) -> None:
        """Let frames count from now on."""
        self.newest()
        self._dropped_before -= self.dropped

    def now_s(self) -> float:
        """Return the host's monotonic time, s."""
        return time.monotonic()

    def newest(self) -> Frame | UnreadableFrame | None:
        """Return the newest frame that was not handed out yet, None where there is none."""
        frame = None if self._reader is None else self._reader.newest()
        if frame is None:
            if self.now_s() - self._looked_s > LOOK_AGAIN_S:
                self._look_again()
            return None
        self._looked_s = self.now_s()
        problem = frame_misfit(frame.image_dn.shape, frame.image_dn.dtype, self._setup)
        return frame if problem is None else UnreadableFrame(frame.index, frame.timestamp_s, problem)

    def switch_laser(self, is_on: bool) -> LaserState:
        """Switch the laser; on must be said again and again."""
        self._line.switch_laser(is_on)
        if not self.traits.switches_laser:
            return LaserState.UNKNOWN
        return LaserState.ON if is_on else LaserState.OFF

    def want_exposure(self, exposure_s: float) -> None:
        """Request an exposure, s, from the publisher."""
        self._line.want_exposure(exposure_s)

    def tell_pulse(self, pulse: RobotPulse, came_at_s: float) -> None:
        """Send the publisher the arc's pulse, received at a time, s; it holds for some cycles."""
        self._line.tell_pulse(pulse, came_at_s)

    def close(self) -> None:
        """Read no more; the laser goes off."""
        self._line.close()
        if self._reader is not None:
            self._reader.close()

    def _look_again(self) -> None:
        self._looked_s = self.now_s()
        if self._reader is not None:
            if self._reader.is_writer_alive:
                return
            self._dropped_before = self.dropped
            self._reader.close()
            self._reader = None
        try:
            # Another camera took the old line away.
            self._line = CameraLine(self._name)
            self._reader = SharedFramesReader(self._name)
        except (SharedFramesError, OSError):
            # Memory that is full, or somebody else's, is no reason to end.
            return
