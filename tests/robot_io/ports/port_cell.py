"""The simulated cell with its robot behind a port: a vendor's bytes on a wire that may fail."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from vendor_robots import ROBOTS, Said, UrRobot

from arctrack.simulation.cell.bus import BusFrame
from arctrack.simulation.cell.robot_node import RobotNode, as_message
from robot_io import MotionState, SeamOffset, Switch, Validity
from robot_io.ports.egm.dialect import EgmDialect
from robot_io.ports.report import PortError
from robot_io.ports.rsi.dialect import RsiDialect
from robot_io.ports.rtde.dialect import RtdeDialect
from robot_io.ports.session import RobotSession
from robot_io.ports.tcp_json.dialect import JsonDialect
from validation.fault_schedules.faulty_bus import FaultyBus
from validation.fault_schedules.judged_cell import JudgedCell

DIALECTS = {"tcp_json": JsonDialect, "egm": EgmDialect, "rsi": RsiDialect, "rtde": RtdeDialect}
WIRE_S = 0.0003
BEGAN_S = 5000.0


def connected(interface: str):
    """Return a vendor's robot and the dialect that speaks to it, after their handshake."""
    robot, dialect = ROBOTS[interface](), DIALECTS[interface]()
    if isinstance(robot, UrRobot):
        asked = dialect.greeting()
        while not robot.started:
            asked = dialect.hear(robot.hear(asked)[0])[1]
        dialect.hear(robot.hear(asked)[0])
    elif interface == "tcp_json":
        assert dialect.hear(robot.hello)[1] == b'{"hello":"arctrack","version":1}\n'
    return robot, dialect


@dataclass
class PortNode(RobotNode):
    """A robot's node whose frames come from a port.

    `on_wire` gets each of the robot's datagrams, and returns those that come and how late each is, s.
    `clock_s` is added to the robot's clock. `applied` has time, displacement and whether it counts.
    """

    interface: str = "egm"
    on_wire: Callable[[bytes], list[tuple[bytes, float]]] = lambda data: [(data, 0.0)]
    clock_s: float = 0.0
    is_silent: bool = False
    applied: list[tuple[float, float, float, bool]] = field(default_factory=list)
    refused: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.bus.join(self.name, self._from_tracker)
        self.session = RobotSession()
        self.connect()
        self.scheduler.every(self.vendor.cycle_s, self._speak, 0.0011)

    def connect(self) -> None:
        self.vendor, self.dialect = connected(self.interface)
        self.session.begin()

    # What a robot on CAN sends by itself; its port sends it here.
    def _sample(self) -> None:
        pass

    _send_status = _send_command = _send_sync = _sample

    def _speak(self) -> None:
        if self.is_silent:
            return
        pose = self.report()
        if pose is None:
            return
        now_s, status = self.scheduler.now_s, self.robot.status
        said = Said(
            time_s=BEGAN_S + self.clock_s + now_s,
            place_mm=pose.place_mm,
            quaternion=pose.quaternion,
            command=int(self.robot.command.command),
            correction=status.correction is Switch.ON,
            arc=status.arc is Switch.ON,
            moving=status.motion is MotionState.MOVING,
            stopped=status.emergency_stop is Switch.ON,
        )
        for data, late_s in self.on_wire(self.vendor.report(said)):
            self.scheduler.at(now_s + WIRE_S + late_s, lambda data=data: self._to_port(data))

    def _to_port(self, data: bytes) -> None:
        now_s = self.scheduler.now_s
        try:
            reports, _ = self.dialect.hear(data)
        except PortError:
            self.refused += 1
            if self.interface in ("tcp_json", "rtde"):
                # The stream is closed, and the robot connects again.
                self.connect()
            return
        for report in reports:
            frames = self.session.take(report, now_s)
            if frames is None:
                continue
            correction = self.session.correction(report, now_s)
            for frame in frames:
                self.bus.send(self.name, *frame)
            answer = b"" if correction is None else self.dialect.answer(report, correction)
            if answer:
                self.scheduler.at(now_s + WIRE_S, lambda answer=answer: self._apply(answer))

    def _apply(self, answer: bytes) -> None:
        now_s = self.scheduler.now_s
        self.robot.advance(now_s)
        for y_mm, z_mm, counts in self.vendor.read(answer):
            self.applied.append((now_s, y_mm, z_mm, counts))
            if counts or self.interface == "rsi":
                self.robot.hear(SeamOffset(y_mm, z_mm, math.nan, 1.0, Validity.VALID), now_s)

    def _from_tracker(self, frame: BusFrame) -> None:
        now_s = self.scheduler.now_s
        self.session.hear(as_message(frame, now_s), now_s, now_s - frame.sent_s)
        self._hear(frame)

    def usable_s(self, from_s: float = 0.0, to_s: float = math.inf) -> list[float]:
        """Return when displacements came that count."""
        return [time_s for time_s, _, _, counts in self.applied if counts and from_s <= time_s < to_s]


def port_cell(world, rng, interface: str) -> JudgedCell:
    class PortCell(JudgedCell):
        def _make_robot(self, robot):
            bus = FaultyBus(self.scheduler, self.rng)
            return bus, PortNode(robot, bus, self.scheduler, interface=interface)

    return PortCell(world, rng)
