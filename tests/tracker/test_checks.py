"""What a step asked: noted as it was, and read as checks."""

import operator
import pickle

from hypothesis import given
from hypothesis import strategies as st

from tracker import checks, flags
from tracker.checks import Check, FrameChecks, Question

QUESTIONS = [question for question in vars(checks).values() if isinstance(question, Question)]

FAILS = {
    "yes": operator.ne,
    "at_least": operator.lt,
    "at_most": operator.gt,
    "more_than": operator.le,
    "less_than": operator.ge,
}


def three() -> FrameChecks:
    """Three questions: one passes, one fails, one fails with a flag that is not its own."""
    asked = FrameChecks()
    assert asked.ask_whether(checks.LASER_ON, True)
    assert not asked.ask(checks.LINES_HELD, 0.1, 0.2)
    assert not asked.ask(checks.SEAM_NOT_LOST, 3.0, 1.0, flags.FOLLOW_STOPPED)
    return asked


def test_answers_say_what_was_asked() -> None:
    laser, held, lost = checks.LASER_ON, checks.LINES_HELD, checks.SEAM_NOT_LOST
    want = (
        Check(laser, 1.0, 1.0, flags.LASER_OFF),
        Check(held, 0.1, 0.2, flags.STRIPE_LOST),
        Check(lost, 3.0, 1.0, flags.FOLLOW_STOPPED),
    )
    answers = three().answers
    assert tuple(answers) == want
    assert [check.passed for check in answers] == [True, False, False]
    assert pickle.loads(pickle.dumps(answers)) == want


def test_questions_are_told_apart_by_their_names() -> None:
    assert checks.FRAME_FORMAT.id == "frame_format"
    assert checks.OFFSET_WITHIN.id == "offset_within"
    assert len({question.id for question in QUESTIONS}) == len(QUESTIONS)


@given(st.sampled_from(QUESTIONS), st.floats() | st.sampled_from([0.0, 1.0]), st.floats(allow_nan=False))
def test_a_value_fails_as_its_question_demands(question: checks.Question, value: float, limit: float) -> None:
    asked = FrameChecks()
    want = not FAILS[question.demand](value, limit)
    assert asked.ask(question, value, limit) == want
    assert asked.flags == (0 if want else question.flag.mask)
    assert asked.answers[0].passed == want
    assert asked.answers[0].flag is question.flag


def test_answers_do_not_change_with_what_is_asked_later() -> None:
    asked = three()
    answers = asked.answers
    asked.ask_whether(checks.ARC_ON, False)
    assert (len(answers), len(asked.answers)) == (3, 4)


def test_flags_are_those_of_the_answers_that_failed() -> None:
    asked, others = three(), FrameChecks()
    assert asked.flags == flags.STRIPE_LOST.mask | flags.FOLLOW_STOPPED.mask
    others.ask_whether(checks.ARC_ON, False)
    asked.extend(others)
    assert asked.flags & flags.ARC_OFF.mask
    assert asked.answers[-1].question is checks.ARC_ON


def test_an_answer_takes_the_place_of_another() -> None:
    asked, others = three(), FrameChecks()
    others.ask(checks.LINES_HELD, 0.9, 0.2)
    others.ask_whether(checks.JOINT_TYPE, False)
    for question in (checks.LINES_HELD, checks.JOINT_TYPE, checks.ARC_ON):
        asked.take_answer(others, question)
    assert [check.question.id for check in asked.answers] == [
        "laser_on",
        "lines_held",
        "seam_not_lost",
        "joint_type",
    ]
    assert asked.answers[1].value == 0.9
    assert asked.flags == flags.FOLLOW_STOPPED.mask | flags.JOINT_TYPE_MISMATCH.mask
