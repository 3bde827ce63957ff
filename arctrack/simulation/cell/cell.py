"""Robot, tracker and bus behind one scheduler."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from arctrack.control.bus_poses import BusPoses
from arctrack.control.controller import Controller
from arctrack.control.innovation import InnovationLimits
from arctrack.control.job import Bridging, Job
from arctrack.control.policy import ServicePolicy
from arctrack.control.tracking_service import SeamTracker, SeamTracking, TrackingService
from arctrack.simulation.cell.bus import Bus, BusFrame
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import SOURCE, RobotNode, as_message
from arctrack.simulation.cell.scheduler import Scheduler
from arctrack.simulation.cell.world import World
from robot_io import BusMessage, Command, Inbox, Protector, SeamGeometry, SeamPoint, Trusted
from robot_io.poses.plausibility_limits import PlausibilityLimits
from tracker.state import Track

EXPOSED_S, COMPUTED_S = 0.002, 0.012
"""Time from mid-exposure to the end of an exposure, and duration of a track, s: the same on every machine."""

Shown = npt.NDArray[Any] | None
"""Content of a frame: an image, or where a camera without a picture saw the seam; None for nothing."""


class SimulatedCamera(SeamTracking[Shown], Protocol):
    """A camera at the robot's tool, and the tracking behind it."""

    def look(self) -> Shown:
        """Return the camera's present frame."""


@dataclass
class TrackerNode:
    """Tracker's node on the bus; `on_track` gets each track and what was sent of it."""

    robot: Robot
    bus: Bus
    scheduler: Scheduler
    rng: np.random.Generator
    job: Job
    camera: SimulatedCamera
    frame_period_s: float
    on_track: Callable[[Track, list[BusMessage]], None] | None = None
    name = "tracker"

    def __post_init__(self) -> None:
        self.inbox = Inbox(Trusted((SOURCE,), (SOURCE,)))
        self._index = 0
        path = self.robot.world.path
        self.poses = BusPoses(path, PlausibilityLimits(), InnovationLimits(), ServicePolicy())
        self._begin_bus()
        self.bus.join(self.name, self._hear)
        self.scheduler.every(self.frame_period_s, self._capture, 0.0037)
        self.scheduler.every(0.01, self._poll, 0.0041)

    def start(self) -> None:
        """Begin as a new process."""
        self._begin_bus()
        self.camera.begin()

    def _begin_bus(self) -> None:
        self._protector = Protector(SOURCE)
        self.controller = Controller(self.job, SOURCE)
        self.poses.begin()
        self.service = TrackingService[Shown](
            self.controller, SeamTracker(self.poses, self.camera), self._put, lambda: self.now_s
        )

    @property
    def now_s(self) -> float:
        """The time on the tracker's clock, s."""
        return self.scheduler.now_s

    def _hear(self, frame: BusFrame) -> None:
        self._read(frame, self.now_s)

    def _read(self, frame: BusFrame, came_s: float) -> None:
        received = self.inbox.receive(as_message(frame, came_s), max_age_s=self.now_s - came_s)
        if received is not None:
            self.service.hear(received)

    def _capture(self) -> None:
        self.robot.advance(self.scheduler.now_s)
        self._take(self.camera.look())

    def _take(self, shown: Shown) -> None:
        """Track a frame once it is exposed and computed."""
        captured_s = self.now_s
        self.scheduler.at(
            self.scheduler.now_s + EXPOSED_S + COMPUTED_S * self.rng.uniform(0.8, 1.2),
            lambda: self._track(shown, captured_s),
        )

    def _track(self, shown: Shown, captured_s: float) -> None:
        self._index += 1
        outcome = self.service.track(shown, self._index, captured_s)
        if self.on_track is not None:
            self.on_track(outcome.tracked.track, outcome.messages)

    def _poll(self) -> None:
        self.service.poll()

    def _put(self, message: BusMessage) -> bool:
        # Messages that this robot does not read, which are not sent: it would take a fifth of the time.
        if not isinstance(message, (SeamPoint, SeamGeometry)):
            self._send(*self._protector.protect(message))
        return True

    def _send(self, arbitration_id: int, data: bytes) -> None:
        self.bus.send(self.name, arbitration_id, data)


ARMED_S = 0.2
"""Time at which the robot commands TRACK."""

BRIDGE_MM = 20.0
"""Distance that the job lets a tracker go without a joint."""

TORCH_MM = 0.5
"""Largest distance of the torch from the seam at a run's end."""


class Cell:
    """One run of a simulated cell; `make_camera` makes the camera at a robot's tool.

    Without `bridge_mm` the tracker may go without a joint for as long as it likes.
    """

    def __init__(
        self,
        world: World,
        rng: np.random.Generator,
        make_camera: Callable[[Robot], SimulatedCamera],
        frame_period_s: float,
        bridge_mm: float | None = BRIDGE_MM,
    ) -> None:
        self.rng = rng
        bridging = None
        if bridge_mm is not None:
            bridging = Bridging(world.path, (world.look_ahead_mm, 0.0, 0.0), bridge_mm)
        self.job = Job("lap", poses_proven=True, bridging=bridging)
        self.scheduler = Scheduler()
        robot = Robot(world)
        self.bus, self.robot = self._make_robot(robot)
        self.tracker = self._make_tracker(robot, make_camera(robot), frame_period_s)
        self.scheduler.at(ARMED_S, lambda: self.command(Command.TRACK))

    def _make_robot(self, robot: Robot) -> tuple[Bus, RobotNode]:
        """Return a bus with the robot's node."""
        bus = Bus(self.scheduler, self.rng)
        return bus, RobotNode(robot, bus, self.scheduler)

    def _make_tracker(self, robot: Robot, camera: SimulatedCamera, frame_period_s: float) -> TrackerNode:
        """Return the tracker's node."""
        return TrackerNode(robot, self.bus, self.scheduler, self.rng, self.job, camera, frame_period_s)

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
