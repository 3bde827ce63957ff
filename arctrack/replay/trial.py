"""A recording tracked without bus and files: which offsets a replay would send."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from arctrack.control.cell_file import jobs_for
from arctrack.control.controller import Controller
from arctrack.control.recorded_poses import RecordedPoses
from arctrack.control.robot_messages import TRUSTED
from arctrack.offset_count import OffsetCount
from arctrack.recording import Recording
from arctrack.replay.recorded_tracking import RecordedTracking, steps
from arctrack.replay.replay_clock import RecordingTime
from robot_io import Link, Source, Verdict
from robot_io.poses.plausibility_limits import PlausibilityLimits
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
    rows = [recording.rows[n] for n in positions]
    tracking = RecordedTracking(recording, use_arc_map=True)
    number, jobs = jobs_for(recording, None, None)
    controller = Controller(jobs, Source.REPLAY)
    poses = RecordedPoses(recording, PlausibilityLimits())
    tracks = []
    with Link("virtual", "arctrack-check", source=Source.REPLAY, trusted=TRUSTED) as link:
        moments = RecordingTime(rows, link, controller, poses.verdict, number)
        for step in steps(tracking, rows, recording.frames(positions)):
            T_base_tool = None if step.pose is None else step.pose.T_base_tool
            poses.see(step.seam)
            moments.publish(step.row, step.track, T_base_tool, step.took_ms)
            tracks.append(replace(step.track, stripe=None))
    reasons = {reason.name.lower(): count for reason, count in sorted(controller.reasons.items())}
    offsets = OffsetCount.of(controller.verdicts[Verdict.SEND], len(rows), reasons)
    return Trial(tuple(tracks), offsets, reasons)
