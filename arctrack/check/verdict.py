"""What a run comes to, in a line: how many frames are valid, the others' flags, what most likely is wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from arctrack.check.case import case_of, chosen_rows
from arctrack.check.hint import Hint, likely_mistake
from arctrack.recording import Recording
from arctrack.recording.results import count_flags
from tracker import flags
from tracker.state import Track

ENOUGH = 0.5
"""If fewer of the frames with the laser on are valid, something is sought that is wrong."""

MAX_FLAGS = 3
"""So many flags are named, the most frequent first."""

QUESTIONS: Mapping[flags.Flag, str] = {
    flags.FRAME_UNREADABLE: "are the frames of the size and type that recording.toml states?",
    flags.LASER_OFF: "does laser_on of frames.csv say when the laser is on?",
    flags.POSE_REFUSED: "do poses and frames have one clock, in seconds?",
    flags.BELOW_SURFACE: "does the tool's z point into the part, or is a height wrong?",
    flags.SEAM_REVERSED: "does the tool's x point along the travel?",
    flags.SEAM_OUT_OF_VIEW: "do poses and [joint] seam_in_base_mm have one base frame, in mm?",
    flags.STRIPE_LOST: "do [camera] and [laser] state where camera and laser are?",
    flags.JOINT_NOT_FOUND: "does [joint] state the joint that is welded?",
    flags.SEAM_JUMP: "are the poses those of the frames' times?",
}
"""What to ask where no known mistake explains why frames carry a flag."""


@dataclass(frozen=True)
class Verdict:
    """What a run comes to: its frames, those with the laser on, the valid ones, and the invalid ones' flags.

    `hint` says what most likely is wrong, None where all is well or nothing known explains it.
    """

    frames: int
    laser_on: int
    valid: int
    flags: Mapping[str, int]
    hint: Hint | None

    @property
    def nothing_tracked(self) -> bool:
        """Whether no frame is valid."""
        return self.valid == 0

    @property
    def few_tracked(self) -> bool:
        """Whether fewer of the frames with the laser on are valid than a sound run has."""
        return self.valid < ENOUGH * self.laser_on or self.nothing_tracked

    @property
    def line(self) -> str:
        """The verdict in a line."""
        if self.laser_on == 0:
            return f"no frame valid: the laser is off in all {self.frames}, says frames.csv"
        counts = ", ".join(f"{name} {count}" for name, count in list(self.flags.items())[:MAX_FLAGS])
        if not self.few_tracked:
            rest = f" ({counts})" if counts else ""
            return f"tracked: {self.valid} of {self.laser_on} frames with the laser on are valid{rest}"
        number = "no frame" if self.nothing_tracked else f"only {self.valid} of {self.laser_on} frames"
        return f"{number} valid: {counts or 'no flag'}; {self._what_to_do}"

    @property
    def _what_to_do(self) -> str:
        if self.hint is not None:
            return f"most likely {self.hint}"
        asked = {flag.name: question for flag, question in QUESTIONS.items()}
        return next((asked[name] for name in self.flags if name in asked), "arctrack check says more")


def verdict_on(recording: Recording, tracks: Sequence[Track]) -> Verdict:
    """Return what a run over all of a recording's frames comes to."""
    lit = [track for row, track in zip(recording.rows, tracks, strict=True) if row.laser_on]
    return verdict_of(len(tracks), lit, lambda: _hint_for(recording))


def verdict_of(frames: int, lit: Sequence[Track], seek: Callable[[], Hint | None]) -> Verdict:
    """Return what the tracks of frames with the laser on, of so many in all, come to.

    `seek` finds what most likely is wrong; it is asked where few of them are valid.
    """
    valid = sum(track.valid for track in lit)
    counts = count_flags([track for track in lit if not track.valid])
    invalidating = {flag.name for flag in flags.FLAGS if flag.invalidates}
    named = sorted((name for name in counts if name in invalidating), key=lambda name: -counts[name])
    hint = None if valid >= ENOUGH * len(lit) else seek()
    return Verdict(frames, len(lit), valid, {name: counts[name] for name in named}, hint)


def _hint_for(recording: Recording) -> Hint | None:
    """Look at some frames of a recording and return what most likely is wrong, None for nothing known."""
    positions = chosen_rows(recording)
    case = case_of(recording, positions, list(recording.images(positions)))
    return None if case is None else likely_mistake(case)
