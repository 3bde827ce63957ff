"""The tracker of a recording."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from arctrack.control.innovation import SeamMeasurement
from arctrack.control.seam_measurement import seam_measurement
from arctrack.errors import in_file
from arctrack.recording import BadFrame, FrameRow, Recording
from tracker import flags
from tracker.observation import Reading
from tracker.state import NAN, Frame, Pose, Track
from tracker.step import StepInputs
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerMemory


def tracker_of(recording: Recording, use_arc_map: bool) -> Tracker:
    """Return a tracker for a recording; ArctrackError if its setup's stripe is not in view."""
    try:
        return Tracker(recording.setup, use_arc_map, recording.correction)
    except ValueError as error:
        raise in_file(recording.setup_path, str(error)) from error


class RecordedTracking:
    """Tracking of a recording's frames, as in the live run where its steps are recorded.

    Without `use_arc_map` the stripe is read without the arc map.
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
        """Return the other inputs of the next frame's step."""
        steps = self.recording.steps
        recorded = None if steps is None else steps.steps.get(frame.index)
        if recorded is None:
            return StepInputs(self.tracker.state, self._poses[frame.index])
        state = TrackerMemory() if recorded.begins else self.tracker.state
        return StepInputs(state, recorded.pose, recorded.look_ahead, recorded.keeps_state)

    def step(self, frame: Frame) -> tuple[Pose | None, Track]:
        """Track the next frame, and return its pose and its track."""
        inputs = self.inputs_for(frame)
        self.tracker.state = inputs.state
        track = self.tracker.step(frame, inputs.pose, inputs.lead)
        if not inputs.keeps_state:
            self.tracker.state = inputs.state
        return inputs.pose, track


@dataclass(frozen=True)
class RowStep:
    """One row of frames.csv after its step; `took_ms` is NaN where there was no frame to step.

    `pose` is None where it was refused or there was no frame; `reading` is what the track rests on, None
    where there is none. `seam` is where the pose puts what was seen, None where nothing was.
    """

    row: FrameRow
    frame: Frame | BadFrame
    pose: Pose | None
    track: Track
    reading: Reading | None
    took_ms: float
    seam: SeamMeasurement | None


def steps(
    tracking: RecordedTracking, rows: Sequence[FrameRow], frames: Iterable[Frame | BadFrame]
) -> Iterator[RowStep]:
    """Track the frames of rows, one at a time."""
    recording, tracker = tracking.recording, tracking.tracker
    for row, frame in zip(rows, frames, strict=True):
        if isinstance(frame, BadFrame):
            raised = flags.FRAME_UNREADABLE.mask | tracker.state.lasting_flags
            yield RowStep(row, frame, None, Track(row.index, row.timestamp_s, raised), None, NAN, None)
            continue
        began_ns = time.perf_counter_ns()
        pose, track = tracking.step(frame)
        took_ms = (time.perf_counter_ns() - began_ns) / 1e6
        of_hand_eye = tracker.state.steering.hand_eye_variance_mm2
        seam = seam_measurement(recording.setup, track, pose, of_hand_eye)
        yield RowStep(row, frame, pose, track, tracker.reading, took_ms, seam)
