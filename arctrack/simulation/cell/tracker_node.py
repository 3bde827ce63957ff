"""The tracker at its place on the bus: the real controller, behind a camera."""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np

from arctrack.control.bus_poses import BusPoses
from arctrack.control.controller import Controller
from arctrack.control.innovation import InnovationLimits
from arctrack.control.job import Job
from arctrack.control.policy import ServicePolicy
from arctrack.control.tracking_service import SeamTracker, TrackingService
from arctrack.simulation.cell.bus import Bus, BusFrame
from arctrack.simulation.cell.disk import Disk
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import SOURCE, as_message
from arctrack.simulation.cell.scheduler import Scheduler
from arctrack.simulation.cell.simulated_camera import COMPUTED_S, Shown, SimulatedCamera
from robot_io import BusMessage, Inbox, Protector, SeamGeometry, SeamOffset, SeamPoint, Trusted
from robot_io.link.reconnecting import LinkFault
from robot_io.link.steady_log import SteadyLog
from robot_io.poses.nominal_path import NominalPath
from robot_io.poses.plausibility_limits import PlausibilityLimits
from tracker.state import Track

FRAME_PERIOD_S, EXPOSED_S = 0.02, 0.002
"""The camera's period, and the time from mid-exposure to the end of an exposure, s."""


class CameraBehaviour(Enum):
    """Behaviour of the camera."""

    RIGHT = "right"
    STOPPED = "stopped"
    FROZEN = "frozen"
    GARBAGE = "garbage"
    DROPPING = "dropping"
    GHOST = "ghost"


@dataclass
class TrackerNode:
    """Tracker's node on the bus: runs the controller on a clock that is `clock_s` ahead of the true time.

    While not `is_running`, messages wait in the bus' buffer; while `queue_full`, nothing goes out. `faults`
    counts what went wrong without ending the run, `said` is what it told its user. `captured` maps times on
    the tracker's clock to the frames' capture times, s. `on_track` gets each track and what was sent of it.
    """

    robot: Robot
    bus: Bus
    scheduler: Scheduler
    rng: np.random.Generator
    job: Job
    camera: SimulatedCamera
    frame_period_s: float = FRAME_PERIOD_S
    clock_s: float = 0.0
    behaviour: CameraBehaviour = CameraBehaviour.RIGHT
    is_running: bool = True
    queue_full: bool = False
    disk: Disk = field(default_factory=Disk)
    faults: Counter[LinkFault] = field(default_factory=Counter)
    said: list[str] = field(default_factory=list)
    ghost_mm: float = 2.0
    captured: dict[float, float] = field(default_factory=dict)
    on_sent: Callable[[BusMessage], None] | None = None
    on_track: Callable[[Track, list[BusMessage]], None] | None = None

    name = "tracker"

    def __post_init__(self) -> None:
        self.inbox = Inbox(Trusted((SOURCE,), (SOURCE,)))
        self.path: NominalPath = self.robot.world.path
        self._shown: Shown = None
        self._has_shown = False
        self._waiting: deque[tuple[BusFrame, float]] = deque()
        self._index = 0
        self._log = SteadyLog(
            Path("bus.blf"), self.faults, self.disk.open, lambda: self.scheduler.now_s, self.said.append
        )
        self.poses = BusPoses(self.path, PlausibilityLimits(), InnovationLimits(), ServicePolicy())
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
        self._waiting.clear()

    @property
    def now_s(self) -> float:
        """The time on the tracker's clock, s."""
        return self.scheduler.now_s + self.clock_s

    def resume(self) -> None:
        """Let the process run on: first it reads what waits."""
        self.is_running = True
        while self._waiting:
            frame, came_s = self._waiting.popleft()
            self._read(frame, came_s)

    def _hear(self, frame: BusFrame) -> None:
        if self.is_running:
            self._read(frame, self.now_s)
        else:
            self._waiting.append((frame, self.now_s))

    def _read(self, frame: BusFrame, came_s: float) -> None:
        now_s = self.now_s
        message = as_message(frame, came_s)
        self._log.write(message)
        received = self.inbox.receive(message, max_age_s=now_s - came_s)
        if received is not None:
            self.service.hear(received)

    def _capture(self) -> None:
        behaviour = self.behaviour
        if behaviour is CameraBehaviour.STOPPED or (
            behaviour is CameraBehaviour.DROPPING and self.rng.random() < 0.1
        ):
            return
        true_s, captured_s = self.scheduler.now_s, self.now_s
        self.robot.advance(true_s)
        if behaviour is not CameraBehaviour.FROZEN or not self._has_shown:
            self._shown = self.camera.look(self.ghost_mm if behaviour is CameraBehaviour.GHOST else 0.0)
            self._has_shown = True
        shown = self.camera.garbage() if behaviour is CameraBehaviour.GARBAGE else self._shown
        self.scheduler.at(
            true_s + EXPOSED_S + COMPUTED_S * self.rng.uniform(0.8, 1.2),
            lambda: self._track(shown, true_s, captured_s),
        )

    def _track(self, shown: Shown, true_s: float, captured_s: float) -> None:
        if not self.is_running:
            return
        self.captured[captured_s] = true_s
        self._index += 1
        outcome = self.service.track(shown, self._index, captured_s)
        if self.on_track is not None:
            self.on_track(outcome.tracked.track, outcome.messages)

    def _poll(self) -> None:
        if self.is_running:
            self.service.poll()

    def _put(self, message: BusMessage) -> bool:
        if self.queue_full:
            return False
        # Messages that this robot does not read, which are not sent: it would take a fifth of the time.
        if isinstance(message, (SeamPoint, SeamGeometry)):
            return True
        if isinstance(message, SeamOffset) and self.on_sent is not None:
            self.on_sent(message)
        arbitration_id, data = self._protector.protect(message)
        self.bus.send(self.name, arbitration_id, data)
        self._log.write(as_message(BusFrame(self.name, arbitration_id, data, self.now_s), self.now_s))
        return True
