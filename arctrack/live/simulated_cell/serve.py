"""Simulated robot in real time on a real bus, with its camera; the tracker is another process."""

import errno
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import can

from arctrack.child_process import ChildProcess
from arctrack.errors import ArctrackError
from arctrack.live.simulated_cell.camera import Shot, run_camera
from arctrack.live.simulated_cell.real_time import RealBus, RealTimeScheduler
from arctrack.simulation.cell.bus import BusFrame
from arctrack.simulation.cell.cell import ARMED_S
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import RobotNode
from arctrack.simulation.cell.scheduler import Scheduler
from arctrack.simulation.cell.weld.closed_loop import LoopPlan, setup_of, world_of
from robot_io import Command, OffsetUse, Received, TrackerHeartbeat

REAL_TIME_PX = (320, 240)
"""An image that is rendered in some 25 ms: its offset is not too old for the gate."""

SILENT_S = 0.5
"""Silence after which a tracker is gone."""

NO_ROUTE = (errno.ENODEV, errno.ENETUNREACH)
MULTICAST_CURE = (
    "no network of this machine or container carries multicast. Connect one, or as root: "
    "ip link set lo up; ip route add 224.0.0.0/4 dev lo"
)


def joined_bus(interface: str, channel: str, **bus_options: Any) -> can.BusABC:
    """Return a bus that was joined; ArctrackError, with the cure where one is known, if it cannot be."""
    try:
        return can.Bus(channel, interface=interface, **bus_options)
    except (can.CanError, OSError, ValueError) as error:
        cause = error.__cause__
        if interface == "udp_multicast" and isinstance(cause, OSError) and cause.errno in NO_ROUTE:
            raise ArctrackError(f"--bus {interface}:{channel}: {cause.strerror}; {MULTICAST_CURE}") from None
        raise ArctrackError(f"--bus {interface}:{channel}: {error}") from None


def serve_cell(
    plan: LoopPlan,
    interface: str,
    channel: str,
    frames: str,
    goes_on: Callable[[Robot], bool],
    on_ready: Callable[[], None] | None = None,
    **bus_options: Any,
) -> None:
    """Run the simulated robot and camera while `goes_on` (asked some fifty times a second).

    The plan's tracker part is not used. `interface` and `channel` are python-can's, such as udp_multicast and
    239.74.163.2, as are `bus_options`; `frames` is the name in `arctrack.live.cameras.shared_frames`.
    `on_ready` is called once rendering is compiled. Raises ArctrackError if the bus cannot be joined, or the
    camera ends by itself.
    """
    can_bus = joined_bus(interface, channel, **bus_options)
    camera = ChildProcess(
        run_camera,
        (plan, frames),
        ended=ArctrackError(f"--frames {frames}: the camera ended by itself"),
        ends_s=5.0,
    )
    try:
        camera.receive()
        if on_ready is not None:
            on_ready()
        run_robot(plan, can_bus, camera.send, lambda robot: goes_on(robot) and camera.is_alive)
        if not camera.is_alive:
            raise ArctrackError(f"--frames {frames}: the camera ended")
    finally:
        camera.end(5.0)
        can_bus.shutdown()


class Program:
    """The robot's program: it commands nothing before a tracker's first message, nor after that fell silent.

    TRACK comes ARMED_S after a tracker's first heartbeat, once DISARM is acknowledged. At a part's end, after
    `part_mm`, the tracker is disarmed; once that is acknowledged the next part is there, and all begins
    again.
    """

    def __init__(self, node: RobotNode, scheduler: Scheduler, part_mm: float) -> None:
        self._robot, self._scheduler, self._part_mm = node.robot, scheduler, part_mm
        self._beat_s = self._since_s = -math.inf
        self._is_ended = self._is_disarmed = False
        self._use = OffsetUse()
        node.on_message = self._hear
        scheduler.every(0.02, self._command, 0.0007)

    def _hear(self, received: Received, _frame: BusFrame) -> None:
        now_s = self._scheduler.now_s
        self._use.on_message(received, now_s)
        if isinstance(received.message, TrackerHeartbeat):
            if now_s - self._beat_s > SILENT_S:
                self._since_s = now_s
            self._beat_s = now_s

    def _command(self) -> None:
        now_s = self._scheduler.now_s
        said = self._robot.command
        is_silent = now_s - self._beat_s > SILENT_S
        if said.command is Command.DISARM:
            self._is_disarmed |= self._use.is_disarm_acknowledged(said.request_number, now_s)
        if self._is_ended and (self._is_disarmed or is_silent):
            self._robot.begin_again()
            self._since_s, self._is_ended = now_s, False
        self._is_ended |= self._robot.station_mm >= self._part_mm
        may_track = self._is_disarmed and now_s - self._since_s >= ARMED_S
        if may_track and not (is_silent or self._is_ended):
            self._robot.command = replace(said, command=Command.TRACK)
        elif said.command is not Command.DISARM:
            self._is_disarmed, number = False, (said.request_number + 1) % 256
            self._robot.command = replace(said, command=Command.DISARM, request_number=number)


def run_robot(
    plan: LoopPlan, can_bus: can.BusABC, shoot: Callable[[Shot], None], goes_on: Callable[[Robot], bool]
) -> None:
    """Simulate the robot on a bus while `goes_on`; `shoot` gets its state at each capture."""
    scheduler = RealTimeScheduler()
    bus = RealBus(can_bus, scheduler)
    node = RobotNode(Robot(world_of(plan, setup_of(plan))), bus, scheduler)
    robot = node.robot
    # Coordinates on the bus reach to 1638 mm.
    Program(node, scheduler, min(plan.length_mm, 1500.0))

    def capture() -> None:
        robot.advance(scheduler.now_s)
        shoot(Shot.of(robot, time.monotonic()))

    scheduler.every(1.0 / plan.rate_hz, capture, 0.0037)
    scheduler.run_while(lambda: goes_on(robot), bus.listen)
