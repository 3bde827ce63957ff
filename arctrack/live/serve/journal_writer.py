"""Writer of a live loop's journal: an entry for each step, views and statuses some times a second."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

from arctrack.control.tracking_service import FrameOutcome
from arctrack.live.journal.journal import Journal
from arctrack.live.journal.records import Entry, FrameView, ProcessState, ReceivedPose, Status
from robot_io import PoseSample
from tracker.observation import Reading
from tracker.state import Track


class JournalWriter:
    """Writer of a run's journal; `processes` returns the states of the run's subprocesses."""

    def __init__(self, journal: Journal, processes: Callable[[], Mapping[str, ProcessState]] = dict) -> None:
        self._journal, self._processes = journal, processes
        self._view_s = self._status_s = -math.inf

    def on_pose(self, sample: PoseSample, read_s: float) -> None:
        """Take a pose that was read at a time, s."""
        self._journal.add_pose(ReceivedPose(sample, read_s))

    def on_sent(self, outcome: FrameOutcome, job_number: int, arrived_s: float, dropped: int) -> None:
        """Write the entry of a frame that was tracked; see `Entry`."""
        tracked, step = outcome.tracked, outcome.tracked.step
        if step is None:
            # A frame that could not be read.
            return
        position = self._journal.write_entry(
            Entry(
                step.frame,
                step.inputs,
                replace(tracked.track, stripe=None, checks=()),
                outcome.offset,
                job_number,
                arrived_s=arrived_s,
                sent_s=outcome.sent_s,
                took_ms=tracked.took_ms,
                dropped=dropped,
                outcome=outcome.for_results(),
            )
        )
        # Nobody sees more pictures a second than 25.
        if not 0.0 <= arrived_s - self._view_s < 0.04:
            self._view_s = arrived_s
            self._journal.write_view(_view(position, tracked.track, step.reading))

    def write_status(self, now_s: float, status: Callable[[], Status]) -> None:
        """Write how the run stands, where it is time for it."""
        if not 0.0 <= now_s - self._status_s < 0.1:
            self._status_s = now_s
            self._journal.write_status(replace(status(), processes=self._processes()))


def _view(position: int, track: Track, reading: Reading | None) -> FrameView:
    track = replace(track, checks=())
    if reading is None:
        return FrameView(position, track)
    return FrameView(position, track, reading.seam, reading.reach_mm, reading.arc, reading.joint)
