"""A cell in which faults happen, and what is watched while it runs."""

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from arctrack.simulation.cell.bus import Bus, BusFrame
from arctrack.simulation.cell.cell import Cell, SimulatedCamera, TrackerNode
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import RobotNode
from arctrack.simulation.cell.world import World
from robot_io import GateReason, Received, SeamOffset, TrackerStatus, Validity
from validation.fault_schedules.faulty_bus import FaultyBus
from validation.fault_schedules.faulty_robot import FaultyRobotNode
from validation.fault_schedules.faulty_tracker import FaultyTracker
from validation.fault_schedules.measuring_camera import MeasuringCamera

USABLE = (Validity.VALID, Validity.HELD)


@dataclass(frozen=True)
class ReceivedOffset:
    """Offset that reached the robot.

    `true_capture_s` is the true capture time of its frame, NaN where it is refused.
    """

    sent_s: float
    came_s: float
    true_capture_s: float
    offset: SeamOffset


class JudgedCell(Cell):
    """One run of a simulated cell with a camera that measures the seam without a picture.

    `received` has every offset of the tracker that reached the robot; `reasons` has the time, s, and gate
    reason of each TrackerStatus that did; `torch_error_mm` has the torch's distance from the seam by time.
    """

    bus: FaultyBus
    robot: FaultyRobotNode
    tracker: FaultyTracker

    def __init__(self, world: World, rng: np.random.Generator) -> None:
        super().__init__(world, rng, lambda robot: MeasuringCamera(robot, rng), 0.02)
        self.received: list[ReceivedOffset] = []
        self.reasons: list[tuple[float, GateReason]] = []
        self.torch_error_mm: list[tuple[float, float]] = []
        self._captured: dict[float, float] = {}
        self.robot.on_message = self._on_message
        self.tracker.on_sent = self._on_sent
        self.scheduler.every(0.02, self._measure_error, 0.0007)

    def _make_robot(self, robot: Robot) -> tuple[Bus, RobotNode]:
        bus = FaultyBus(self.scheduler, self.rng)
        return bus, FaultyRobotNode(robot, bus, self.scheduler)

    def _make_tracker(self, robot: Robot, camera: SimulatedCamera, frame_period_s: float) -> TrackerNode:
        assert isinstance(camera, MeasuringCamera)
        return FaultyTracker(robot, self.bus, self.scheduler, self.rng, self.job, camera, frame_period_s)

    def validities(self, from_s: float, to_s: float) -> Counter[Validity]:
        """Return the count of each validity of offsets sent between two times, s, that reached the robot."""
        return Counter(h.offset.validity for h in self.received if from_s <= h.sent_s < to_s)

    def _measure_error(self) -> None:
        robot = self.robot.robot
        robot.advance(self.scheduler.now_s)
        off_mm = robot.offset_mm - np.array(self.world.seam_mm(robot.station_mm))
        self.torch_error_mm.append((self.scheduler.now_s, math.hypot(*off_mm)))

    def _on_sent(self, offset: SeamOffset) -> None:
        true_s = math.nan
        if offset.validity in USABLE and self.tracker.captured:
            captured_s = self.tracker.now_s - offset.capture_age_ms / 1000.0
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
