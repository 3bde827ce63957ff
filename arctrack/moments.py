"""When each frame of a replay is published, and what the robot then does."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from arctrack.publish import Moment
from arctrack.recording import FrameRow
from robot_io import Link, MotionState, RobotMode, RobotStatus, Switch, WeldingState


class RecordingTime:
    """Nobody in real time listens: as fast as one can, as if computing took no time.

    So the same recording sends the same on every machine. A log begins at 0: where a recording begins before,
    its log is whole seconds late.
    """

    def __init__(self, rows: Sequence[FrameRow]) -> None:
        self._log_is_late_s = float(max(0, math.ceil(-min(_exposed_s(row) for row in rows))))

    def moment(self, row: FrameRow, took_ms: float) -> Moment:
        """Return the frame's end of exposure, and a robot that welds while the frame's arc burns."""
        now_s = _exposed_s(row)
        return Moment(now_s, assumed_robot(row), took_ms, now_s + self._log_is_late_s)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to tell a user of the log, one line."""
        if not self._log_is_late_s:
            return ()
        return (
            f"frames come before 0 s, where a log begins: in bus.blf all times are {self._log_is_late_s:g} s "
            "later",
        )


class RealTime:
    """On a bus beyond this process a frame goes out when its time has come; who sends there is heard.

    The robot is the one that is heard. Until there is one it is assumed to weld while a frame's arc burns.
    """

    def __init__(self, rows: Sequence[FrameRow], link: Link) -> None:
        self._first_s = rows[0].timestamp_s
        self._link = link
        self._began_s = math.nan
        self._heard = False
        self._moments = self._assumed = 0

    def moment(self, row: FrameRow, took_ms: float) -> Moment:
        """Wait for a frame and return its end of exposure, later by as much as the replay lags behind.

        The clock starts with the first: what is got ready before that takes its own time. Raises LinkError if
        the bus fails.
        """
        due_s = row.timestamp_s - self._first_s
        if math.isnan(self._began_s):
            self._began_s = time.monotonic()
        self._listen_until(due_s)
        robot = self._link.inbox.latest(RobotStatus, time.time()) if self._heard else assumed_robot(row)
        self._moments += 1
        self._assumed += not self._heard
        return Moment(_exposed_s(row) + max(0.0, self._elapsed_s() - due_s), robot, took_ms)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to tell a user of the robot, one line."""
        if not self._assumed:
            return ()
        return (
            f"{self._link.interface}:{self._link.channel}: no RobotStatus was heard for {self._assumed} of "
            f"{self._moments} frames: a robot in automatic, its arc as in frames.csv, was assumed",
        )

    def _listen_until(self, due_s: float) -> None:
        """Read the bus until a frame is due, and in any case what waits there.

        Between two frames a bus may bring more than its interface stores, and some interfaces know no better
        time of a message than that of its reading.
        """
        while True:
            # One message at a time: a robot that talks all the time must not hold the frame up.
            left_s = max(0.0, due_s - self._elapsed_s())
            received = next(self._link.receive(left_s), None)
            if received is None:
                return
            self._heard |= isinstance(received.message, RobotStatus)

    def _elapsed_s(self) -> float:
        return time.monotonic() - self._began_s


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


def _exposed_s(row: FrameRow) -> float:
    """Return a frame's end of exposure."""
    return row.timestamp_s + row.exposure_s / 2.0
