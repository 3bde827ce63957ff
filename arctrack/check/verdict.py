"""Verdict of a run, in a line: offsets sent, valid frames, why not more, what most likely is wrong."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from arctrack.check.check_sample import case_of
from arctrack.check.fit import ENOUGH
from arctrack.check.hint import Hint, likely_mistake
from arctrack.check.seam_place import UNKNOWN_PLACE, SeamPlace, seam_place
from arctrack.check.units import likely_unit
from arctrack.offset_count import OffsetCount, faults
from arctrack.recording import Recording
from arctrack.recording.results import Summary, count_flags, counts_in_words
from robot_io import GateReason
from tracker import flags
from tracker.geometry import SEARCH_REACH_MM
from tracker.state import Track

MAX_NAMED = 3
"""Number of flags, and of the gate's reasons, that are named, the most frequent first."""

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
"""Questions to the user where no known mistake explains why frames carry a flag."""

GATE_QUESTIONS: Mapping[GateReason, str] = {
    GateReason.NOT_MEASURED: "does the line of [joint] seam_in_base_mm reach along all of the path?",
    GateReason.LOW_CONFIDENCE: "are the lengths and angles of [tolerance] in mm and degrees? With "
    "[calibration.geometry] its certificate says how well the seam can be known",
    GateReason.POSE_IMPLAUSIBLE: "are the poses those of the frames' times?",
}
"""Questions to the user where frames are valid, and the gate lets no offset out."""


SEAM_QUESTION = (
    "is the part laid in as stated, and do [laser] plane_in_tool and [camera.pose_in_tool] hold? "
    "arctrack calibrate check says which"
)
"""Question to the user where the seam lies far off, and no known mistake explains that."""


@dataclass(frozen=True)
class RunVerdict:
    """Verdict of a run: its frames, those with the laser on, the valid ones, and the invalid ones' flags.

    `offsets` are those that it sent, `reasons` why the gate sent no others, by name. `hint` is the likeliest
    mistake, None where all is well or nothing known explains it; `seam` where the valid frames have the seam.
    """

    frames: int
    laser_on: int
    valid: int
    flags: Mapping[str, int]
    hint: Hint | None
    offsets: OffsetCount
    reasons: Mapping[str, int]
    seam: SeamPlace = UNKNOWN_PLACE

    @property
    def nothing_tracked(self) -> bool:
        """True if no frame is valid, or no offset is sent though the robot wants some."""
        return (self.valid == 0 and not self.is_blind) or self.offsets.none_sent

    @property
    def is_blind(self) -> bool:
        """True of a pass that follows an earlier one without the laser: its offsets alone count."""
        return 0 < self.laser_on == self.flags.get(flags.LASER_OFF.name, 0)

    @property
    def few_tracked(self) -> bool:
        """True if fewer offsets are sent, or fewer frames are valid, than in a sound run."""
        sound = self.laser_on if self.is_blind else self.valid
        return self.nothing_tracked or is_few(sound, self.laser_on, self.offsets)

    @property
    def line(self) -> str:
        """The verdict in a line."""
        if self.laser_on == 0:
            return f"no frame valid: the laser is off in all {self.frames}, says frames.csv"
        if self.is_blind:
            return f"{self.offsets}; the pass follows an earlier one without the laser"
        causes = [*self.flags.items()][:MAX_NAMED]
        if self.valid >= ENOUGH * self.laser_on:
            causes += sorted(self.reasons.items(), key=lambda item: -item[1])[:MAX_NAMED]
        counts = counts_in_words(self.offsets, self.valid, self.laser_on)
        if causes:
            counts += f": {', '.join(f'{name} {count}' for name, count in causes)}"
        if self.seam_warning is not None:
            counts += f"; {self.seam_warning}"
        return f"{counts}; {self._what_to_do}" if self.few_tracked else counts

    @property
    def seam_warning(self) -> str | None:
        """Warning of a seam that lies where no seam is expected, None for none."""
        if not self.seam.is_beyond_search:
            return None
        cause = SEAM_QUESTION if self.hint is None else f"most likely {self.hint}"
        return f"the seam lies {self.seam}, and is expected within {SEARCH_REACH_MM:g} mm; {cause}"

    @property
    def _what_to_do(self) -> str:
        if self.hint is not None:
            return f"most likely {self.hint}"
        asked = {flag.name: question for flag, question in QUESTIONS.items()}
        asked |= {reason.name.lower(): question for reason, question in GATE_QUESTIONS.items()}
        names = (*self.flags, *self.reasons)
        return next((asked[name] for name in names if name in asked), "arctrack check says more")


def is_few(valid: int, laser_on: int, offsets: OffsetCount) -> bool:
    """Return whether fewer frames are valid, or fewer offsets go out, than of a sound run."""
    return valid < ENOUGH * laser_on or offsets.sent < ENOUGH * offsets.wanted


def verdict_on(recording: Recording, tracks: Sequence[Track], summary: Summary) -> RunVerdict:
    """Return what a run over all of a recording's frames comes to."""
    lit = [track for row, track in zip(recording.rows, tracks, strict=True) if row.laser_on]
    seam, offsets = seam_place(recording, lit), summary.offset_count
    return verdict_of(len(tracks), lit, offsets, summary.refusals, lambda: _hint_for(recording), seam)


def verdict_of(
    frames: int,
    lit: Sequence[Track],
    offsets: OffsetCount,
    reasons: Mapping[str, int],
    seek: Callable[[], Hint | None],
    seam: SeamPlace = UNKNOWN_PLACE,
) -> RunVerdict:
    """Return the verdict on the tracks of frames with the laser on, of `frames` in all.

    `reasons` of the gate for what it did not send count the robot's own commands too. `seek` finds the
    likeliest mistake; it is called where few frames are valid, few offsets sent, or the seam is far off.
    """
    valid = sum(track.valid for track in lit)
    counts = count_flags([track for track in lit if not track.valid])
    invalidating = {flag.name for flag in flags.FLAGS if flag.invalidates}
    named = sorted((name for name in counts if name in invalidating), key=lambda name: -counts[name])
    shown = {name: counts[name] for name in named}
    verdict = RunVerdict(frames, len(lit), valid, shown, None, offsets, faults(reasons), seam=seam)
    is_wrong = (is_few(valid, len(lit), offsets) and not verdict.is_blind) or seam.is_beyond_search
    return replace(verdict, hint=seek()) if is_wrong else verdict


def _hint_for(recording: Recording) -> Hint | None:
    """Look at some frames of a recording and return what most likely is wrong, None for nothing known."""
    case = case_of(recording)
    hint = None if case is None else likely_mistake(case)
    return hint or likely_unit(recording)
