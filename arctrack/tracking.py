"""The tracker of a recording."""

from __future__ import annotations

from arctrack.errors import in_file
from arctrack.recording import Recording
from tracker.state import Frame, Pose, Track
from tracker.step import StepInputs
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerState


def tracker_of(recording: Recording, use_arc_map: bool) -> Tracker:
    """Return a tracker for a recording; ArctrackError if its setup's stripe is not in view."""
    try:
        return Tracker(recording.setup, use_arc_map, recording.correction)
    except ValueError as error:
        raise in_file(recording.setup_path, str(error)) from error


class RecordedTracking:
    """Takes a recording's frames through its tracker, as a live run took them where its steps are recorded.

    Parameters
    ----------
    recording : Recording
        The recording.
    use_arc_map : bool
        False reads the stripe without the arc map.

    Attributes
    ----------
    recording : Recording
        The recording.
    tracker : Tracker
        The tracker.
    """

    def __init__(self, recording: Recording, use_arc_map: bool) -> None:
        self.tracker = tracker_of(recording, use_arc_map)
        self.recording = recording
        rows = recording.rows
        poses = recording.poses_at(row.timestamp_s for row in rows)
        self._poses = {row.index: pose for row, pose in zip(rows, poses, strict=True)}
        if recording.steps is not None:
            self.tracker.state = recording.steps.state

    def inputs_for(self, frame: Frame) -> StepInputs:
        """Return what the step of the next frame takes beside it."""
        steps = self.recording.steps
        recorded = None if steps is None else steps.steps.get(frame.index)
        if recorded is None:
            return StepInputs(self.tracker.state, self._poses[frame.index])
        state = TrackerState() if recorded.begins else self.tracker.state
        return StepInputs(state, recorded.pose, recorded.lead, recorded.keeps_state)

    def step(self, frame: Frame) -> tuple[Pose | None, Track]:
        """Track the next frame, and return its pose and its track."""
        inputs = self.inputs_for(frame)
        self.tracker.state = inputs.state
        track = self.tracker.step(frame, inputs.pose, inputs.lead)
        if not inputs.keeps_state:
            self.tracker.state = inputs.state
        return inputs.pose, track
