"""Clocks of a replay: when each frame is tracked, and what the robot does until then."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from arctrack.control.tracking_service import TrackingService
from arctrack.recording import FrameRow
from robot_io import (
    BusMessage,
    Command,
    Link,
    MotionState,
    Received,
    RobotMode,
    RobotStatus,
    Switch,
    TrackerCommand,
    WeldingState,
)

POLL_S = 0.02
"""Period at which the controller is polled while a frame's time has not come."""


class PlaybackClock:
    """The recording's clock, driven by `monotonic_s` from `begin` on; it stands at the first frame before."""

    def __init__(self, first: FrameRow, monotonic_s: Callable[[], float]) -> None:
        self._first_s, self._monotonic_s = first.exposed_s, monotonic_s
        self._began_s = math.nan

    def begin(self) -> None:
        """Let the recording begin now."""
        self._began_s = self._monotonic_s()

    def now_s(self) -> float:
        """Return the time, s."""
        elapsed_s = self._monotonic_s() - self._began_s
        return self._first_s if math.isnan(elapsed_s) else self._first_s + elapsed_s


class RecordingTime:
    """Offline clock: runs as fast as possible, computation counts as instantaneous.

    So the same recording sends the same on every machine. The robot is the recording's: it welds while a
    frame's arc burns, and commands the tracker to track. A log begins at 0: where a recording begins before,
    its log is whole seconds late.
    """

    def __init__(self, rows: Sequence[FrameRow], job_number: int | None = None) -> None:
        self._rows, self._job_number = rows, job_number
        self._now_s = first_s = min(row.exposed_s for row in rows)
        self._log_is_late_s = float(max(0, math.ceil(-first_s)))

    def now_s(self) -> float:
        """Return the time, s."""
        return self._now_s

    def logged_at_s(self) -> float:
        """Return the time that the log gives a message of now, s."""
        return self._now_s + self._log_is_late_s

    def begin(self, service: TrackingService[Any]) -> None:
        """Let the robot disarm the tracker: it obeys none that was armed before it began."""
        self._say(service, assumed_command(self._rows[0], Command.DISARM, self._job_number))

    def reach(self, row: FrameRow, service: TrackingService[Any]) -> None:
        """Go on to a frame's end of exposure; until then the robot is not silent."""
        before_s, exposed = self._now_s, row.exposed_s
        n_steps = max(1, math.ceil((exposed - before_s) / service.controller.job.limits.hold_s))
        for n in range(1, n_steps + 1):
            self._now_s = exposed if n == n_steps else before_s + n * (exposed - before_s) / n_steps
            self._say(service, assumed_robot(row))
            self._say(service, assumed_command(row, job_number=self._job_number))

    def warnings(self, service: TrackingService[Any]) -> tuple[str, ...]:
        """Return a warning about the log, if there is one."""
        if not self._log_is_late_s:
            return ()
        late = f"in bus.blf all times are {self._log_is_late_s:g} s later"
        return (f"frames come before 0 s, where a log begins: {late}",)

    def _say(self, service: TrackingService[Any], message: BusMessage) -> None:
        service.hear(Received(self._now_s, message, 0))


class RealTime:
    """Real-time clock on a bus beyond this process: a frame is tracked when its time has come.

    The robot is the one on the bus. The clock is the recording's, from the first frame on. Where the replay
    lags behind, messages go out late. `check_interrupt` is called while it waits, and may raise.
    """

    def __init__(self, rows: Sequence[FrameRow], link: Link, check_interrupt: Callable[[], None]) -> None:
        self._link, self._check_interrupt = link, check_interrupt
        self._clock = PlaybackClock(rows[0], time.monotonic)
        self.now_s = self._clock.now_s

    def logged_at_s(self) -> None:
        """Return none: the log has the time of the wall clock."""

    def begin(self, service: TrackingService[Any]) -> None:
        """Start the clock: what is got ready before takes its own time."""
        self._clock.begin()

    def reach(self, row: FrameRow, service: TrackingService[Any]) -> None:
        """Read the bus until a frame is due, and in any case what waits there.

        Between two frames a bus may bring more than its interface stores, and some interfaces know no better
        time of a message than that of its reading.
        """
        while True:
            self._check_interrupt()
            # One message at a time: a robot that talks all the time must not hold the frame up.
            remaining_s = max(0.0, row.exposed_s - self.now_s())
            received = next(self._link.receive(min(remaining_s, POLL_S)), None)
            if received is not None:
                service.hear(received)
            service.poll()
            if received is None and remaining_s <= POLL_S:
                return

    def warnings(self, service: TrackingService[Any]) -> tuple[str, ...]:
        """Return a warning where no robot was heard."""
        if service.robot is not None:
            return ()
        bus = f"{self._link.interface}:{self._link.channel}"
        return (f"{bus}: no RobotStatus was heard, so every offset was refused",)


def assumed_robot(row: FrameRow) -> RobotStatus:
    """Return a robot that welds in automatic if a frame's arc burns."""
    return RobotStatus(
        mode=RobotMode.AUTOMATIC,
        motion=MotionState.MOVING,
        welding=WeldingState.WELDING if row.arc_on else WeldingState.OFF,
        arc=Switch.ON if row.arc_on else Switch.OFF,
        emergency_stop=Switch.OFF,
        correction=Switch.ON,
        weave=Switch.UNKNOWN,
        current_a=row.current_a,
        travel_speed_mm_s=math.nan,
        path_section=None,
    )


def assumed_command(
    row: FrameRow, command: Command = Command.TRACK, job_number: int | None = None
) -> TrackerCommand:
    """Return what the recording's robot wanted: that its seam be tracked, by the laser of a frame."""
    return TrackerCommand(
        command=command,
        enable_y=True,
        enable_z=True,
        request_number=0,
        job_number=job_number,
        program_number=None,
        laser_enable=Switch.ON if row.laser_on else Switch.OFF,
    )
