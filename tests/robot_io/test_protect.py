from __future__ import annotations

import math

import can
import numpy as np
import pytest
from bus_messages import EXAMPLES, any_message
from e2e.p11 import e2e_p11_protect
from hypothesis import given
from hypothesis import strategies as st

from robot_io.link.inbox import ANY_SOURCE, Inbox, SkipReason, Trusted
from robot_io.protocol.codec import encode
from robot_io.protocol.dbc import e2e_data_id, message_layout
from robot_io.protocol.messages import (
    DbcVersion,
    RobotPosePosition,
    RobotPoseRotation,
    RobotStatus,
    SeamOffset,
    SeamPoint,
    Source,
)
from robot_io.protocol.protect import (
    COUNTER_MODULUS,
    SOURCES,
    Checker,
    CheckStatus,
    Protector,
    counter_of,
    source_of,
)

POSITION, ROTATION, OFFSET = EXAMPLES[:3]


def data_id(message):
    return e2e_data_id(message_layout(type(message).__name__))


def frame_of(arbitration_id, payload, timestamp_s=0.0):
    return can.Message(
        timestamp=timestamp_s, arbitration_id=arbitration_id, data=payload, is_extended_id=False
    )


def with_counter(message, counter):
    arbitration_id, frame = encode(message)
    frame[1] = (frame[1] & 0xF0) | counter
    e2e_p11_protect(frame, data_id(message), increment_counter=False)
    return arbitration_id, bytes(frame)


def test_crc_is_the_standards():
    # The example of the AUTOSAR specification for profile 11: data id 0x123, eight bytes of zero.
    frame = bytearray(8)
    e2e_p11_protect(frame, 0x123, increment_counter=False)
    assert frame[0] == 0xCC


@given(any_message())
def test_payload_survives_the_protection(message):
    arbitration_id, bare = encode(message)
    protected_id, frame = Protector().protect(message)
    assert protected_id == arbitration_id
    assert (frame[1] & 0xF0, frame[2:]) == (bare[1] & 0xF0, bytes(bare[2:]))
    assert Checker().check(data_id(message), frame) is CheckStatus.OK


@given(any_message(), st.sets(st.integers(0, 63), min_size=1, max_size=2))
def test_up_to_two_flipped_bits_are_always_found(message, bits):
    # The polynomial 0x1D is primitive: Hamming distance 3 up to 247 bits of data.
    _, frame = Protector().protect(message)
    flipped = int.from_bytes(frame, "little") ^ sum(1 << bit for bit in bits)
    assert Checker().check(data_id(message), flipped.to_bytes(8, "little")) is CheckStatus.ERROR


@given(any_message(), st.integers(0, 48), st.integers(1, 255))
def test_bursts_up_to_eight_bits_in_the_payload_are_always_found(message, start, pattern):
    # A burst is contiguous in the order in which the CRC runs: bytes 1 to 7, most significant bit first.
    _, frame = Protector().protect(message)
    flipped = int.from_bytes(frame, "big") ^ (pattern << start)
    assert Checker().check(data_id(message), flipped.to_bytes(8, "big")) is CheckStatus.ERROR


def test_other_damage_is_missed_at_most_once_in_256():
    _, frame = Protector().protect(OFFSET)
    whole = int.from_bytes(frame, "big")
    rng = np.random.default_rng(1)
    damaged = (whole ^ int.from_bytes(rng.bytes(8), "big") for _ in range(20_000))
    missed = sum(
        Checker().check(data_id(OFFSET), d.to_bytes(8, "big")) is not CheckStatus.ERROR for d in damaged
    )
    assert missed / 20_000 < 1.5 / 256


def test_another_messages_frame_is_found():
    for message in EXAMPLES:
        _, frame = Protector().protect(message)
        for other in EXAMPLES:
            if type(other) is not type(message):
                assert Checker().check(data_id(other), frame) is CheckStatus.ERROR


def test_counters_run_from_0_to_14_for_each_message_alone():
    protector = Protector()
    counters = []
    for _ in range(17):
        protector.protect(EXAMPLES[7])
        counters.append(counter_of(protector.protect(OFFSET)[1]))
    assert counters == [*range(15), 0, 1]


def test_a_lost_position_does_not_put_later_pairs_out_of_step():
    protector = Protector()
    for _ in range(3):
        protector.protect(POSITION)
    position, rotation = protector.protect(POSITION)[1], protector.protect(ROTATION)[1]
    assert counter_of(position) == counter_of(rotation) == 3


def test_a_seam_point_carries_the_counter_of_its_offset():
    protector = Protector()
    for _ in range(5):
        offset, point = protector.protect(OFFSET)[1], protector.protect(EXAMPLES[8])[1]
        assert isinstance(EXAMPLES[8], SeamPoint)
        assert counter_of(offset) == counter_of(point)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("source", [Source.REPLAY, Source.SIMULATION])
def test_no_frame_of_another_source_is_taken_for_a_live_one(message, source):
    frame = frame_of(*Protector(source).protect(message))
    assert source_of(message_layout(type(message).__name__), frame.data) is source
    inbox = Inbox()
    assert inbox.receive(frame) is None
    assert inbox.skipped == {SkipReason.OTHER_SOURCE: 1}
    # Nor does one flipped bit make it one.
    for bit in range(64):
        flipped = int.from_bytes(frame.data, "little") ^ (1 << bit)
        assert Inbox().receive(frame_of(frame.arbitration_id, flipped.to_bytes(8, "little"))) is None
    assert Inbox(ANY_SOURCE).receive(frame).source is source


def test_trust_is_by_sender():
    trusted = Trusted(robot=(Source.LIVE,), tracker=(Source.REPLAY,))
    status = next(m for m in EXAMPLES if isinstance(m, RobotStatus))
    for source in SOURCES:
        inbox = Inbox(trusted)
        robots = inbox.receive(frame_of(*Protector(source).protect(status)))
        trackers = inbox.receive(frame_of(*Protector(source).protect(OFFSET)))
        assert (robots is not None) == (source is Source.LIVE)
        assert (trackers is not None) == (source is Source.REPLAY)


def test_two_sources_of_a_message_are_counted_apart():
    inbox = Inbox(ANY_SOURCE)
    live, replay = Protector(), Protector(Source.REPLAY)
    for _ in range(20):
        assert inbox.receive(frame_of(*live.protect(OFFSET))).source is Source.LIVE
    for _ in range(20):
        assert inbox.receive(frame_of(*replay.protect(OFFSET))).source is Source.REPLAY
    assert not inbox.skipped


def test_nothing_is_sent_of_an_unknown_source():
    with pytest.raises(ValueError, match="source UNKNOWN"):
        Protector(Source.UNKNOWN)


@given(st.integers(0, 14), st.integers(1, 14), st.lists(st.integers(0, 14), max_size=20))
def test_counter_semantics(start, max_delta, steps):
    checker = Checker(max_delta)
    counter = start
    checker.check(data_id(OFFSET), with_counter(OFFSET, counter)[1])
    for step in steps:
        counter = (counter + step) % COUNTER_MODULUS
        status = checker.check(data_id(OFFSET), with_counter(OFFSET, counter)[1])
        if step == 0:
            assert status is CheckStatus.REPEATED
        elif step > max_delta:
            assert status is CheckStatus.WRONG_SEQUENCE
        else:
            assert status is (CheckStatus.OK if step == 1 else CheckStatus.OK_SOME_LOST)
        assert status.accepted == (1 <= step <= max_delta)


def test_two_frames_in_a_row_may_be_lost_and_no_third():
    for lost, status in ((2, CheckStatus.OK_SOME_LOST), (3, CheckStatus.WRONG_SEQUENCE)):
        checker = Checker()
        checker.check(data_id(OFFSET), with_counter(OFFSET, 0)[1])
        assert checker.check(data_id(OFFSET), with_counter(OFFSET, 1 + lost)[1]) is status


def test_a_half_without_its_other_counts_from_nought():
    assert counter_of(Protector().protect(ROTATION)[1]) == 0


def test_a_checker_takes_a_fresh_senders_first_frame():
    assert Checker().check(data_id(OFFSET), with_counter(OFFSET, 0)[1]) is CheckStatus.OK


def test_a_checker_that_joins_late_takes_the_second_frame():
    checker = Checker()
    assert checker.check(data_id(OFFSET), with_counter(OFFSET, 9)[1]) is CheckStatus.WRONG_SEQUENCE
    assert checker.check(data_id(OFFSET), with_counter(OFFSET, 10)[1]) is CheckStatus.OK


def test_a_crc_error_does_not_move_the_counter():
    checker = Checker(1)
    checker.check(data_id(OFFSET), with_counter(OFFSET, 0)[1])
    broken = bytearray(with_counter(OFFSET, 1)[1])
    broken[0] ^= 1
    assert checker.check(data_id(OFFSET), broken) is CheckStatus.ERROR
    assert checker.check(data_id(OFFSET), with_counter(OFFSET, 1)[1]) is CheckStatus.OK


def test_counter_15_is_an_error():
    assert Checker().check(data_id(OFFSET), with_counter(OFFSET, 15)[1]) is CheckStatus.ERROR


@pytest.mark.parametrize("max_delta", [0, 15])
def test_max_delta_must_make_sense(max_delta):
    with pytest.raises(ValueError, match=f"max_delta_counter {max_delta}"):
        Checker(max_delta)


def test_inbox_updates_state_only_when_crc_and_counter_pass():
    inbox = Inbox()
    first, second = OFFSET, SeamOffset(1.0, 1.0, 1.0, 1.0, OFFSET.validity)
    received = inbox.receive(frame_of(*with_counter(first, 0), 1.0))
    assert (received.timestamp_s, received.message, received.counter) == (1.0, first, 0)
    arbitration_id, payload = with_counter(second, 1)
    broken = bytes([payload[0] ^ 0x10, *payload[1:]])
    assert inbox.receive(frame_of(arbitration_id, broken, 1.01)) is None
    assert inbox.receive(frame_of(*with_counter(second, 0), 1.02)) is None
    assert inbox.receive(frame_of(*with_counter(second, 9), 1.03)) is None
    assert inbox.latest(SeamOffset, 1.04) == first
    assert inbox.receive(frame_of(*with_counter(second, 10), 1.05)).message == second
    assert inbox.latest(SeamOffset, 1.05) == second
    assert inbox.skipped == {
        SkipReason.E2E_ERROR: 1,
        SkipReason.REPEATED: 1,
        SkipReason.WRONG_SEQUENCE: 1,
    }


def test_inbox_leaves_out_what_is_not_ours():
    inbox = Inbox()
    arbitration_id, payload = with_counter(OFFSET, 0)
    extended = can.Message(arbitration_id=arbitration_id, data=payload, is_extended_id=True)
    remote = can.Message(arbitration_id=arbitration_id, is_remote_frame=True, is_extended_id=False, dlc=8)
    assert inbox.receive(extended) is None
    assert inbox.receive(remote) is None
    assert inbox.receive(frame_of(0x7FF, b"")) is None
    assert inbox.receive(frame_of(arbitration_id, payload[:7])) is None
    undecodable = bytearray(8)
    undecodable[2] = 0x02
    e2e_p11_protect(undecodable, data_id(EXAMPLES[3]), increment_counter=False)
    assert inbox.receive(frame_of(0x118, undecodable)) is None
    assert inbox.skipped == {
        SkipReason.FOREIGN: 3,
        SkipReason.WRONG_LENGTH: 1,
        SkipReason.UNDECODABLE: 1,
    }
    assert inbox.receive(frame_of(arbitration_id, payload)) is not None


def test_latest_is_stale_after_ten_periods():
    inbox = Inbox()
    assert inbox.latest(SeamOffset, 0.0) is None
    inbox.receive(frame_of(*with_counter(OFFSET, 0), 5.0))
    inbox.receive(frame_of(*with_counter(EXAMPLES[7], 0), 5.0))
    assert inbox.latest(SeamOffset, 5.0 + 0.2 - 1e-6) == OFFSET
    assert inbox.latest(SeamOffset, 5.0 + 0.2 + 1e-6) is None
    # A clock that was set back does not make it fresh.
    assert inbox.latest(SeamOffset, 5.0 - 0.2 - 1e-6) is None
    assert inbox.latest(SeamOffset, math.nan) is None
    assert inbox.latest(DbcVersion, 14.9) == EXAMPLES[7]
    assert inbox.latest(RobotPosePosition, 5.0) is None
    assert inbox.latest(RobotPoseRotation, 5.0) is None
