"""The tracker at its place on the bus: the real controller, behind a camera that measures a seam at once."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from arctrack.cell.bus import Bus, Frame
from arctrack.cell.robot import Robot
from arctrack.cell.robot_party import SOURCE, as_message
from arctrack.cell.scheduler import Scheduler
from arctrack.service.controller import Controller, Job
from arctrack.service.policy import ServicePolicy
from arctrack.service.pose_watch import PoseWatch
from noise_model.arrays import Float64
from robot_io import (
    BusMessage,
    Inbox,
    PoseBuffer,
    PoseError,
    PoseStatus,
    Protector,
    SeamGeometry,
    SeamOffset,
    SeamPoint,
    Trusted,
)
from robot_io.clocks.sync import SyncLimits
from robot_io.poses.nominal_path import NominalPath
from robot_io.poses.plausibility_limits import PlausibilityLimits
from tracker import flags
from tracker.seam.gaussian_process import SeamHistory
from tracker.seam.innovation import InnovationLimits, SeamMeasured
from tracker.state import Track

FRAME_PERIOD_S, EXPOSED_S, COMPUTED_S = 0.02, 0.002, 0.012
"""The camera's period, from mid-exposure to its end, and what a track takes, s."""

POLL_S = 0.01
UNHEARD = (SeamPoint, SeamGeometry)
"""What this robot does not listen to is not sent: it would take a fifth of the time."""

TOLERANCE_MM = 0.25


class Camera(Enum):
    """What the camera does."""

    RIGHT = "right"
    STOPPED = "stopped"
    FROZEN = "frozen"
    GARBAGE = "garbage"
    DROPPING = "dropping"
    GHOST = "ghost"


@dataclass(frozen=True)
class Capture:
    """A frame: when it was taken, truly and on the tracker's clock, and what it shows."""

    true_s: float
    captured_s: float
    seam_tool_mm: Float64 | None


@dataclass
class TrackerParty:
    """Runs the controller on a clock of its own.

    Attributes
    ----------
    clock_s : float
        How far its clock is ahead of the true time, s.
    camera : Camera
        What the camera does.
    is_running : bool
        Whether the process runs: what comes meanwhile waits in the bus' buffer.
    queue_full : bool
        Whether nothing that is sent goes out.
    """

    robot: Robot
    bus: Bus
    scheduler: Scheduler
    rng: np.random.Generator
    job: Job
    clock_s: float = 0.0
    camera: Camera = Camera.RIGHT
    is_running: bool = True
    queue_full: bool = False
    ghost_mm: float = 2.0
    captured: dict[float, float] = field(default_factory=dict)
    on_sent: Callable[[BusMessage], None] | None = None

    name = "tracker"

    def __post_init__(self) -> None:
        self.inbox = Inbox(Trusted((SOURCE,), (SOURCE,)))
        self.path: NominalPath = self.robot.world.path
        self._shown: Float64 | None = None
        self._waiting: deque[tuple[Frame, float]] = deque()
        self._index = 0
        self.start()
        self.bus.join(self.name, self._hear)
        self.scheduler.every(FRAME_PERIOD_S, self._capture, 0.0037)
        self.scheduler.every(POLL_S, self._poll, 0.0041)

    def start(self) -> None:
        """Begin as a new process."""
        self._protector = Protector(SOURCE)
        self.controller = Controller(self.job, SOURCE)
        self.watch = PoseWatch(
            self.path, PlausibilityLimits(), InnovationLimits(), SyncLimits(), ServicePolicy().status_age_s
        )
        self._poses = PoseBuffer(256)
        self.history = self._searched()
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

    def _searched(self) -> SeamHistory:
        """Return what a search pass left: the stretch that the torch begins on."""
        history, world = SeamHistory(), self.robot.world
        start_mm = self.robot.station_mm
        for station_mm in np.arange(start_mm - 5.0, start_mm + world.look_ahead_mm, 1.5):
            seam_mm = np.array(world.seam_mm(float(station_mm))) + self.rng.normal(0.0, world.noise_mm, 2)
            history = history.with_measurement(float(station_mm), seam_mm, np.full(2, world.noise_mm**2))
        return history

    def _hear(self, frame: Frame) -> None:
        if self.is_running:
            self._read(frame, self.now_s)
        else:
            self._waiting.append((frame, self.now_s))

    def _read(self, frame: Frame, came_s: float) -> None:
        now_s = self.now_s
        received = self.inbox.receive(as_message(frame, came_s), max_age_s=now_s - came_s)
        if received is None:
            return
        sample = self.watch.hear(received, now_s)
        if sample is not None:
            try:
                self._poses.push_quaternion(
                    sample.timestamp_s, sample.position_base_mm, sample.quaternion_xyzw
                )
            except PoseError:
                # A clock was set: what is older says nothing of now.
                self._poses = PoseBuffer(256)
        self.controller.on_poses(self.watch.verdict(now_s), now_s)
        self._send(self.controller.on_message(received, now_s))

    def _capture(self) -> None:
        camera = self.camera
        if camera is Camera.STOPPED or (camera is Camera.DROPPING and self.rng.random() < 0.1):
            return
        now_s = self.scheduler.now_s
        self.robot.advance(now_s)
        if camera is not Camera.FROZEN or self._shown is None:
            self._shown = self._seen(self.ghost_mm if camera is Camera.GHOST else 0.0)
        shown = None if camera is Camera.GARBAGE else self._shown
        capture = Capture(now_s, self.now_s, shown)
        self.scheduler.at(
            now_s + EXPOSED_S + COMPUTED_S * self.rng.uniform(0.8, 1.2), lambda: self._track(capture)
        )

    def _seen(self, off_mm: float) -> Float64:
        """Return where the stripe meets the seam, (3,) mm, in the frame of the true tool."""
        world = self.robot.world
        station_mm = self.robot.station_mm + world.look_ahead_mm
        y_mm, z_mm = world.seam_mm(station_mm)
        x, y, z = world.start_base_mm
        seam_base_mm = np.array([x + station_mm, y + y_mm + off_mm, z + z_mm])
        seam_tool = world.R_base_tool.T @ (seam_base_mm - self.robot.place_mm())
        return np.asarray(seam_tool + np.array([0.0, *self.rng.normal(0.0, world.noise_mm, 2)]))

    def _track(self, capture: Capture) -> None:
        if not self.is_running:
            return
        now_s = self.now_s
        self.captured[capture.captured_s] = capture.true_s
        self._index += 1
        pose = self._poses.at(capture.captured_s)
        trusted = self.watch.doubt(now_s) is None
        if pose.status is PoseStatus.REFUSED:
            track = Track(self._index, capture.captured_s, flags.POSE_REFUSED.mask)
        elif capture.seam_tool_mm is None:
            track = self._tracked(capture, pose.T_base_tool, flags.JOINT_NOT_FOUND.mask)
        else:
            self._measure(capture.seam_tool_mm, pose.T_base_tool, trusted)
            track = self._tracked(capture, pose.T_base_tool, 0)
        self.controller.on_poses(self.watch.verdict(now_s), now_s)
        self._send(self.controller.on_track(track, now_s, pose.T_base_tool, 1000.0 * COMPUTED_S))

    def _measure(self, seam_tool_mm: Float64, T_base_tool: Float64, trusted: bool) -> None:
        """Take a measurement into the seam; not of a pose that is doubted, which the watch alone must see."""
        seam_base = T_base_tool[:3, :3] @ seam_tool_mm + T_base_tool[:3, 3]
        x, y, z = seam_base.tolist()
        place = self.path.place((x, y, z))
        displacement = (place.lateral_mm, place.height_mm)
        noise_mm = self.robot.world.noise_mm
        self.watch.see(SeamMeasured(place.station_mm, displacement, (noise_mm, noise_mm)))
        if trusted:
            self.history = self.history.with_measurement(
                place.station_mm, np.array(displacement), np.full(2, noise_mm**2)
            )

    def _tracked(self, capture: Capture, T_base_tool: Float64, flag_bits: int) -> Track:
        x, y, z = T_base_tool[:3, 3].tolist()
        displacement, sigma = self.history.at(self.path.place((x, y, z)).station_mm)
        y_mm, z_mm = displacement.tolist()
        sigma_y_mm, sigma_z_mm = sigma.tolist()
        seam_tool = (math.nan,) * 3 if capture.seam_tool_mm is None else tuple(capture.seam_tool_mm.tolist())
        noise_mm = self.robot.world.noise_mm
        within = TOLERANCE_MM / math.sqrt(2.0)
        return Track(
            self._index,
            capture.captured_s,
            flag_bits,
            seam_tool_mm=seam_tool,
            sigma_y_mm=noise_mm,
            sigma_z_mm=noise_mm,
            offset_y_mm=y_mm,
            offset_z_mm=z_mm,
            offset_sigma_y_mm=sigma_y_mm,
            offset_sigma_z_mm=sigma_z_mm,
            offset_confidence=math.erf(within / sigma_y_mm) * math.erf(within / sigma_z_mm),
            valid_at_s=capture.captured_s,
        )

    def _poll(self) -> None:
        if self.is_running:
            self.controller.on_poses(self.watch.verdict(self.now_s), self.now_s)
            self._send(self.controller.poll(self.now_s))

    def _send(self, messages: list[BusMessage]) -> None:
        for message in messages:
            if self.queue_full:
                self.controller.unsent(message)
                continue
            if isinstance(message, UNHEARD):
                continue
            if isinstance(message, SeamOffset) and self.on_sent is not None:
                self.on_sent(message)
            self.bus.send(self.name, *self._protector.protect(message))
