"""The tracker at its place on the bus: the real controller, behind a camera."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from arctrack.control.bus_poses import BusPoses
from arctrack.control.controller import Controller
from arctrack.control.innovation import InnovationLimits
from arctrack.control.job import Job
from arctrack.control.policy import ServicePolicy
from arctrack.control.tracking_service import SeamTracker, SeamTracking, TrackingService
from arctrack.simulation.cell.bus import Bus, BusFrame
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import SOURCE, as_message
from arctrack.simulation.cell.scheduler import Scheduler
from robot_io import BusMessage, Inbox, Protector, SeamGeometry, SeamPoint, Trusted
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
