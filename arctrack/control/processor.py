"""Waiting time of a thread for a processor: what a busy machine takes from the loop."""

import math
import time
from pathlib import Path

from robot_io import GateReason

SCHEDSTAT = Path("/proc/thread-self/schedstat")
"""Nanoseconds that the thread ran, and that it was ready but waited (Linux, scheduler/sched-stats.rst)."""

MAX_WAIT_SHARE = 0.5
"""Above it the thread waits longer for a processor than it has one: what it does takes twice its time."""


TOO_BUSY = (
    "This machine is too busy: the tracker waits longer for a processor than it has one. "
    "End what else runs here."
)

DELAYS = frozenset(
    {
        GateReason.CAPTURE_TOO_OLD,
        GateReason.ROBOT_STATUS_STALE,
        GateReason.HEARTBEAT_LOST,
        GateReason.CAMERA_STOPPED,
        GateReason.POSE_IMPLAUSIBLE,
        GateReason.BUS_DELAYED,
    }
)
"""Gate reasons about robot, bus and camera that a busy machine causes: whatever comes late looks like it."""


class ProcessorWait:
    """Share of the time in which the calling thread wants a processor that it waits for one.

    `share` is the latest, `waited_s` and `ran_s` count since this object was made; NaN where the kernel does
    not tell.
    """

    def __init__(self) -> None:
        self._began = self._before = self._window = _ran_and_waited_ns()
        self._looked_s = self._window_s = time.monotonic()
        self.share = self.waited_s = self.ran_s = math.nan

    @property
    def is_too_long(self) -> bool:
        """True if the machine is too busy for this thread."""
        return self.share > MAX_WAIT_SHARE

    def look(self) -> None:
        """Measure, where it is time for it."""
        now_s = time.monotonic()
        # A reading takes some hundredths of a millisecond.
        if now_s - self._looked_s < 0.1:
            return
        self._looked_s = now_s
        ran_ns, waited_ns = _ran_and_waited_ns()
        # The share is that of the last one to two windows, s.
        if now_s - self._window_s > 0.5:
            self._before, self._window, self._window_s = self._window, (ran_ns, waited_ns), now_s
        self.ran_s, self.waited_s = 1e-9 * (ran_ns - self._began[0]), 1e-9 * (waited_ns - self._began[1])
        ran_ns, waited_ns = ran_ns - self._before[0], waited_ns - self._before[1]
        self.share = waited_ns / (ran_ns + waited_ns) if ran_ns + waited_ns > 0.0 else math.nan


def _ran_and_waited_ns() -> tuple[float, float]:
    try:
        ran, waited, *_ = SCHEDSTAT.read_bytes().split()
    except (OSError, ValueError):
        return math.nan, math.nan
    return float(ran), float(waited)
