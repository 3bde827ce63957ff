"""What a robot may use of what a tracker says."""

from __future__ import annotations

import math

import pytest
from bus_messages import EXAMPLES
from hypothesis import given
from hypothesis import strategies as st

from robot_io.link.inbox import Received
from robot_io.offset_use import OffsetUse
from robot_io.protocol.messages import (
    Fault,
    LaserState,
    RequestResult,
    SeamOffset,
    Source,
    TrackerHeartbeat,
    TrackerState,
    Validity,
)

OFFSET = EXAMPLES[2]


def beat(rolling, state=TrackerState.TRACKING):
    return TrackerHeartbeat(
        state, Source.LIVE, LaserState.ON, Fault.NONE, 0, RequestResult.NONE, None, rolling
    )


def told(use, message, now_s, max_age_s=0.0):
    use.on_message(Received(0.0, message, 0, max_age_s=max_age_s), now_s)


def following(state=TrackerState.TRACKING):
    use = OffsetUse()
    told(use, beat(255), 0.9)
    told(use, beat(0, state), 1.0)
    told(use, OFFSET, 1.0)
    return use


def test_an_offset_counts_while_heart_and_offset_are_fresh():
    use = following()
    assert use.offset(1.0) == use.offset(1.149) == OFFSET
    # Whoever was killed beats no more.
    assert use.offset(1.151) is None
    assert use.offset(0.999) is None
    told(use, beat(1), 1.15)
    assert use.offset(1.199) == OFFSET
    assert use.offset(1.201) is None


def test_nothing_counts_before_a_second_beat_and_an_offset():
    use = OffsetUse()
    assert use.offset(1.0) is None
    told(use, OFFSET, 1.0)
    told(use, beat(7), 1.0)
    assert use.offset(1.0) is None
    told(use, beat(8), 1.1)
    assert use.offset(1.1) == OFFSET
    use = OffsetUse()
    told(use, beat(7), 1.0)
    told(use, beat(8), 1.1)
    assert use.offset(1.1) is None


def test_one_beat_that_is_missing_ends_it_until_two_follow():
    use = following()
    told(use, beat(2), 1.1)
    assert use.offset(1.1) is None
    told(use, beat(3), 1.15)
    assert use.offset(1.15) == OFFSET


def test_two_trackers_give_no_offset():
    use = following()
    for n in range(1, 40):
        told(use, beat(n), 1.0 + 0.1 * n)
        told(use, beat(100 + n), 1.05 + 0.1 * n)
        told(use, OFFSET, 1.05 + 0.1 * n)
        assert use.offset(1.05 + 0.1 * n) is None


def test_what_waited_is_as_old_as_it_may_be():
    use = following()
    told(use, beat(1), 1.1, max_age_s=3.0)
    assert use.offset(1.1) is None
    use = following()
    told(use, OFFSET, 1.05, max_age_s=0.3)
    assert use.offset(1.05) is None


@pytest.mark.parametrize("state", TrackerState)
def test_only_a_tracker_that_tracks_counts(state):
    counts = state in (TrackerState.SEARCHING, TrackerState.TRACKING, TrackerState.HOLDING)
    assert (following(state).offset(1.0) is not None) == counts


@given(st.sampled_from(Validity))
def test_only_what_is_valid_or_held_counts(validity):
    use = following()
    told(use, SeamOffset(1.0, math.nan, 5.0, 0.9, validity), 1.0)
    assert (use.offset(1.0) is not None) == (validity in (Validity.VALID, Validity.HELD))
