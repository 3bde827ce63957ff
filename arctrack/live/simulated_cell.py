"""Simulated robot in real time on a real bus, with its camera; the tracker is another process."""

import errno
import heapq
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any

import can
import numpy as np

from arctrack.child_process import ChildProcess
from arctrack.errors import ArctrackError
from arctrack.live.cameras.camera_line import read_line, remove_line
from arctrack.live.cameras.shared_frames import SharedFramesError, SharedFramesWriter
from arctrack.simulation.cell.bus import BusFrame, Listener
from arctrack.simulation.cell.cell import ARMED_S
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import RobotNode
from arctrack.simulation.cell.scheduler import Scheduler
from arctrack.simulation.cell.weld.closed_loop import LoopPlan, setup_of, world_of
from arctrack.simulation.cell.weld.rendered_camera import RenderedCamera
from robot_io import (
    Command,
    FindAssembler,
    MotionState,
    OffsetUse,
    Received,
    RobotStatus,
    Switch,
    TrackerHeartbeat,
    WeldingState,
)
from tracker.state import Frame

LONGEST_WAIT_S = 0.02
"""Period of checking whether to go on, s."""


class RealTimeScheduler(Scheduler):
    """Does what is due once it is due; its time counts from `began_s` of the machine's monotonic clock."""

    def __init__(self) -> None:
        super().__init__()
        self.began_s = time.monotonic()

    def run_while(self, goes_on: Callable[[], bool], wait: Callable[[float], None]) -> None:
        """Run while `goes_on`; `wait` waits for at most a time, s, and reads the bus."""
        while goes_on():
            self.now_s = time.monotonic() - self.began_s
            while self._heap and self._heap[0][0] <= self.now_s:
                _, _, action = heapq.heappop(self._heap)
                action()
                self.now_s = time.monotonic() - self.began_s
            until_s = self._heap[0][0] - self.now_s if self._heap else LONGEST_WAIT_S
            wait(min(max(until_s, 0.0), LONGEST_WAIT_S))


@dataclass
class RealBus:
    """One node's frames over python-can; echoes of its own frames are dropped.

    `unsent` counts the frames that the bus did not take.
    """

    can_bus: can.BusABC
    scheduler: RealTimeScheduler
    unsent: int = 0
    _listener: Listener | None = None
    _sent: deque[tuple[int, bytes]] = field(default_factory=lambda: deque(maxlen=512))

    def join(self, node: str, listener: Listener) -> None:
        """Deliver what others send to the node."""
        self._listener = listener

    def send(self, sender: str, arbitration_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        try:
            self.can_bus.send(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))
        except can.CanError:
            self.unsent += 1
            return
        self._sent.append((arbitration_id, bytes(data)))

    def listen(self, wait_s: float) -> None:
        """Read what comes within a time, s, at most one frame after it."""
        message = self.can_bus.recv(wait_s)
        if message is None or message.is_error_frame or self._listener is None:
            return
        key = (message.arbitration_id, bytes(message.data))
        if key in self._sent:
            self._sent.remove(key)
            return
        self.scheduler.now_s = time.monotonic() - self.scheduler.began_s
        self._listener(BusFrame("other", *key, self.scheduler.now_s))


@dataclass(frozen=True)
class Shot:
    """State of the robot at a capture.

    `captured_s` is on the machine's monotonic clock, `station_mm` the arc length along the path, `weave_s`
    the time in its weave, `offset_mm` the offset (y, z) that it has reached.
    """

    captured_s: float
    station_mm: float
    weave_s: float
    offset_mm: tuple[float, float]
    status: RobotStatus

    @classmethod
    def of(cls, robot: Robot, captured_s: float) -> "Shot":
        """Return a robot's at a time."""
        y_mm, z_mm = robot.offset_mm.tolist()
        return cls(captured_s, robot.station_mm, robot.weave_s, (y_mm, z_mm), robot.status)


def run_camera(plan: LoopPlan, name: str, shots: Connection) -> None:
    """Publish a frame for each shot that comes, the newest where several wait, until the other end is closed.

    The laser is on unless a tracker drives its line (`arctrack.live.cameras.camera_line`) and lets it be
    off; the exposure is the setup's unless it says another. Once the camera is ready, its kernels
    compiled, it says so over the same connection. ArctrackError if its frames cannot be published.
    """
    setup = setup_of(plan)
    robot = Robot(world_of(plan, setup))
    sensor = RenderedCamera(robot, setup, setup, np.random.default_rng([plan.seed, 1]))
    sensor.look()
    # Before there are frames: a tracker takes the line once it finds them.
    remove_line(name)
    try:
        with SharedFramesWriter(name, *setup.frame_shape, setup.sensor.dtype) as frames:
            shots.send(True)
            _publish(shots, sensor, frames, name)
    except SharedFramesError as error:
        raise ArctrackError(f"--frames {name}: {error}") from None
    finally:
        remove_line(name)


def _publish(shots: Connection, sensor: RenderedCamera, frames: SharedFramesWriter, name: str) -> None:
    robot, index = sensor.robot, 0
    while True:
        try:
            shot = shots.recv()
            while shots.poll():
                shot = shots.recv()
        except (EOFError, ConnectionResetError):
            return
        robot.station_mm, robot.weave_s = shot.station_mm, shot.weave_s
        robot.offset_mm, robot.status = np.array(shot.offset_mm), shot.status
        wanted = read_line(name)
        sensor.is_laser_on, sensor.exposure_s = time.monotonic() < wanted.laser_until_s, wanted.exposure_s
        image_dn = sensor.look()
        assert image_dn is not None
        frames.publish(
            Frame(
                index=index,
                timestamp_s=shot.captured_s,
                image_dn=image_dn,
                exposure_s=sensor.setup.camera.exposure_s
                if math.isnan(sensor.exposure_s)
                else sensor.exposure_s,
                current_a=shot.status.current_a,
                laser_on=sensor.is_laser_on,
                arc_on=shot.status.arc is Switch.ON,
            )
        )
        index += 1


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
    again. A robot that `finds_first` stands without an arc, and asks by FIND until a joint is found.
    """

    def __init__(
        self, node: RobotNode, scheduler: Scheduler, part_mm: float, finds_first: bool = False
    ) -> None:
        self._robot, self._scheduler, self._part_mm = node.robot, scheduler, part_mm
        self._finds, self._is_found = FindAssembler(), not finds_first
        self._welds = self._robot.status
        if finds_first:
            self._robot.status = replace(
                self._welds, motion=MotionState.STOPPED, welding=WeldingState.OFF, arc=Switch.OFF
            )
        self._beat_s = self._since_s = -math.inf
        self._is_ended = self._is_disarmed = False
        self._use = OffsetUse()
        node.on_message = self._hear
        scheduler.every(0.02, self._command, 0.0007)

    def _hear(self, received: Received, _frame: BusFrame) -> None:
        now_s = self._scheduler.now_s
        self._use.on_message(received, now_s)
        answer = self._finds.push(received)
        if answer is not None and answer.is_found:
            self._is_found, self._robot.status = True, self._welds
        elif answer is not None and self._robot.command.command is Command.FIND:
            self._ask()
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
            if self._is_found:
                self._robot.command = replace(said, command=Command.TRACK)
            elif said.command is not Command.FIND:
                self._ask()
        elif said.command is not Command.DISARM:
            self._is_disarmed, number = False, (said.request_number + 1) % 256
            self._robot.command = replace(said, command=Command.DISARM, request_number=number)

    def _ask(self) -> None:
        """Command FIND with a new number."""
        said = self._robot.command
        number = (said.request_number + 1) % 256
        self._robot.command = replace(said, command=Command.FIND, request_number=number)


def run_robot(
    plan: LoopPlan, can_bus: can.BusABC, shoot: Callable[[Shot], None], goes_on: Callable[[Robot], bool]
) -> None:
    """Simulate the robot on a bus while `goes_on`; `shoot` gets its state at each capture."""
    scheduler = RealTimeScheduler()
    bus = RealBus(can_bus, scheduler)
    node = RobotNode(Robot(world_of(plan, setup_of(plan))), bus, scheduler)
    robot = node.robot
    # Coordinates on the bus reach to 1638 mm.
    Program(node, scheduler, min(plan.length_mm, 1500.0), plan.finds_first)

    def capture() -> None:
        robot.advance(scheduler.now_s)
        shoot(Shot.of(robot, time.monotonic()))

    scheduler.every(1.0 / plan.rate_hz, capture, 0.0037)
    scheduler.run_while(lambda: goes_on(robot), bus.listen)
