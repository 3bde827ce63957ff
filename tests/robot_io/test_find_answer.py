"""The robot's side of a FIND: an answer is whole, of one request, or it is not there."""

from __future__ import annotations

import math
from dataclasses import replace

import can
import pytest
from bus_messages import EXAMPLES
from hypothesis import given
from hypothesis import strategies as st

from robot_io import (
    ANY_SOURCE,
    FindAnswer,
    FindAssembler,
    FindRefusal,
    FindResult,
    FoundPosition,
    FoundRotation,
    Inbox,
    Protector,
    Source,
)

RESULT = next(m for m in EXAMPLES if isinstance(m, FindResult))
ROTATION = FoundRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), math.nan, 0.2)


class Heard:
    """Answers that a robot makes of frames, each sent by a tracker some time after the one before."""

    def __init__(self, source: Source = Source.LIVE) -> None:
        self.protector, self.inbox, self.assembler = Protector(source), Inbox(ANY_SOURCE), FindAssembler()
        self.now_s = 0.0

    def send(
        self, number: int, lost: frozenset[int] = frozenset(), apart_s: float = 0.001
    ) -> list[FindAnswer]:
        """Send the answer to a request, whose position has x = its number, but for its lost frames."""
        sent = (replace(RESULT, request_number=number), FoundPosition(float(number), 0.0, 0.0), ROTATION)
        answers = []
        for n, message in enumerate(sent):
            self.now_s += apart_s
            arbitration_id, data = self.protector.protect(message)
            frame = can.Message(
                timestamp=self.now_s, arbitration_id=arbitration_id, data=data, is_extended_id=False
            )
            received = None if n in lost else self.inbox.receive(frame)
            answer = None if received is None else self.assembler.push(received)
            answers += [] if answer is None else [answer]
        return answers


@given(st.lists(st.frozensets(st.integers(0, 2)), max_size=40))
def test_an_answer_that_lost_a_frame_is_missing_and_no_other_takes_its_place(lost_frames) -> None:
    heard = Heard()
    for number, lost in enumerate(lost_frames):
        answers = heard.send(number, lost)
        # A frame after more than two lost ones is dropped, too: then this one is missing as well.
        assert len(answers) <= (not lost)
        for answer in answers:
            assert answer.result.request_number == answer.position.x_mm == number
            assert answer.is_found


def test_each_answer_comes_once_and_one_that_is_slow_never() -> None:
    heard = Heard()
    assert [len(heard.send(number)) for number in range(20)] == [1] * 20
    assert heard.send(20, apart_s=0.2) == []
    assert len(heard.send(21)) == 1


def test_parts_of_two_sources_make_no_answer() -> None:
    heard = Heard()
    heard.send(1, lost=frozenset({1}))
    heard.protector = Protector(Source.REPLAY)
    assert heard.send(1, lost=frozenset({0})) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"result": replace(RESULT, refusal=FindRefusal.STRIPE_LOST)},
        {"result": replace(RESULT, refusal=FindRefusal.UNKNOWN)},
        {"position": FoundPosition(0.0, math.nan, 0.0)},
        {"rotation": replace(ROTATION, small_b=math.nan)},
    ],
)
def test_a_joint_is_found_only_if_all_is_known(changes) -> None:
    answer = FindAnswer(RESULT, FoundPosition(0.0, 0.0, 0.0), ROTATION)
    assert answer.is_found
    assert not replace(answer, **changes).is_found
