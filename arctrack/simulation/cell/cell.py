"""Robot, tracker and bus behind one scheduler, and what is watched while they run."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from arctrack.control.job import Bridging, Job
from arctrack.simulation.cell.bus import Bus, BusFrame
from arctrack.simulation.cell.measuring_camera import MeasuringCamera
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import RobotNode
from arctrack.simulation.cell.scheduler import Scheduler
from arctrack.simulation.cell.simulated_camera import SimulatedCamera
from arctrack.simulation.cell.tracker_node import FRAME_PERIOD_S, TrackerNode
from arctrack.simulation.cell.world import World
from robot_io import BusMessage, Command, GateReason, Received, SeamOffset, TrackerStatus, Validity

ARMED_S = 0.2
"""Time at which the robot commands TRACK."""

BRIDGE_MM = 20.0
"""Distance that the job lets a tracker go without a joint."""

USABLE = (Validity.VALID, Validity.HELD)

TORCH_MM = 0.5
"""Largest distance of the torch from the seam at a run's end."""


@dataclass(frozen=True)
class ReceivedOffset:
    """Offset that reached the robot.

    `true_capture_s` is the true capture time of its frame, NaN where it is refused.
    """

    sent_s: float
    came_s: float
    true_capture_s: float
    offset: SeamOffset


class Cell:
    """One run of a simulated cell.

    `make_camera` makes the camera at a robot's tool, by default one that measures the seam without a picture.
    `make_node` makes the robot's node, by default one on CAN.
    `received` has every offset of the tracker that reached the robot; `reasons` has the time, s, and gate
    reason of each TrackerStatus that did; `torch_error_mm` has the torch's distance from the seam by time.
    """

    def __init__(
        self,
        world: World,
        rng: np.random.Generator,
        make_camera: Callable[[Robot], SimulatedCamera] | None = None,
        frame_period_s: float = FRAME_PERIOD_S,
        make_node: Callable[[Robot, Bus, Scheduler], RobotNode] = RobotNode,
    ) -> None:
        self.rng = rng
        ahead_tool_mm = (world.look_ahead_mm, 0.0, 0.0)
        bridging = Bridging(world.path, ahead_tool_mm, BRIDGE_MM)
        self.job = Job("lap", poses_proven=True, bridging=bridging)
        self.scheduler = Scheduler()
        self.bus = Bus(self.scheduler, rng)
        self.robot = make_node(Robot(world), self.bus, self.scheduler)
        robot = self.robot.robot
        camera = MeasuringCamera(robot, rng) if make_camera is None else make_camera(robot)
        self.tracker = TrackerNode(robot, self.bus, self.scheduler, rng, self.job, camera, frame_period_s)
        self.received: list[ReceivedOffset] = []
        self.reasons: list[tuple[float, GateReason]] = []
        self.torch_error_mm: list[tuple[float, float]] = []
        self._captured: dict[float, float] = {}
        self.robot.on_message = self._on_message
        self.tracker.on_sent = self._on_sent
        self.scheduler.at(ARMED_S, lambda: self.command(Command.TRACK))
        self.scheduler.every(0.02, self._measure_error, 0.0007)

    @property
    def world(self) -> World:
        """Present state of the world."""
        return self.robot.robot.world

    @world.setter
    def world(self, world: World) -> None:
        self.robot.robot.world = world

    def command(self, command: Command, is_new_request: bool = False) -> None:
        """Let the robot want something else of the tracker."""
        wanted = self.robot.robot.command
        number = (wanted.request_number + is_new_request) % 256
        self.robot.robot.command = replace(wanted, command=command, request_number=number)

    def run(self, until_s: float) -> None:
        """Run to a time, s."""
        self.scheduler.run(until_s)

    def _measure_error(self) -> None:
        robot = self.robot.robot
        robot.advance(self.scheduler.now_s)
        off_mm = robot.offset_mm - np.array(self.world.seam_mm(robot.station_mm))
        self.torch_error_mm.append((self.scheduler.now_s, math.hypot(*off_mm)))

    def _on_sent(self, message: BusMessage) -> None:
        assert isinstance(message, SeamOffset)
        true_s = math.nan
        if message.validity in USABLE and self.tracker.captured:
            captured_s = self.tracker.now_s - message.capture_age_ms / 1000.0
            nearest = min(self.tracker.captured, key=lambda time_s: abs(time_s - captured_s))
            true_s = self.tracker.captured[nearest]
        self._captured[self.scheduler.now_s] = true_s

    def _on_message(self, received: Received, frame: BusFrame) -> None:
        if frame.sender != self.tracker.name:
            return
        now_s = self.scheduler.now_s
        if isinstance(received.message, SeamOffset):
            true_s = self._captured.get(frame.sent_s, math.nan)
            self.received.append(ReceivedOffset(frame.sent_s, now_s, true_s, received.message))
        elif isinstance(received.message, TrackerStatus):
            self.reasons.append((now_s, received.message.gate_reason))

    def validities(self, from_s: float, to_s: float) -> Counter[Validity]:
        """Return the count of each validity of offsets sent between two times, s, that reached the robot."""
        return Counter(h.offset.validity for h in self.received if from_s <= h.sent_s < to_s)
