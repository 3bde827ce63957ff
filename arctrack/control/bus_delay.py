"""Detection of a delaying bus by the robot's SYNC and the tracker's echo.

A frame that was late on its way bears no mark of it. A SYNC and its echo do: the robot states how long both
took together, and the comparison of clocks how long the newest SYNC took at least.
"""

import math

from arctrack.control.policy import ServicePolicy
from robot_io import GateReason, RobotSync
from robot_io.clocks.sync import ClockSync, SyncLimits, Unestimated


class BusDelay:
    """Watch of the bus' delay by the echoes of SYNC messages.

    A robot that sends no SYNC is not judged, unless the policy requires SYNC. Once it has sent one it must go
    on, and receive the echoes.
    """

    def __init__(self, policy: ServicePolicy) -> None:
        self._policy, self._limits, self._sync = policy, SyncLimits(), ClockSync()
        self._is_heard = False
        self._known_at_s = math.nan
        self._is_late = False

    def hear(self, sync: RobotSync, came_at_s: float) -> None:
        """Take a SYNC that came at a time, s."""
        self._is_heard = True
        self._sync = self._sync.on_sync(sync, came_at_s, self._limits)
        round_trip_s = math.nan if sync.last_round_trip_us is None else sync.last_round_trip_us * 1e-6
        if math.isfinite(round_trip_s):
            self._known_at_s = came_at_s
        min_s, _ = self._sync.delay_s(came_at_s, self._limits)
        offset = self._sync.offset(came_at_s, self._limits)
        # A NaN, which nothing is known of, is not late: how long that may last is asked elsewhere.
        self._is_late = (
            round_trip_s > self._policy.round_trip_s
            or min_s > self._policy.round_trip_s
            or offset.unestimated is Unestimated.TOO_WIDE
        )

    def doubt(self, now_s: float) -> GateReason:
        """Return BUS_DELAYED where frames are late, or where nobody knows that they are not; else NONE."""
        if not self._is_heard:
            return GateReason.BUS_DELAYED if self._policy.sync_required else GateReason.NONE
        # Written so that a NaN, and a clock that was set, fail.
        is_known = abs(now_s - self._known_at_s) <= self._policy.round_trip_age_s
        return GateReason.NONE if is_known and not self._is_late else GateReason.BUS_DELAYED
