"""Tests of a frame in a step: every question once, and each answer with its value, limit and outcome.

A step raises its flags by these checks alone, so an explanation of a frame reads them and tests nothing
again.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from tracker import flags
from tracker.flags import Flag

Outcome = Literal["passed", "noted", "refused"]

Demand = Literal["yes", "at_least", "at_most", "more_than", "less_than"]
"""Relation of a value to its limit where a check passes; a value that is NaN passes each but `yes`."""

_FAILS: Mapping[Demand, Callable[[float, float], bool]] = {
    "yes": operator.ne,
    "at_least": operator.lt,
    "at_most": operator.gt,
    "more_than": operator.le,
    "less_than": operator.ge,
}


@dataclass(frozen=True)
class Question:
    """A test that a step applies to a frame.

    `id` is its name in files. `demand` relates value and limit: "yes", "at_least", "at_most", "more_than" or
    "less_than"; a "yes" question has the values 1 and 0. `flag` is raised by a value that fails. `unit` is ""
    for a plain number, and "share" is of 1.
    """

    id: str
    words: str
    demand: Demand
    flag: Flag
    unit: Literal["", "mm", "deg", "share", "lines"] = ""


class Check(NamedTuple):
    """Result of a question: the frame's value and the limit, in the question's unit.

    `flag` is raised by failing.
    """

    question: Question
    value: float
    limit: float
    flag: Flag

    @property
    def passed(self) -> bool:
        """True if the value meets the demand."""
        return not _FAILS[self.question.demand](self.value, self.limit)

    @property
    def outcome(self) -> Outcome:
        """Consequence of the answer for the frame's seam."""
        if self.passed:
            return "passed"
        return "refused" if self.flag.invalidates else "noted"


class FrameChecks:
    """The answers of one frame so far, and the flags that they raise, as bits."""

    __slots__ = ("_answers", "flags")

    def __init__(self) -> None:
        self._answers: list[Check] = []
        self.flags = 0

    @property
    def answers(self) -> tuple[Check, ...]:
        """Answers in the order of the questions."""
        return tuple(self._answers)

    def ask(self, question: Question, value: float, limit: float, flag: Flag | None = None) -> bool:
        """Note an answer and return True if it passed; failing raises the `flag`, by default its own."""
        raised = question.flag if flag is None else flag
        # The class' own `__new__` takes twice as long.
        self._answers.append(tuple.__new__(Check, (question, value, limit, raised)))
        if _FAILS[question.demand](value, limit):
            self.flags |= raised.mask
            return False
        return True

    def ask_whether(self, question: Question, holds: bool) -> bool:
        """Note the answer to a "yes" question and return it."""
        self._answers.append(tuple.__new__(Check, (question, 1.0 if holds else 0.0, 1.0, question.flag)))
        if not holds:
            self.flags |= question.flag.mask
        return holds

    def extend(self, others: FrameChecks) -> None:
        """Add the answers of another record, and their flags."""
        self._answers += others._answers
        self.flags |= others.flags

    def take_answer(self, others: FrameChecks, question: Question) -> None:
        """Take another record's answer to a question, in place of the record's own."""
        theirs = next((check for check in others._answers if check.question is question), None)
        if theirs is None:
            return
        own = next((n for n, check in enumerate(self._answers) if check.question is question), None)
        if own is None:
            self._answers.append(theirs)
        else:
            self._answers[own] = theirs
        self.flags = 0
        for check in self._answers:
            self.flags |= 0 if check.passed else check.flag.mask


FRAME_FORMAT = Question(
    "frame_format", "the frame has the camera's size and the sensor's type", "yes", flags.FRAME_UNREADABLE
)
POSE_KNOWN = Question("pose_known", "a pose is near enough in time", "yes", flags.POSE_REFUSED)
POSE_BRACKETED = Question(
    "pose_bracketed", "the pose lies between two that were received", "yes", flags.POSE_EXTRAPOLATED
)
POSE_RIGID = Question("pose_rigid", "the pose is a rotation and a displacement", "yes", flags.POSE_REFUSED)
LASER_ABOVE = Question(
    "laser_above", "height of the laser over the workpiece", "more_than", flags.BELOW_SURFACE, "mm"
)
LASER_NEAR = Question(
    "laser_near", "height of the laser over the workpiece", "at_most", flags.SEAM_OUT_OF_VIEW, "mm"
)
SHEET_ACROSS = Question(
    "sheet_across", "cosine between the laser sheet's normal and the seam", "at_least", flags.SEAM_OUT_OF_VIEW
)
LASER_AHEAD = Question(
    "laser_ahead", "the laser's lead over the torch along the seam", "at_least", flags.SEAM_REVERSED, "mm"
)
REACH = Question(
    "reach", "how far about the expected seam the stripe was sought", "less_than", flags.SEARCHED, "mm"
)
CAMERA_ABOVE = Question("camera_above", "the camera stands above the workpiece", "yes", flags.BELOW_SURFACE)
STRIPE_EXPECTED = Question(
    "stripe_expected", "the expected stripe lies in the image", "yes", flags.STRIPE_LOST
)
ARC_ON = Question("arc_on", "the arc is on", "yes", flags.ARC_OFF)
ARC_LEVEL_KNOWN = Question(
    "arc_level_known", "enough pixels off the stripe tell the arc's output", "yes", flags.ARC_LEVEL_UNKNOWN
)
ARC_LEVEL = Question("arc_level", "the arc's output over the expected output", "at_least", flags.ARC_OFF)
MAP_MISFIT = Question(
    "map_misfit", "residual of the arc map over its stated uncertainty", "at_most", flags.MAP_MISFIT
)
ARC_AS_STATED = Question(
    "arc_as_stated", "the arc burns, or does not, as the frame came with", "yes", flags.ARC_NOT_SEEN
)
ARC_AS_BEFORE = Question(
    "arc_as_before", "the arc burns, or does not, as in the frame before", "yes", flags.ARC_LOST
)
LASER_ON = Question("laser_on", "the laser is on", "yes", flags.LASER_OFF)
LINES_SATURATED = Question(
    "lines_saturated", "scan lines with saturated pixels in the stripe", "at_most", flags.SATURATED, "lines"
)
STRIPE_INSIDE = Question(
    "stripe_inside", "the stripe stays within the image", "yes", flags.STRIPE_LEAVES_IMAGE
)
LINES_HELD = Question(
    "lines_held", "share of the joint's scan lines that hold a stripe", "at_least", flags.STRIPE_LOST, "share"
)
STRIPE_EVIDENCE = Question(
    "stripe_evidence", "evidence for the stripe over that for a dark stripe", "at_least", flags.STRIPE_LOST
)
CLEAR_LINES_HELD = Question(
    "clear_lines_held",
    "share of the scan lines that would show the stripe clearly and hold it",
    "at_least",
    flags.STRIPE_LOST,
    "share",
)
STRIPE_WHOLE = Question(
    "stripe_whole",
    "share of the joint's scan lines that hold a stripe",
    "at_least",
    flags.STRIPE_PARTIAL,
    "share",
)
SECOND_STRIPE = Question(
    "second_stripe", "brightness of a second stripe over the first", "at_most", flags.TWO_STRIPES, "share"
)
STRIPE_CHOICE = Question(
    "stripe_told",
    "evidence that of two stripes the one that was read is the laser's, nats",
    "at_least",
    flags.STRIPE_AMBIGUOUS,
)
JOINT_TYPE = Question(
    "joint_type", "the profile shows no other type of joint decidedly", "yes", flags.JOINT_TYPE_MISMATCH
)
JOINT_AS_STATED = Question(
    "joint_as_stated",
    "a joint that departs from its shape looks like no other type",
    "yes",
    flags.JOINT_NOT_FOUND,
)
JOINT_SEEN = Question("joint_seen", "the profile determines the joint", "yes", flags.JOINT_NOT_FOUND)
GAP_SHOWN = Question("gap_shown", "the stripe shows the butt joint's gap", "yes", flags.SEAM_BY_LINE)
JOINT_EVIDENCE = Question(
    "joint_evidence",
    "evidence for the joint over a plate without one, nats",
    "at_least",
    flags.JOINT_NOT_FOUND,
)
VIEW_MARGIN = Question(
    "view_margin",
    "distance of the seam from the nearer end of the profile",
    "more_than",
    flags.SEAM_OUT_OF_VIEW,
    "mm",
)
JOINT_CHI2 = Question(
    "joint_chi2", "chi-squared of the joint's fit, per degree of freedom", "at_most", flags.JOINT_MISFIT
)
JOINT_UNEXPLAINED = Question(
    "joint_unexplained",
    "evidence that points off the joint's shape next to the seam are another surface's, nats",
    "at_most",
    flags.JOINT_MISFIT,
)
EDGE_SHOWN = Question(
    "edge_shown",
    "how far another surface covers an upright edge of the joint",
    "at_most",
    flags.JOINT_NOT_FOUND,
    "mm",
)
NEAR_NOMINAL = Question(
    "near_nominal", "distance of the seam from its nominal line", "at_most", flags.SEAM_OUT_OF_VIEW, "mm"
)
SEAM_CONFIRMED = Question(
    "seam_confirmed",
    "a new gap, or a line under a burning arc, is shown beyond doubt or by two frames",
    "yes",
    flags.JOINT_NOT_FOUND,
)
JUMP_Y = Question(
    "jump_y", "distance in y from where the earlier frames put the seam", "at_most", flags.SEAM_JUMP, "mm"
)
JUMP_Z = Question(
    "jump_z", "distance in z from where the earlier frames put the seam", "at_most", flags.SEAM_JUMP, "mm"
)
TORCH_BEFORE_END = Question(
    "torch_before_end", "distance of the torch past the joint's end", "at_most", flags.PAST_JOINT, "mm"
)
TORCH_AFTER_START = Question(
    "torch_after_start", "distance of the torch before the joint's start", "at_most", flags.BEFORE_JOINT, "mm"
)
SEAM_MEASURED = Question("seam_measured", "some of the seam has been measured", "yes", flags.OFFSET_UNKNOWN)
PASS_USABLE = Question("pass_usable", "the seam of the earlier pass is usable", "yes", flags.PASS_UNUSABLE)
PASS_SHARE = Question(
    "pass_share",
    "share of the earlier pass in the seam where the torch stands",
    "at_most",
    flags.PASS_FOLLOWED,
    "share",
)
PASS_AGREES_Y = Question(
    "pass_agrees_y",
    "distance in y from the seam of the earlier pass",
    "at_most",
    flags.PASS_CONTRADICTED,
    "mm",
)
PASS_AGREES_Z = Question(
    "pass_agrees_z",
    "distance in z from the seam of the earlier pass",
    "at_most",
    flags.PASS_CONTRADICTED,
    "mm",
)
PASS_TILT = Question(
    "pass_tilt", "difference between the tool's tilt and the pass's", "at_most", flags.PASS_TILTED, "deg"
)
SEAM_NOT_LOST = Question(
    "seam_not_lost", "distance of the torch past the last measurement", "at_most", flags.OFFSET_HELD, "mm"
)
TORCH_MEASURED = Question(
    "torch_measured", "the seam is measured where the torch stands", "yes", flags.OFFSET_EXTRAPOLATED
)
REACHED = Question(
    "reached", "distance of the torch past the last measurement", "at_most", flags.OFFSET_UNKNOWN, "mm"
)
TORCH_SIGMA = Question(
    "torch_sigma", "sigma of the seam where the torch stands", "at_most", flags.OFFSET_UNKNOWN, "mm"
)
FOLLOWING = Question("following", "following has not been stopped", "yes", flags.FOLLOW_STOPPED)
OFFSET_WITHIN = Question(
    "offset_within", "the offset lies within its stated limit", "yes", flags.OFFSET_LIMITED
)
