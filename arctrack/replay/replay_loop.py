"""The frames of a recording through a tracking service, each at its time."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from arctrack.control.recorded_job import RecordedJob, recorded_job
from arctrack.control.tracking_service import FrameOutcome, TrackingService
from arctrack.offset_count import OffsetCount
from arctrack.recording import BadFrame, FrameRow, Recording
from arctrack.recording.ahead import read_ahead
from arctrack.replay.replay_clock import RealTime, RecordingTime
from robot_io import Verdict
from tracker.state import Frame, Track


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


MAX_TRIED, TRIED_BEFORE_ARC = 240, 40
"""Largest number of consecutive frames tracked, and of those before the first with the arc on."""


@dataclass(frozen=True, eq=False)
class Trial:
    """The tracks of frames in a row, without their stripes, and the offsets that go out."""

    tracks: tuple[Track, ...]
    offsets: OffsetCount
    reasons: Mapping[str, int]


def rows_to_try(recording: Recording, most: int = MAX_TRIED) -> range:
    """Return the positions of at most `most` consecutive frames to track: all of a short recording."""
    rows = recording.rows
    first_lit = next((n for n, row in enumerate(rows) if row.arc_on), 0)
    first = max(0, min(first_lit - min(TRIED_BEFORE_ARC, most // 2), len(rows) - most))
    return range(first, min(first + most, len(rows)))


def try_out(recording: Recording, positions: Sequence[int]) -> Trial:
    """Track the frames at rising positions as a replay would; ArctrackError where it refuses the setup."""
    job = recorded_job(recording)
    tracks = tuple(
        replace(outcome.tracked.track, stripe=None) for _, _, outcome in replay_without_bus(job, positions)
    )
    offsets = OffsetCount.of(job.controller.verdicts[Verdict.SEND], len(tracks), job.refusals)
    return Trial(tracks, offsets, job.refusals)
