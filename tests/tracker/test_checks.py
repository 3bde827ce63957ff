"""What a step asked: noted as it was, and read as checks."""

import pickle

import numpy as np

from tracker import checks, flags
from tracker.checks import Check, Checks


def asked() -> Checks:
    """Three questions: one passes, one fails, one fails with a flag that is not its own."""
    told = Checks()
    assert told.ask(checks.LASER_ON, np.True_)
    assert not told.ask(checks.LINES_HELD, np.float64(0.1), 0.2)
    assert not told.ask(checks.SEAM_NOT_LOST, 3.0, 1.0, flags.FOLLOW_STOPPED)
    return told


def test_answers_say_what_was_asked() -> None:
    want = (
        Check(checks.LASER_ON, 1.0, 1.0, flags.LASER_OFF),
        Check(checks.LINES_HELD, 0.1, 0.2, flags.STRIPE_LOST),
        Check(checks.SEAM_NOT_LOST, 3.0, 1.0, flags.FOLLOW_STOPPED),
    )
    answers = asked().answers
    assert tuple(answers) == want
    assert (len(answers), answers[1], answers[1:]) == (3, want[1], want[1:])
    assert repr(answers) == repr(want)
    assert [type(check.value) for check in answers] == [float, float, float]
    assert pickle.loads(pickle.dumps(answers)) == answers == want
    assert hash(answers) == hash(want)
    assert answers != want[:2]
    assert asked().answers == answers


def test_answers_do_not_change_with_what_is_asked_later() -> None:
    told = asked()
    answers = told.answers
    told.ask(checks.ARC_ON, False)
    assert (len(answers), len(told.answers)) == (3, 4)


def test_flags_are_those_of_the_answers_that_failed() -> None:
    told, others = asked(), Checks()
    assert told.flags == flags.STRIPE_LOST.mask | flags.FOLLOW_STOPPED.mask
    assert Checks.of(told.answers).flags == told.flags
    others.ask(checks.ARC_ON, False)
    told.extend(others)
    assert told.flags & flags.ARC_OFF.mask
    assert told.answers[-1].question is checks.ARC_ON
