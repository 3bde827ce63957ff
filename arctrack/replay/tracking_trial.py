"""A recording tracked without bus and files: which offsets a replay would send."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from arctrack.control.recorded_job import recorded_job
from arctrack.offset_count import OffsetCount
from arctrack.recording import Recording
from arctrack.replay.replay_loop import replay_without_bus
from robot_io import Verdict
from tracker.state import Track

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
