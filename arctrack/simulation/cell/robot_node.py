"""Robot's node on the bus: what it sends, and what it receives of the tracker."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import can
from scipy.spatial.transform import Rotation

from arctrack.simulation.cell.bus import BusConnection, BusFrame
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.scheduler import Scheduler
from robot_io import (
    SOURCES,
    BusMessage,
    Inbox,
    PoseKind,
    Protector,
    Received,
    RobotPosePosition,
    RobotPoseRotation,
    RobotStatus,
    RobotSync,
    SeamOffset,
    Source,
    TrackerSyncEcho,
    Trusted,
    cycle_time_s,
    message_layout,
)
from robot_io.poses.nominal_path import Quaternion, Vector

SEND_LAG_S = 0.002
"""Time from a pose's sample to the sending of its frames."""


@dataclass(frozen=True)
class RobotReport:
    """A pose as the robot reports it."""

    place_mm: Vector
    quaternion: Quaternion
    age_s: float


SOURCE = Source.LIVE
"""Source of the messages, as of a live cell. Nothing leaves the process."""


@dataclass
class RobotNode:
    """Robot's node on the bus: sends pose, status, command and SYNC; receives offsets and follows them.

    `change_status` replaces the status, with None for no message. `on_message` gets every accepted message of
    the tracker.
    """

    robot: Robot
    bus: BusConnection
    scheduler: Scheduler
    change_status: Callable[[RobotStatus], RobotStatus | None] | None = None
    on_message: Callable[[Received, BusFrame], None] | None = None
    inbox: Inbox = field(default_factory=lambda: Inbox(Trusted(SOURCES, SOURCES)))
    _protector: Protector = field(default_factory=lambda: Protector(SOURCE))
    _sequence: int = 0
    _synced_s: float = 0.0
    _round_trip_us: int | None = None

    name = "robot"

    def __post_init__(self) -> None:
        self.bus.join(self.name, self._hear)
        every = self.scheduler.every
        every(_cycle_s(RobotPosePosition), self._sample, 0.0011)
        every(_cycle_s(RobotStatus), self._send_status, 0.0027)
        every(0.1, self._send_command, 0.0043)
        every(_cycle_s(RobotSync), self._send_sync, 0.0059)

    def report(self) -> RobotReport | None:
        """Return the pose that the robot has reached, as it reports it; None for one that is lost."""
        now_s = self.scheduler.now_s
        self.robot.advance(now_s)
        T_base_tool = self.robot.T_base_tool()
        x, y, z = T_base_tool[:3, 3].tolist()
        quaternion: Quaternion = tuple(Rotation.from_matrix(T_base_tool[:3, :3]).as_quat().tolist())
        return RobotReport((x, y, z), quaternion, SEND_LAG_S)

    def _sample(self) -> None:
        report, due_s = self.report(), self.scheduler.now_s + SEND_LAG_S
        if report is not None:
            self.scheduler.at(due_s, lambda: self._send_pose(report, due_s))

    def _send_pose(self, report: RobotReport, due_s: float) -> None:
        self._send(RobotPosePosition(*report.place_mm, PoseKind.ACTUAL))
        # In real time it may be later than it was to be.
        age_ms = 1000.0 * (report.age_s + self.scheduler.now_s - due_s)
        self._send(
            RobotPoseRotation.from_quaternion(report.quaternion, age_ms if age_ms <= 30.0 else math.nan)
        )

    def _send_status(self) -> None:
        status: RobotStatus | None = self.robot.status
        if self.change_status is not None and status is not None:
            status = self.change_status(status)
        if status is not None:
            self._send(status)

    def _send_command(self) -> None:
        self._send(self.robot.command)

    def _send_sync(self) -> None:
        self._sequence = (self._sequence + 1) % 256
        now_s = self.scheduler.now_s
        self._send(RobotSync(self._sequence, round(1e6 * now_s) % 2**28, self._round_trip_us))
        self._synced_s, self._round_trip_us = now_s, None

    def _send(self, message: BusMessage) -> None:
        self.bus.send(self.name, *self._protector.protect(message))

    def _hear(self, frame: BusFrame) -> None:
        received = self.inbox.receive(as_message(frame, self.scheduler.now_s))
        if received is None:
            return
        if isinstance(received.message, SeamOffset):
            self.robot.advance(self.scheduler.now_s)
            self.robot.hear(received.message, self.scheduler.now_s)
        elif isinstance(received.message, TrackerSyncEcho):
            self._take_echo(received.message)
        if self.on_message is not None:
            self.on_message(received, frame)

    def _take_echo(self, echo: TrackerSyncEcho) -> None:
        if echo.sequence != self._sequence or echo.echo_delay_us is None:
            return
        round_trip_us = round(1e6 * (self.scheduler.now_s - self._synced_s)) - echo.echo_delay_us
        # What a signal cannot carry is unknown: a clock was set, or the bus was slower than any.
        self._round_trip_us = round_trip_us if 0 <= round_trip_us < 65_535 else None


def as_message(frame: BusFrame, timestamp_s: float) -> can.Message:
    """Return a frame as python-can has it."""
    return can.Message(
        timestamp=timestamp_s, arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False
    )


def _cycle_s(message_type: type[BusMessage]) -> float:
    return cycle_time_s(message_layout(message_type.__name__))
