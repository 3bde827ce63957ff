"""A frame with what is known of its capture, through the tracker: the step of every live tracker."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from arctrack.control.innovation import SeamMeasurement
from arctrack.control.seam_measurement import seam_measurement
from noise_model.setup import Setup
from robot_io import PoseAt, PoseStatus, RobotStatus
from tracker import flags
from tracker.observation import Reading
from tracker.seam.correction import UNSTATED, Correction
from tracker.state import Frame, OffsetLookAhead, Pose, Track
from tracker.step import StepInputs
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerMemory


@dataclass(frozen=True)
class Capture:
    """Conditions of a frame's capture as the tracker knows them.

    `captured_s` is on the tracker's clock; `pose` is the tool's then, and may be refused; `robot` is the
    latest status, None before the first. Measurements from poses that are not trusted must not last.
    `look_ahead` is that of the offset.
    """

    index: int
    captured_s: float
    pose: PoseAt
    robot: RobotStatus | None
    is_trusted: bool
    look_ahead: OffsetLookAhead


@dataclass(frozen=True)
class FrameStep:
    """A completed step: the frame, the step's other inputs, and its result."""

    frame: Frame
    inputs: StepInputs
    track: Track
    reading: Reading | None


class FrameTracking:
    """Tracker of one seam.

    `correction` is the part of the seam's displacement that is sent; `on_step` gets each step.
    """

    def __init__(self, setup: Setup, correction: Correction = UNSTATED) -> None:
        self.tracker = Tracker(setup, correction=correction)
        self.on_step: Callable[[FrameStep], None] | None = None

    def begin(self) -> None:
        """Forget the seam: another part comes."""
        self.tracker.state = TrackerMemory()

    def track(self, shown: Frame | None, capture: Capture) -> tuple[Track, SeamMeasurement | None]:
        """Track a frame, None for an unreadable one; measurements from doubted poses do not last.

        Returns the track, and the seam that was measured with the pose, None where nothing valid was.
        """
        before = self.tracker.state
        if shown is None:
            raised = flags.FRAME_UNREADABLE.mask | before.lasting_flags
            return Track(capture.index, capture.captured_s, raised), None
        pose = None
        if capture.pose.status is not PoseStatus.REFUSED:
            pose = Pose(capture.pose.T_base_tool, capture.pose.status is PoseStatus.EXTRAPOLATED)
        track = self.tracker.step(shown, pose, capture.look_ahead)
        hand_eye_mm2 = self.tracker.state.steering.hand_eye_variance_mm2
        if not capture.is_trusted:
            self.tracker.state = before
        if self.on_step is not None:
            inputs = StepInputs(before, pose, capture.look_ahead, capture.is_trusted)
            self.on_step(FrameStep(shown, inputs, track, self.tracker.reading))
        setup = self.tracker.geometry.setup
        return track, seam_measurement(setup, track, pose, hand_eye_mm2) if track.valid else None
