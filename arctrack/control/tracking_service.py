"""The way of a frame from its pose to the offset that goes out.

Live run, replay, check and simulated cell drive the same service. They differ in when they call it, in the
clock, and in the bus behind `send`. No thread, clock or socket is in here.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from arctrack.control.controller import Controller
from arctrack.control.frame_tracking import Capture, TrackedFrame
from arctrack.control.innovation import SeamMeasurement
from arctrack.control.pose_watch import Doubt
from arctrack.recording.run_offsets import OffsetOutcome
from arctrack.recording.weld_schedule import NO_WELD
from noise_model.compiled.arrays import Float64
from robot_io import BusMessage, GateReason, PoseAt, PoseStatus, Received, RobotStatus, SeamOffset
from robot_io.poses.pose_questions import Implausibility
from tracker.state import AT_ONCE, NAN, Frame, OffsetLookAhead

Shown = TypeVar("Shown", contravariant=True)


class Poses(Protocol):
    """Source of tool poses, and of their trust; see `BusPoses`."""

    @property
    def doubt(self) -> Doubt | None:
        """Reason for which poses were not trusted at the latest verdict; None where they were."""

    def begin(self) -> None:
        """Reset to the state of a new process."""

    def hear(self, received: Received, now_s: float) -> None:
        """Take an accepted message of any type, read at a time, s."""

    def is_settled(self, captured_s: float, now_s: float) -> bool:
        """Return True if the pose of a capture is known as well as it will be."""

    def at(self, captured_s: float) -> PoseAt:
        """Return the tool's pose at a capture."""

    def see(self, measured: SeamMeasurement, is_valid: bool) -> None:
        """Take where a pose put the seam that was seen, and whether its track is valid."""

    def verdict(self, now_s: float) -> GateReason:
        """Return the poses' verdict for the gate."""

    def are_trusted(self, now_s: float) -> bool:
        """Return True if measurements by the poses may be kept now."""

    def offset_look_ahead(self, now_s: float) -> OffsetLookAhead:
        """Return the look-ahead of an offset."""

    def sent(self, offset: SeamOffset, now_s: float) -> None:
        """Take an offset that went out at a time, s."""

    def rest(self, now_s: float) -> None:
        """Do what takes longer, while no frame waits."""


class SeamTracking(Protocol[Shown]):
    """Tracker of frames; see `FrameTracking`."""

    def begin(self) -> None:
        """Reset the tracker, as in a new process."""

    def finish(self) -> None:
        """End a pass: nothing more comes of this seam."""

    def track(self, shown: Shown, capture: Capture) -> TrackedFrame:
        """Track a frame."""


Tracking = TypeVar("Tracking", bound=SeamTracking[Any], covariant=True)


@dataclass(frozen=True)
class SeamTracker(Generic[Tracking]):
    """Poses and tracker of one seam."""

    poses: Poses
    tracking: Tracking


@dataclass(frozen=True)
class FrameOutcome:
    """A tracked frame, and what was sent of it.

    `T_base_tool` (4, 4) is the pose at its capture, mm; None where it was refused. `offset` went out at
    `sent_s`, NaN where the bus did not take it. `gate_reason` says why it is not as it was measured, and
    `pose_doubt` why the poses were not trusted.
    """

    tracked: TrackedFrame
    T_base_tool: Float64 | None
    messages: list[BusMessage]
    offset: SeamOffset
    sent_s: float
    gate_reason: GateReason
    pose_doubt: Doubt | None

    def for_results(self) -> OffsetOutcome:
        """Return what results.csv says of the offset."""
        return OffsetOutcome(
            self.offset.offset_y_mm,
            self.offset.offset_z_mm,
            self.offset.validity.name.lower() if math.isfinite(self.sent_s) else "not_sent",
            "" if self.gate_reason is GateReason.NONE else self.gate_reason.name.lower(),
            "" if self.pose_doubt is None else self.pose_doubt.name.lower(),
            self.tracked.weld or NO_WELD,
        )


class TrackingService(Generic[Shown]):
    """Service that hears the robot, tracks frames and sends the answers; `seam` is the tracked one.

    `send` puts a message on the bus, and returns whether it went out; `now_s` returns the time, s. `on_sent`
    gets each message that went out, and when. `robot` is the latest status, None before the first, and
    `look_ahead` that of the latest offset.
    """

    def __init__(
        self,
        controller: Controller,
        seam: SeamTracker[SeamTracking[Shown]],
        send: Callable[[BusMessage], bool],
        now_s: Callable[[], float],
        on_sent: Callable[[BusMessage, float], None] | None = None,
    ) -> None:
        self.controller, self.seam = controller, seam
        self.robot: RobotStatus | None = None
        self.look_ahead = AT_ONCE
        self._put, self._now_s, self._on_sent = send, now_s, on_sent
        self._shown_before: tuple[Frame, float] | None = None

    def take_up(self, seam: SeamTracker[SeamTracking[Shown]]) -> None:
        """Track another seam from now on, of which nothing is known."""
        self.seam.tracking.finish()
        self.seam, self.look_ahead, self._shown_before = seam, AT_ONCE, None
        seam.poses.begin()
        seam.tracking.begin()

    def hear(self, received: Received) -> None:
        """Take an accepted message, and send what answers it."""
        now_s = self._now_s()
        if isinstance(received.message, RobotStatus):
            self.robot = received.message
        self.seam.poses.hear(received, now_s)
        self._send(self.controller.on_message(received, now_s))

    def track(self, shown: Shown, index: int, captured_s: float) -> FrameOutcome:
        """Track a frame that was captured at a time, s, and send what the gate makes of it."""
        poses, now_s = self.seam.poses, self._now_s()
        pose = poses.at(captured_s)
        is_refused = pose.status is PoseStatus.REFUSED
        if not is_refused:
            self.look_ahead = poses.offset_look_ahead(now_s)
        capture = Capture(
            index=index,
            captured_s=captured_s,
            pose=pose,
            robot=self.robot,
            is_trusted=poses.are_trusted(now_s),
            look_ahead=self.look_ahead,
            is_armed=self.controller.is_armed(now_s),
        )
        tracked = self.seam.tracking.track(shown, capture)
        if tracked.seam is not None:
            poses.see(tracked.seam, tracked.track.valid)
        now_s = self._now_s()
        self._judge_poses(now_s)
        T_base_tool = None if is_refused else pose.T_base_tool
        messages = self.controller.on_track(tracked.track, now_s, T_base_tool, tracked.took_ms)
        (offset,) = (message for message in messages if isinstance(message, SeamOffset))
        outcome = FrameOutcome(
            tracked=tracked,
            T_base_tool=T_base_tool,
            messages=messages,
            offset=offset,
            sent_s=self._send(messages),
            gate_reason=self.controller.gate_reason,
            pose_doubt=poses.doubt,
        )
        self._show_before()
        self._shown_before = (shown, captured_s) if isinstance(shown, Frame) else None
        return outcome

    def _show_before(self) -> None:
        """Show the controller the frame before the newest: by now the poses after it are known, too."""
        if self._shown_before is None or not self.controller.is_finding:
            return
        frame, captured_s = self._shown_before
        poses = self.seam.poses
        # A robot may search off the nominal seam.
        is_doubted = poses.doubt not in (None, Implausibility.OFF_SEAM)
        self.controller.on_shown(frame, poses.at(captured_s), is_doubted, self._now_s())

    def poll(self) -> None:
        """Send what is due."""
        now_s = self._now_s()
        self._judge_poses(now_s)
        self._send(self.controller.poll(now_s))

    def close(self) -> None:
        """Send the last refusal, and end the pass."""
        self._send(self.controller.close(self._now_s()))
        self.seam.tracking.finish()

    def _judge_poses(self, now_s: float) -> None:
        self.controller.on_poses(self.seam.poses.verdict(now_s), now_s)

    def _send(self, messages: Iterable[BusMessage]) -> float:
        """Send messages, and return when the offset among them went out, s; NaN where none did."""
        sent_s = NAN
        for message in messages:
            if not self._put(message):
                self.controller.unsent(message)
                continue
            now_s = self._now_s()
            if isinstance(message, SeamOffset):
                self.seam.poses.sent(message, now_s)
                sent_s = now_s
            if self._on_sent is not None:
                self._on_sent(message, now_s)
        return sent_s
