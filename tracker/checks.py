"""What a step asks of a frame: every question once, and each answer with its value, limit and outcome.

A step raises its flags by these checks alone, so whoever explains a frame reads them off and asks nothing
again. Kernels ask too: to them a question is its number, and answers are rows of numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, overload

import numpy as np

from noise_model.arrays import Float64, Int64
from noise_model.kernel import kernel
from tracker import flags
from tracker.flags import FLAGS, Flag

Outcome = Literal["passed", "noted", "refused"]

Demand = Literal["yes", "at_least", "at_most", "more_than", "less_than"]
"""How a value stands to its limit where a check passes; a value that is NaN passes each but `yes`."""

_YES, _AT_LEAST, _AT_MOST, _MORE_THAN, _LESS_THAN = range(5)
_CODES: dict[Demand, int] = {
    "yes": _YES,
    "at_least": _AT_LEAST,
    "at_most": _AT_MOST,
    "more_than": _MORE_THAN,
    "less_than": _LESS_THAN,
}


@dataclass(frozen=True)
class Question:
    """One question that a step asks of a frame.

    Attributes
    ----------
    id : str
        Its name in files.
    words : str
        What is asked, in words.
    demand : str
        How the value must stand to the limit: "yes", "at_least", "at_most", "more_than" or "less_than".
    flag : Flag
        The flag of a value that fails.
    unit : str
        "mm", "share" (of 1), "lines", or "" for a plain number. A "yes" question has the values 1 and 0.
    """

    id: str
    words: str
    demand: Demand
    flag: Flag
    unit: Literal["", "mm", "share", "lines"] = ""


class Check(NamedTuple):
    """An answer.

    Attributes
    ----------
    question : Question
        What was asked.
    value : float
        The frame's value, in the question's unit.
    limit : float
        The limit, in the question's unit.
    flag : Flag
        The flag that failing raises.
    """

    question: Question
    value: float
    limit: float
    flag: Flag

    @property
    def passed(self) -> bool:
        """Whether the value meets the demand."""
        return not fails(_CODES[self.question.demand], self.value, self.limit)

    @property
    def outcome(self) -> Outcome:
        """What the answer means for the frame's seam."""
        if self.passed:
            return "passed"
        return "refused" if self.flag.invalidates else "noted"


class Answers(Sequence[Check]):
    """Answers in the order of their questions; each is made when it is read, and most never are.

    Parameters
    ----------
    rows : array (n, 4)
        Each answer's question, by its number, value, limit and the mask of the flag that failing raises.
    """

    __slots__ = ("_rows",)

    def __init__(self, rows: Float64) -> None:
        self._rows = rows

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[Check]:
        return map(_check, self._rows.tolist())

    @overload
    def __getitem__(self, index: int) -> Check: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Check, ...]: ...

    def __getitem__(self, index: int | slice) -> Check | tuple[Check, ...]:
        return tuple(self)[index]

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Answers):
            return np.array_equal(self._rows, other._rows, equal_nan=True)
        return isinstance(other, tuple) and tuple(self) == other

    def __hash__(self) -> int:
        return hash(tuple(self))

    def __repr__(self) -> str:
        return repr(tuple(self))


def _check(row: Sequence[float]) -> Check:
    """Return the answer of a row."""
    question, value, limit, mask = row
    return Check(QUESTIONS[int(question)], value, limit, FLAGS[int(mask).bit_length() - 1])


class Asked(NamedTuple):
    """The answers so far, and the flags that they raise, as kernels write them.

    `rows` (n, 4) are as `Answers` has them, those of `MOST_ANSWERS` at most. `told` (2,) says how many there
    are, and holds the flags as bits.
    """

    rows: Float64
    told: Int64

    @classmethod
    def nothing(cls) -> Asked:
        """Return a record without answers."""
        record: Asked = nothing_asked()
        return record

    @property
    def flags(self) -> int:
        """The flags that are set, as bits."""
        return int(self.told[1])

    @property
    def answers(self) -> Answers:
        """The answers in the order in which the questions were asked."""
        return Answers(self.rows[: self.told[0]].copy())


@kernel(allocates=True)
def nothing_asked() -> Asked:
    """Return `Asked.nothing`."""
    return Asked(np.empty((MOST_ANSWERS, 4)), np.zeros(2, np.int64))


@kernel
def fails(demand: int, value: float, limit: float) -> bool:
    """Say whether a value fails a demand, by its number."""
    if demand == _YES:
        return value != limit
    if demand == _AT_LEAST:
        return value < limit
    if demand == _AT_MOST:
        return value > limit
    return value <= limit if demand == _MORE_THAN else value >= limit


@kernel
def ask_raising(asked: Asked, question: int, value: float, limit: float, mask: int) -> bool:
    """Note an answer and say whether it passed; failing raises the flags of a `mask`."""
    n = asked.told[0]
    asked.rows[n, 0], asked.rows[n, 1], asked.rows[n, 2], asked.rows[n, 3] = question, value, limit, mask
    asked.told[0] = n + 1
    if fails(_DEMANDS[question], value, limit):
        asked.told[1] |= mask
        return False
    return True


@kernel
def ask(asked: Asked, question: int, value: float, limit: float) -> bool:
    """Note an answer and say whether it passed; failing raises the question's own flag."""
    return ask_raising(asked, question, value, limit, _MASKS[question])


@kernel
def ask_whether(asked: Asked, question: int, holds: bool) -> bool:
    """Note the answer to a "yes" question and say whether it passed."""
    return ask_raising(asked, question, 1.0 if holds else 0.0, 1.0, _MASKS[question])


@kernel
def ask_as(asked: Asked, others: Asked) -> None:
    """Note the answers of another record, and their flags."""
    for n in range(others.told[0]):
        for column in range(4):
            asked.rows[asked.told[0] + n, column] = others.rows[n, column]
    asked.told[0] += others.told[0]
    asked.told[1] |= others.told[1]


@kernel
def take_answer(asked: Asked, others: Asked, question: int) -> None:
    """Note another record's answer to a question, in place of the record's own."""
    theirs, own = _row_of(others, question), _row_of(asked, question)
    if theirs < 0:
        return
    if own < 0:
        own = asked.told[0]
        asked.told[0] += 1
    for column in range(4):
        asked.rows[own, column] = others.rows[theirs, column]
    raised = 0
    for n in range(asked.told[0]):
        row = asked.rows[n]
        if fails(_DEMANDS[int(row[0])], row[1], row[2]):
            raised |= int(row[3])
    asked.told[1] = raised


@kernel
def _row_of(asked: Asked, question: int) -> int:
    """Return the row that answers a question, -1 for none."""
    for n in range(asked.told[0]):
        if asked.rows[n, 0] == question:
            return n
    return -1


QUESTIONS: list[Question] = []
"""Every question, by its number."""


def _question(
    name: str, words: str, demand: Demand, flag: Flag, unit: Literal["", "mm", "share", "lines"] = ""
) -> int:
    """Register a question and return its number."""
    QUESTIONS.append(Question(name, words, demand, flag, unit))
    return len(QUESTIONS) - 1


FRAME_FORMAT = _question(
    "frame_format", "the frame has the camera's size and the sensor's type", "yes", flags.FRAME_UNREADABLE
)
POSE_KNOWN = _question("pose_known", "a pose is near enough in time", "yes", flags.POSE_REFUSED)
POSE_BRACKETED = _question(
    "pose_bracketed", "the pose lies between two that were received", "yes", flags.POSE_EXTRAPOLATED
)
POSE_RIGID = _question("pose_rigid", "the pose is a rotation and a displacement", "yes", flags.POSE_REFUSED)
LASER_ABOVE = _question(
    "laser_above", "height of the laser over the workpiece", "more_than", flags.BELOW_SURFACE, "mm"
)
LASER_NEAR = _question(
    "laser_near", "height of the laser over the workpiece", "at_most", flags.SEAM_OUT_OF_VIEW, "mm"
)
SHEET_ACROSS = _question(
    "sheet_across",
    "cosine between the laser sheet's normal and the seam",
    "at_least",
    flags.SEAM_OUT_OF_VIEW,
)
LASER_AHEAD = _question(
    "laser_ahead", "the laser's lead over the torch along the seam", "at_least", flags.SEAM_REVERSED, "mm"
)
REACH = _question(
    "reach", "how far about the expected seam the stripe was sought", "less_than", flags.SEARCHED, "mm"
)
CAMERA_ABOVE = _question("camera_above", "the camera stands above the workpiece", "yes", flags.BELOW_SURFACE)
STRIPE_EXPECTED = _question(
    "stripe_expected", "the expected stripe lies in the image", "yes", flags.STRIPE_LOST
)
ARC_ON = _question("arc_on", "the arc is on", "yes", flags.ARC_OFF)
ARC_LEVEL_KNOWN = _question(
    "arc_level_known", "enough pixels off the stripe tell the arc's output", "yes", flags.ARC_LEVEL_UNKNOWN
)
ARC_LEVEL = _question("arc_level", "the arc's output over the expected output", "at_least", flags.ARC_OFF)
MAP_MISFIT = _question(
    "map_misfit", "residual of the arc map over its stated uncertainty", "at_most", flags.MAP_MISFIT
)
LASER_ON = _question("laser_on", "the laser is on", "yes", flags.LASER_OFF)
LINES_SATURATED = _question(
    "lines_saturated", "scan lines with saturated pixels in the stripe", "at_most", flags.SATURATED, "lines"
)
STRIPE_INSIDE = _question(
    "stripe_inside", "the stripe stays within the image", "yes", flags.STRIPE_LEAVES_IMAGE
)
LINES_HELD = _question(
    "lines_held", "share of the joint's scan lines that hold a stripe", "at_least", flags.STRIPE_LOST, "share"
)
STRIPE_EVIDENCE = _question(
    "stripe_evidence", "evidence for the stripe over that for a dark stripe", "at_least", flags.STRIPE_LOST
)
CLEAR_LINES_HELD = _question(
    "clear_lines_held",
    "share of the scan lines that would show the stripe clearly and hold it",
    "at_least",
    flags.STRIPE_LOST,
    "share",
)
STRIPE_WHOLE = _question(
    "stripe_whole",
    "share of the joint's scan lines that hold a stripe",
    "at_least",
    flags.STRIPE_PARTIAL,
    "share",
)
SECOND_STRIPE = _question(
    "second_stripe", "brightness of a second stripe over the first", "at_most", flags.TWO_STRIPES, "share"
)
STRIPE_TOLD = _question(
    "stripe_told",
    "evidence that of two stripes the one that was read is the laser's, nats",
    "at_least",
    flags.STRIPE_AMBIGUOUS,
)
JOINT_TYPE = _question(
    "joint_type", "the profile shows no other type of joint decidedly", "yes", flags.JOINT_TYPE_MISMATCH
)
JOINT_AS_STATED = _question(
    "joint_as_stated",
    "a joint that departs from its shape looks like no other type",
    "yes",
    flags.JOINT_NOT_FOUND,
)
JOINT_SEEN = _question("joint_seen", "the profile determines the joint", "yes", flags.JOINT_NOT_FOUND)
GAP_SHOWN = _question("gap_shown", "the stripe shows the butt joint's gap", "yes", flags.SEAM_BY_LINE)
JOINT_EVIDENCE = _question(
    "joint_evidence",
    "evidence for the joint over a plate without one, nats",
    "at_least",
    flags.JOINT_NOT_FOUND,
)
VIEW_MARGIN = _question(
    "view_margin",
    "distance of the seam from the nearer end of the profile",
    "more_than",
    flags.SEAM_OUT_OF_VIEW,
    "mm",
)
JOINT_CHI2 = _question(
    "joint_chi2", "chi-squared of the joint's fit, per degree of freedom", "at_most", flags.JOINT_MISFIT
)
JOINT_UNEXPLAINED = _question(
    "joint_unexplained",
    "share of the points near the seam that lie off the joint's shape",
    "at_most",
    flags.JOINT_MISFIT,
    "share",
)
NEAR_NOMINAL = _question(
    "near_nominal",
    "distance of the seam from its nominal line",
    "at_most",
    flags.SEAM_OUT_OF_VIEW,
    "mm",
)
JUMP_Y = _question(
    "jump_y", "distance in y from where the earlier frames put the seam", "at_most", flags.SEAM_JUMP, "mm"
)
JUMP_Z = _question(
    "jump_z", "distance in z from where the earlier frames put the seam", "at_most", flags.SEAM_JUMP, "mm"
)
TORCH_BEFORE_END = _question(
    "torch_before_end", "distance of the torch past the joint's end", "at_most", flags.PAST_JOINT, "mm"
)
TORCH_AFTER_START = _question(
    "torch_after_start", "distance of the torch before the joint's start", "at_most", flags.BEFORE_JOINT, "mm"
)
SEAM_MEASURED = _question("seam_measured", "some of the seam has been measured", "yes", flags.OFFSET_UNKNOWN)
SEAM_NOT_LOST = _question(
    "seam_not_lost", "distance of the torch past the last measurement", "at_most", flags.OFFSET_HELD, "mm"
)
TORCH_MEASURED = _question(
    "torch_measured", "the seam is measured where the torch stands", "yes", flags.OFFSET_EXTRAPOLATED
)
REACHED = _question(
    "reached", "distance of the torch past the last measurement", "at_most", flags.OFFSET_UNKNOWN, "mm"
)
TORCH_SIGMA = _question(
    "torch_sigma", "sigma of the seam where the torch stands", "at_most", flags.OFFSET_UNKNOWN, "mm"
)
FOLLOWING = _question("following", "following has not been stopped", "yes", flags.FOLLOW_STOPPED)
OFFSET_WITHIN = _question(
    "offset_within", "the offset lies within its stated limit", "yes", flags.OFFSET_LIMITED
)

_DEMANDS = np.array([_CODES[question.demand] for question in QUESTIONS])
_MASKS = np.array([question.flag.mask for question in QUESTIONS])

MOST_ANSWERS = 2 * len(QUESTIONS)
"""A step asks no question more than twice."""
