"""A frame with what is known of its capture, through the tracker: the step of every live tracker."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from arctrack.control.innovation import SeamMeasurement
from arctrack.control.seam_measured import seam_measured
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
    """A frame's capture as the tracker knows it.

    Attributes
    ----------
    index : int
        The frame's number.
    captured_s : float
        When it was taken, s, on the tracker's clock.
    pose : PoseAt
        The tool's pose then; it may be refused.
    robot : RobotStatus or None
        What the robot said last; None before it was heard.
    is_trusted : bool
        Whether poses are trusted: what is measured by others must not last.
    lead : OffsetLookAhead
        How far ahead of the torch the offset is asked for.
    """

    index: int
    captured_s: float
    pose: PoseAt
    robot: RobotStatus | None
    is_trusted: bool
    lead: OffsetLookAhead


@dataclass(frozen=True)
class FrameStep:
    """A step that was taken: the frame, what the step took beside it, and what came of it."""

    frame: Frame
    inputs: StepInputs
    track: Track
    reading: Reading | None


class FrameTracking:
    """The tracker of one seam.

    Parameters
    ----------
    setup : Setup
        What is known of sensor and part.
    correction : Correction
        What of the seam's displacement is sent.

    Attributes
    ----------
    tracker : Tracker
        The tracker.
    on_step : callable or None
        Hears each step.
    """

    def __init__(self, setup: Setup, correction: Correction = UNSTATED) -> None:
        self.tracker = Tracker(setup, correction=correction)
        self.on_step: Callable[[FrameStep], None] | None = None

    def begin(self) -> None:
        """Forget the seam: another part comes."""
        self.tracker.state = TrackerMemory()

    def track(self, shown: Frame | None, capture: Capture) -> tuple[Track, SeamMeasurement | None]:
        """Track a frame, None for one that cannot be read; of poses that are doubted nothing lasts.

        Parameters
        ----------
        shown : Frame or None
            The frame.
        capture : Capture
            What is known of its capture.

        Returns
        -------
        track : Track
            The frame's result.
        measured : SeamMeasurement or None
            Where the pose puts what was seen, None where nothing valid was.
        """
        before = self.tracker.state
        if shown is None:
            raised = flags.FRAME_UNREADABLE.mask | before.lasting_flags
            return Track(capture.index, capture.captured_s, raised), None
        pose = None
        if capture.pose.status is not PoseStatus.REFUSED:
            pose = Pose(capture.pose.T_base_tool, capture.pose.status is PoseStatus.EXTRAPOLATED)
        track = self.tracker.step(shown, pose, capture.lead)
        hand_eye_mm2 = self.tracker.state.steering.hand_eye_variance_mm2
        if not capture.is_trusted:
            self.tracker.state = before
        if self.on_step is not None:
            inputs = StepInputs(before, pose, capture.lead, capture.is_trusted)
            self.on_step(FrameStep(shown, inputs, track, self.tracker.reading))
        setup = self.tracker.geometry.setup
        return track, seam_measured(setup, track, pose, hand_eye_mm2) if track.valid else None
