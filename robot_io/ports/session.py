"""The robot's part of the bus' rules, for a robot that cannot keep them itself.

`docs/reference/can.md` says what a robot must do. A port does it in the robot's place: it sends pose, status
and command as protected frames, waits until DISARM is acknowledged, and lets an offset count by `OffsetUse`.
So the tracker, its gate and its logs know no port from a robot on CAN.
"""

import math
from collections.abc import Iterator

import can

from robot_io.find_answer import FindAnswer, FindAssembler
from robot_io.link.inbox import Inbox
from robot_io.offset_use import OffsetUse
from robot_io.ports.report import PortCorrection, PortReport
from robot_io.protocol.codec import out_of_range_as_unknown
from robot_io.protocol.dbc import cycle_time_s, message_layout
from robot_io.protocol.messages import (
    BusMessage,
    Command,
    GateReason,
    PoseKind,
    RobotPosePosition,
    RobotPoseRotation,
    SeamOffset,
    Switch,
    TrackerCommand,
    TrackerHeartbeat,
    TrackerState,
    TrackerStatus,
)
from robot_io.protocol.protect import Protector

SILENT_S = 0.5
"""Silence that ends a session: RSI stops by itself after 100 late answers of 4 ms."""

RATE_MM_S = 20.0
"""Speed at which a displacement is led to a new value, and back to the path after DISARM."""

MAX_STEP_S = 0.05
"""Time between reports over which a displacement moves at most: EGM's slowest cycle is 48 ms."""

DISARMING = (Command.DISARM, Command.RESET, Command.STORE_ZERO, Command.FIND)
"""Commands under which no offset goes out."""

CanFrame = tuple[int, bytes]
"""Identifier and payload of a frame."""


class ArrivalClock:
    """Age of a robot's reports at their reading, by the robot's own clock.

    The report that took the least time counts as new: a report that waited is older by what it waited. That
    least may grow only as two clocks drift apart, so a way that becomes longer does not pass for a new one.
    """

    def __init__(self) -> None:
        self._apart_s, self._read_at_s = math.inf, 0.0

    def age_s(self, robot_time_s: float, read_at_s: float) -> float:
        """Return the age of a report that was read at a time, s."""
        apart_s = read_at_s - robot_time_s
        # Largest skew between two clocks (two quartzes of 50 ppm each).
        grown_s = self._apart_s + 100e-6 * (read_at_s - self._read_at_s)
        self._apart_s, self._read_at_s = min(apart_s, grown_s), read_at_s
        return apart_s - self._apart_s


class RobotSession:
    """A robot behind a port: its reports as frames of the bus, and what it may apply of the offsets.

    A session begins with the first report after `SILENT_S`, or after `begin`. Until the program commands
    DISARM in it, no report is answered: the robot may still stand where an earlier session sent it. A
    controller that was not answered for so long has stopped, and begins at zero as the session does.
    All times are on one clock that never goes back, s.
    """

    def __init__(self) -> None:
        self._inbox, self._protector = Inbox(), Protector()
        self._request_number = 0
        self.begin()

    def begin(self) -> None:
        """Begin a session: nothing is known of the robot."""
        self._clock, self._use = ArrivalClock(), OffsetUse()
        self._robot_time_s = self._taken_at_s = -math.inf
        self._sent_at_s: dict[type[BusMessage], float] = {}
        self._sent: dict[type[BusMessage], BusMessage] = {}
        self._was_disarmed = self._is_acknowledged = False
        self._command: Command | None = None
        self._applied_mm = [0.0, 0.0]
        self._offset_at_s = math.nan
        self._state, self._reason = TrackerState.UNKNOWN, GateReason.UNKNOWN
        self._finds = FindAssembler()
        self._find: FindAnswer | None = None

    def take(self, report: PortReport, read_at_s: float) -> list[CanFrame] | None:
        """Return the frames of a report that was read at a time, s.

        None for a report that is not newer than the one before, or too old: it must not be answered as if it
        counted.
        """
        if not 0.0 <= read_at_s - self._taken_at_s <= SILENT_S:
            self.begin()
            self._taken_at_s = read_at_s
        if not report.robot_time_s > self._robot_time_s:
            return None
        age_s = self._clock.age_s(report.robot_time_s, read_at_s)
        # Oldest report that is taken: the largest `sample_age_ms` of the bus.
        if age_s > 0.03:
            return None
        self._elapsed_s = min(report.robot_time_s - self._robot_time_s, MAX_STEP_S)
        self._robot_time_s, self._taken_at_s = report.robot_time_s, read_at_s
        return [self._protector.protect(message) for message in self._messages(report, age_s, read_at_s)]

    def hear(self, frame: can.Message, now_s: float, max_age_s: float) -> None:
        """Take a frame of the tracker that came at most `max_age_s` ago."""
        received = self._inbox.receive(frame, max_age_s)
        if received is None:
            return
        self._use.on_message(received, now_s)
        self._find = self._finds.push(received) or self._find
        message = received.message
        if isinstance(message, SeamOffset):
            self._offset_at_s = now_s - max_age_s
        elif isinstance(message, TrackerHeartbeat):
            self._state = message.state
        elif isinstance(message, TrackerStatus):
            self._reason = message.gate_reason

    def correction(self, report: PortReport, now_s: float) -> PortCorrection | None:
        """Return the answer to the report that was taken last; None where there must be none."""
        if not self._was_disarmed:
            return None
        is_wanted = report.command not in DISARMING and report.status.correction is Switch.ON
        offset = self._use.offset(now_s) if is_wanted and self._command not in DISARMING else None
        age_ms, aims_mm = math.nan, [0.0, 0.0]
        if offset is not None:
            age_ms = offset.capture_age_ms + 1000.0 * (now_s - self._offset_at_s)
            aims_mm = [offset.offset_y_mm, offset.offset_z_mm]
        elif is_wanted:
            aims_mm = self._applied_mm
        step_mm = RATE_MM_S * self._elapsed_s
        for axis, aim_mm in enumerate(aims_mm):
            # An axis that is unknown stays where it is.
            if not math.isnan(aim_mm):
                way_mm = aim_mm - self._applied_mm[axis]
                self._applied_mm[axis] += max(-step_mm, min(way_mm, step_mm))
        y_mm, z_mm = self._applied_mm
        find = self._find
        is_answered = find is not None and find.result.request_number == self._request_number
        is_find = report.command is self._command is Command.FIND
        return PortCorrection(
            y_mm,
            z_mm,
            offset is not None,
            age_ms,
            self._state,
            self._reason,
            find if is_find and is_answered else None,
        )

    def _messages(self, report: PortReport, age_s: float, now_s: float) -> Iterator[BusMessage]:
        command = self._obeyed(report, now_s)
        if self._is_due(command, now_s):
            yield command
        if self._is_due(report.status, now_s):
            yield report.status
        position = RobotPosePosition(*report.position_base_mm, PoseKind.ACTUAL)
        if self._is_due(position, now_s, changes_at_once=False):
            yield out_of_range_as_unknown(position)
            yield RobotPoseRotation.from_quaternion(report.quaternion_xyzw, 1000.0 * age_s)

    def _is_due(self, message: BusMessage, now_s: float, changes_at_once: bool = True) -> bool:
        """Return True if a message is to be sent: its cycle is over, or it says something else."""
        kind = type(message)
        # A report a little before its time is better than the next one, long after it.
        is_over = now_s - self._sent_at_s.get(kind, -math.inf) >= 0.75 * cycle_time_s(
            message_layout(kind.__name__)
        )
        if not is_over and not (changes_at_once and message != self._sent[kind]):
            return False
        self._sent_at_s[kind], self._sent[kind] = now_s, message
        return True

    def _obeyed(self, report: PortReport, now_s: float) -> TrackerCommand:
        """Return the command to the tracker: the program's, once a DISARM was acknowledged."""
        wanted = report.command
        self._was_disarmed |= wanted in DISARMING
        is_allowed = wanted in DISARMING or (self._was_disarmed and self._is_acknowledged)
        command = wanted if is_allowed else Command.DISARM
        if command is not self._command:
            self._command, self._request_number = command, (self._request_number + 1) % 256
            self._find = None
            self._is_acknowledged &= command is not Command.DISARM
        if command is Command.DISARM:
            self._is_acknowledged |= self._use.is_disarm_acknowledged(self._request_number, now_s)
        return TrackerCommand(
            command=command,
            enable_y=True,
            enable_z=True,
            request_number=self._request_number,
            job_number=report.job_number,
            program_number=None,
            laser_enable=report.laser,
        )
