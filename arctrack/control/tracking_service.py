"""A tracker's answers to messages, frames and time: poses, tracker and controller as one.

No thread, clock or socket: a live run and the simulated cell call the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from arctrack.control.controller import Controller
from arctrack.control.frame_tracking import Capture
from arctrack.control.innovation import SeamMeasurement
from arctrack.control.pose_watch import Doubt
from noise_model.compiled.arrays import Float64
from robot_io import (
    BusMessage,
    GateReason,
    PoseAt,
    PoseStatus,
    Received,
    RobotStatus,
    SeamOffset,
)
from tracker.state import AT_ONCE, OffsetLookAhead, Track

Shown = TypeVar("Shown", contravariant=True)


class Poses(Protocol):
    """Source of tool poses, and of their trust; see `BusPoses`."""

    @property
    def doubt(self) -> Doubt | None:
        """Why poses were not trusted when the verdict was asked last; None where they were."""

    def begin(self) -> None:
        """Begin as a new process."""

    def hear(self, received: Received, now_s: float) -> None:
        """Take an accepted message of any type, read at a time, s."""

    def is_settled(self, captured_s: float, now_s: float) -> bool:
        """Return whether the pose of a capture is known as well as it will be."""

    def at(self, captured_s: float) -> PoseAt:
        """Return the tool's pose at a capture."""

    def see(self, measured: SeamMeasurement) -> None:
        """Take where a pose put the seam that was seen."""

    def verdict(self, now_s: float) -> GateReason:
        """Return what the gate is told of the poses."""

    def are_trusted(self, now_s: float) -> bool:
        """Return whether what is measured by the poses now may be kept."""

    def offset_look_ahead(self, now_s: float) -> OffsetLookAhead:
        """Return how far ahead of the torch an offset is to be asked for."""

    def sent(self, offset: SeamOffset, now_s: float) -> None:
        """Take an offset that went out at a time, s."""

    def rest(self, now_s: float) -> None:
        """Do what takes longer, while no frame waits."""


class SeamTracking(Protocol[Shown]):
    """Tracker of frames; see `FrameTracking`."""

    def begin(self) -> None:
        """Reset the tracker, as in a new process."""

    def track(self, shown: Shown, capture: Capture) -> tuple[Track, SeamMeasurement | None]:
        """Track a frame; the measurement of the seam is what the watch over the poses sees."""


@dataclass(frozen=True)
class FramePose:
    """A frame's track, and T_base_tool (4, 4) at its capture, mm; None where it was refused."""

    track: Track
    T_base_tool: Float64 | None


class TrackingService(Generic[Shown]):
    """Answers to a message, a frame, and the passing of time; all times are on one clock.

    `look_ahead` is the look-ahead of the latest offset.
    """

    def __init__(self, controller: Controller, poses: Poses, tracking: SeamTracking[Shown]) -> None:
        self.controller, self.poses, self.tracking = controller, poses, tracking
        self.look_ahead = AT_ONCE
        self._robot: RobotStatus | None = None

    @property
    def robot(self) -> RobotStatus | None:
        """Latest status of the robot; None before the first."""
        return self._robot

    def begin(self) -> None:
        """Begin with another seam, of which nothing is known."""
        self.poses.begin()
        self.tracking.begin()

    def hear(self, received: Received, now_s: float) -> list[BusMessage]:
        """Take an accepted message, read at a time, s, and return what answers it."""
        if isinstance(received.message, RobotStatus):
            self._robot = received.message
        self.poses.hear(received, now_s)
        return self.controller.on_message(received, now_s)

    def track(self, shown: Shown, index: int, captured_s: float, now_s: float) -> FramePose:
        """Track a frame, captured and looked at by these times, s; `answer` says what is sent of it."""
        pose = self.poses.at(captured_s)
        is_refused = pose.status is PoseStatus.REFUSED
        if not is_refused:
            self.look_ahead = self.poses.offset_look_ahead(now_s)
        capture = Capture(
            index, captured_s, pose, self._robot, self.poses.are_trusted(now_s), self.look_ahead
        )
        track, measured = self.tracking.track(shown, capture)
        if measured is not None:
            self.poses.see(measured)
        return FramePose(track, None if is_refused else pose.T_base_tool)

    def answer(self, tracked: FramePose, now_s: float, took_ms: float) -> list[BusMessage]:
        """Return what is to be sent of a track at a time, s; `took_ms` is what tracking took, ms."""
        self._judge_poses(now_s)
        return self.controller.on_track(tracked.track, now_s, tracked.T_base_tool, took_ms)

    def poll(self, now_s: float) -> list[BusMessage]:
        """Return what is due at a time, s."""
        self._judge_poses(now_s)
        return self.controller.poll(now_s)

    def sent(self, message: BusMessage, now_s: float) -> None:
        """Take a message that went out at a time, s."""
        if isinstance(message, SeamOffset):
            self.poses.sent(message, now_s)

    def _judge_poses(self, now_s: float) -> None:
        self.controller.on_poses(self.poses.verdict(now_s), now_s)
