"""Intermediate results of each frame of a replay, kept on disk until they are drawn."""

import pickle
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Self

from arctrack.control.tracking_service import FrameOutcome
from arctrack.offset_count import OffsetCount
from arctrack.output import writing
from arctrack.recording.run_offsets import NO_OUTCOME, OffsetOutcome
from robot_io import SeamOffset, Validity
from tracker.observation import Reading
from tracker.state import NAN, Pose, Track


@dataclass(frozen=True, eq=False)
class ReplayedFrame:
    """A frame's pose and track, the look that it rests on, the offset that went to the bus.

    `pose` is None where it was refused or there was no frame, `reading` where no look was taken; `compute_ms`
    is NaN where there was no frame to step. `outcome` is what the gate did, and `run` what it had done in the
    live run that a black box is of. `arc_height_mm` is the height of the arc's centre above the surface, mm,
    and its 1 sigma.
    """

    pose: Pose | None
    track: Track
    reading: Reading | None
    offset: SeamOffset
    compute_ms: float
    outcome: OffsetOutcome = NO_OUTCOME
    run: OffsetOutcome | None = None
    arc_height_mm: tuple[float, float] = (NAN, NAN)

    @classmethod
    def of(cls, outcome: FrameOutcome, run: OffsetOutcome | None, arc_height_mm: tuple[float, float]) -> Self:
        """Return what is to be drawn of a frame that was tracked and sent."""
        tracked, step = outcome.tracked, outcome.tracked.step
        pose, reading = (None, None) if step is None else (step.inputs.pose, step.reading)
        sent = outcome.for_results()
        return cls(
            pose,
            tracked.track,
            reading,
            outcome.offset,
            tracked.took_ms,
            sent,
            run,
            arc_height_mm=arc_height_mm,
        )


class SeenFile:
    """File of intermediate results, so that a replay's memory does not grow with it.

    `flags` are those of the tracks so far, `valid` counts the valid ones. Raises ArctrackError, which names
    the file's folder, where it cannot be written.
    """

    def __init__(self, file: IO[bytes], folder: Path) -> None:
        self._file, self._folder = file, folder
        self.flags: list[int] = []
        self.valid, self._sent = 0, 0
        self._reasons: Counter[str] = Counter()

    def add(self, seen: ReplayedFrame) -> None:
        """Keep what was seen of the next frame."""
        with writing(self._folder):
            pickle.dump(seen, self._file, pickle.HIGHEST_PROTOCOL)
        self.flags.append(seen.track.flags)
        self.valid += seen.track.valid
        if seen.offset.validity is Validity.VALID:
            self._sent += 1
        else:
            self._reasons[seen.outcome.gate_reason] += 1

    @property
    def offset_count(self) -> OffsetCount:
        """The offsets sent so far, of those that the robot wanted."""
        return OffsetCount.of(self._sent, len(self), self._reasons)

    def __len__(self) -> int:
        return len(self.flags)

    def __iter__(self) -> Iterator[ReplayedFrame]:
        self._file.seek(0)
        for _ in range(len(self)):
            seen: ReplayedFrame = pickle.load(self._file)
            yield seen
