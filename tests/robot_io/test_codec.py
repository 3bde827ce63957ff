from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from bus_messages import EXAMPLES, any_message
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot_io.protocol.codec import CodecError, decode, encode, out_of_range_as_unknown
from robot_io.protocol.dbc import message_layout, payload_signals
from robot_io.protocol.messages import (
    FoundRotation,
    PoseKind,
    QuaternionComponent,
    RobotPosePosition,
    RobotPoseRotation,
    SeamGeometry,
    TrackerCommand,
)

POSITION = RobotPosePosition(1.0, 2.0, 3.0, PoseKind.ACTUAL)


@given(any_message())
def test_round_trip_within_half_a_scale_unit(message):
    arbitration_id, frame = encode(message)
    back = decode(arbitration_id, frame)
    assert type(back) is type(message)
    for signal in payload_signals(message_layout(type(message).__name__)):
        sent, got = getattr(message, signal.name), getattr(back, signal.name)
        if isinstance(sent, float) and not math.isnan(sent):
            assert abs(sent - got) <= 0.5000001 * signal.scale
        else:
            assert type(got) is type(sent)
            assert got == sent or math.isnan(sent)


@given(any_message())
def test_second_round_trip_changes_nothing(message):
    arbitration_id, frame = encode(message)
    assert encode(decode(arbitration_id, frame)) == (arbitration_id, frame)


def test_header_is_left_to_the_protection():
    for message in EXAMPLES:
        _, frame = encode(message)
        assert frame[0] == 0
        assert frame[1] & 0x0F == 0


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_out_of_range_is_an_error_that_names_the_signal(message):
    name = type(message).__name__
    for signal in payload_signals(message_layout(name)):
        if isinstance(getattr(message, signal.name), bool) or signal.choices:
            continue
        for value in (signal.minimum - 0.51 * signal.scale, signal.maximum + 0.51 * signal.scale):
            with pytest.raises(CodecError, match=rf"^{name}\.{signal.name}: .* outside "):
                encode(dataclasses.replace(message, **{signal.name: value}))
        for value in (signal.minimum - 0.49 * signal.scale, signal.maximum + 0.49 * signal.scale):
            encode(dataclasses.replace(message, **{signal.name: value}))


def test_an_error_states_the_range_in_the_signals_unit():
    with pytest.raises(CodecError, match=r"x_mm: 1700 is outside -1638\.38 to 1638\.38 mm; send what fits"):
        encode(dataclasses.replace(POSITION, x_mm=1700.0))


def test_infinity_is_refused():
    with pytest.raises(CodecError, match=r"RobotPosePosition\.z_mm: is inf"):
        encode(dataclasses.replace(POSITION, z_mm=math.inf))


def test_a_signal_that_cannot_be_unknown_refuses_none():
    command = next(m for m in EXAMPLES if isinstance(m, TrackerCommand))
    with pytest.raises(CodecError, match=r"TrackerCommand\.request_number: is None"):
        encode(dataclasses.replace(command, request_number=None))


def test_a_state_without_meaning_is_refused():
    frame = bytearray(8)
    frame[2] = 0x02
    with pytest.raises(CodecError, match=r"RobotStatus\.motion: 4 has no meaning; use one of 0 STOPPED"):
        decode(0x118, frame)


def test_a_raw_code_between_range_and_unknown_is_refused():
    frame = message_layout("SeamOffset").encode(
        {
            "e2e_crc": 0,
            "e2e_counter": 0,
            "offset_y_mm": 0,
            "offset_z_mm": 0,
            "capture_age_ms": 0,
            "confidence": 110,
            "validity": 0,
        },
        scaling=False,
        strict=False,
    )
    with pytest.raises(CodecError, match=r"SeamOffset\.confidence: raw code 110 is outside 0 to 1"):
        decode(0x112, frame)


def test_foreign_identifier_and_wrong_length():
    with pytest.raises(CodecError, match="0x200"):
        decode(0x200, bytes(8))
    for length in (0, 7, 9, 64):
        with pytest.raises(CodecError, match=f"RobotPosePosition: {length} bytes instead of 8"):
            decode(0x110, bytes(length))


def test_unknown_is_never_zero_on_the_wire():
    _, frame = encode(RobotPosePosition(math.nan, 0.0, 0.0, PoseKind.ACTUAL))
    assert int.from_bytes(frame, "little") >> 12 & 0x1FFFF == 0x10000


def test_numbers_of_numpy_are_numbers():
    _, frame = encode(RobotPosePosition(np.float32(1.0), np.float64(2.0), np.float32(3.0), PoseKind.ACTUAL))
    assert frame == encode(POSITION)[1]
    assert math.isnan(decode(0x110, encode(dataclasses.replace(POSITION, x_mm=np.float32("nan")))[1]).x_mm)


def test_out_of_range_as_unknown_keeps_the_rest():
    geometry = SeamGeometry(
        50.0, math.inf, 0.01, 0.02, joint=next(m for m in EXAMPLES if isinstance(m, SeamGeometry)).joint
    )
    sendable = out_of_range_as_unknown(geometry)
    assert math.isnan(sendable.gap_mm)
    assert math.isnan(sendable.mismatch_mm)
    assert (sendable.sigma_y_mm, sendable.sigma_z_mm) == (0.01, 0.02)
    assert out_of_range_as_unknown(POSITION) is POSITION
    # A count that cannot be sent is a mistake, which sending it will name.
    command = next(m for m in EXAMPLES if isinstance(m, TrackerCommand))
    wrong = dataclasses.replace(command, job_number=70_000)
    assert out_of_range_as_unknown(wrong) is wrong


UNIT_QUATERNIONS = (
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(c / math.hypot(*q) for c in q))
)


@pytest.mark.parametrize(
    ("kind", "others", "within_deg"), [(RobotPoseRotation, (), 0.01), (FoundRotation, (0.1, 0.1), 0.04)]
)
@given(quaternion_xyzw=UNIT_QUATERNIONS)
def test_rotations_come_back_within_hundredths_of_a_degree(kind, others, within_deg, quaternion_xyzw):
    arbitration_id, frame = encode(kind.from_quaternion(quaternion_xyzw, *others))
    back = decode(arbitration_id, frame)
    assert isinstance(back, kind)
    assert math.hypot(*back.quaternion_xyzw) == pytest.approx(1.0, abs=1e-9)
    turn = Rotation.from_quat(back.quaternion_xyzw) * Rotation.from_quat(quaternion_xyzw).inv()
    assert math.degrees(turn.magnitude()) < within_deg


def test_a_quaternion_that_is_none_is_refused():
    with pytest.raises(ValueError, match="norm"):
        RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 0.9))
    with pytest.raises(ValueError, match="norm"):
        RobotPoseRotation.from_quaternion((math.nan, 0.0, 0.0, 1.0))


def test_three_components_that_are_not_the_smaller_ones_make_no_rotation():
    assert all(map(math.isnan, RobotPoseRotation(QuaternionComponent.W, 0.7, 0.7, 0.1, 0.0).quaternion_xyzw))
    unknown = RobotPoseRotation(QuaternionComponent.W, math.nan, 0.0, 0.0, 0.0)
    assert all(map(math.isnan, unknown.quaternion_xyzw))
