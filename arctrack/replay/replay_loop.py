"""The frames of a recording through a tracking service, each at its time."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from arctrack.control.recorded_job import RecordedJob
from arctrack.control.tracking_service import FrameOutcome, TrackingService
from arctrack.recording import BadFrame, FrameRow
from arctrack.recording.ahead import read_ahead
from arctrack.replay.replay_clock import RealTime, RecordingTime
from tracker.state import Frame


class RowOutcome(NamedTuple):
    """A row of frames.csv, its frame, and what became of it."""

    row: FrameRow
    frame: Frame | BadFrame
    outcome: FrameOutcome


def replay_frames(
    service: TrackingService[Frame | None],
    clock: RecordingTime | RealTime,
    rows: Sequence[FrameRow],
    frames: Iterable[Frame | BadFrame],
) -> Iterator[RowOutcome]:
    """Track the frames of rows one at a time, and send what the gate makes of them."""
    clock.begin(service)
    for row, frame in zip(rows, frames, strict=True):
        clock.reach(row, service)
        shown = None if isinstance(frame, BadFrame) else frame
        yield RowOutcome(row, frame, service.track(shown, row.index, row.timestamp_s))


def replay_without_bus(job: RecordedJob, positions: Sequence[int]) -> Iterator[RowOutcome]:
    """Track the frames at rising positions as a replay does; what it would send goes nowhere."""
    rows = [job.recording.rows[n] for n in positions]
    clock = RecordingTime(rows, job.number)
    service = TrackingService[Frame | None](job.controller, job.seam, lambda _: True, clock.now_s)
    with read_ahead(job.recording.frames(positions)) as frames:
        yield from replay_frames(service, clock, rows, frames)
