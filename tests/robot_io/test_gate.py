from __future__ import annotations

import dataclasses
import math

import pytest
from bus_messages import EXAMPLES
from hypothesis import given
from hypothesis import strategies as st

from robot_io.gate import Conditions, LastSent, Proposal, Verdict, decide
from robot_io.gate_limits import GateLimits
from robot_io.protocol.codec import encode
from robot_io.protocol.messages import (
    GateReason,
    MotionState,
    RobotMode,
    RobotStatus,
    Switch,
    Validity,
    WeldingState,
)

ROBOT = next(m for m in EXAMPLES if isinstance(m, RobotStatus))
# Binary fractions throughout, so that values at a limit are exactly at it.
LIMITS = GateLimits(
    range_y_mm=8.0,
    range_z_mm=4.0,
    rate_y_mm_s=2.0,
    rate_z_mm_s=1.0,
    jump_mm=1.5,
    capture_age_s=0.125,
    confidence=0.75,
    hold_s=0.5,
    sigma_y_mm=0.25,
    sigma_z_mm=0.5,
)
NOW_S = 16.0
GOOD = Proposal(
    captured_at_s=NOW_S, offset_y_mm=0.5, offset_z_mm=-0.25, confidence=1.0, sigma_y_mm=0.0, sigma_z_mm=0.0
)
READY = Conditions(armed=True, enable_y=True, enable_z=True, robot=ROBOT)


def sent(captured_at_s, offset_y_mm=0.5, offset_z_mm=-0.25, confidence=0.875):
    """Return what the gate remembers of an offset that it let through."""
    return LastSent(
        captured_at_s,
        offset_y_mm,
        offset_z_mm,
        confidence,
        captured_at_s,
        captured_at_s,
        offset_y_mm,
        offset_z_mm,
    )


LAST = sent(NOW_S - 0.25)


def judge(proposal=None, conditions=None, last=LAST, limits=LIMITS, now_s=NOW_S, **changes):
    """Decide on the good proposal with changed fields."""
    changed = dataclasses.replace(GOOD if proposal is None else proposal, **changes)
    return decide(changed, READY if conditions is None else conditions, limits, last, now_s)


def above(value):
    return math.nextafter(value, math.inf)


def below(value):
    return math.nextafter(value, -math.inf)


def test_a_good_offset_goes_out_as_it_is():
    decision = judge()
    assert (decision.verdict, decision.reason) == (Verdict.SEND, GateReason.NONE)
    message = decision.message
    assert (message.offset_y_mm, message.offset_z_mm, message.confidence) == (0.5, -0.25, 1.0)
    assert (message.capture_age_ms, message.validity) == (0.0, Validity.VALID)
    assert decision.last_sent == sent(NOW_S, confidence=1.0)


def test_what_was_sent_is_as_old_as_before_by_a_clock_that_was_set_back():
    assert LAST.set_back(0.5) == sent(NOW_S - 0.75)
    assert math.isnan(LastSent().set_back(0.5).captured_at_s)


@pytest.mark.parametrize(
    ("robot_changes", "reason"),
    [
        ({"emergency_stop": Switch.ON}, GateReason.EMERGENCY_STOP),
        ({"emergency_stop": Switch.UNKNOWN}, GateReason.EMERGENCY_STOP),
        ({"mode": RobotMode.MANUAL}, GateReason.NOT_AUTOMATIC),
        ({"mode": RobotMode.UNKNOWN}, GateReason.NOT_AUTOMATIC),
        ({"correction": Switch.OFF}, GateReason.CORRECTION_OFF),
        ({"correction": Switch.UNKNOWN}, GateReason.CORRECTION_OFF),
        ({"arc": Switch.OFF}, GateReason.ARC_OFF),
        ({"arc": Switch.UNKNOWN}, GateReason.ARC_OFF),
        ({"motion": MotionState.STOPPED}, GateReason.ROBOT_NOT_MOVING),
        ({"motion": MotionState.PAUSED}, GateReason.ROBOT_NOT_MOVING),
        ({"motion": MotionState.RETRACTING}, GateReason.ROBOT_NOT_MOVING),
        ({"motion": MotionState.UNKNOWN}, GateReason.ROBOT_NOT_MOVING),
        ({"welding": WeldingState.FAULT}, GateReason.WELDING_FAULT),
        *(
            ({"welding": welding}, GateReason.NOT_WELDING)
            for welding in WeldingState
            if welding not in (WeldingState.WELDING, WeldingState.FAULT)
        ),
    ],
)
def test_the_robot_must_be_ready(robot_changes, reason):
    decision = judge(conditions=dataclasses.replace(READY, robot=dataclasses.replace(ROBOT, **robot_changes)))
    assert (decision.verdict, decision.reason) == (Verdict.REFUSE, reason)
    assert decision.message.validity is Validity.REFUSED
    assert math.isnan(decision.message.offset_y_mm)
    assert math.isnan(decision.message.offset_z_mm)
    assert decision.last_sent == LAST


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"armed": False}, GateReason.NOT_ARMED),
        ({"robot": None}, GateReason.ROBOT_STATUS_STALE),
        ({"enable_y": False, "enable_z": False}, GateReason.NO_AXIS_ENABLED),
        ({"fault": GateReason.OTHER_TRACKER, "armed": False}, GateReason.OTHER_TRACKER),
        ({"doubt": GateReason.POSE_IMPLAUSIBLE}, GateReason.POSE_IMPLAUSIBLE),
        ({"doubt": GateReason.POSE_IMPLAUSIBLE, "robot": None}, GateReason.ROBOT_STATUS_STALE),
    ],
)
def test_the_conditions_must_hold(changes, reason):
    decision = judge(conditions=dataclasses.replace(READY, **changes))
    assert (decision.verdict, decision.reason) == (Verdict.REFUSE, reason)


def test_dry_run_without_arc_passes_only_if_the_arc_is_not_required():
    dry = dataclasses.replace(ROBOT, mode=RobotMode.DRY_RUN, arc=Switch.OFF)
    conditions = dataclasses.replace(READY, robot=dry)
    assert judge(conditions=conditions).reason is GateReason.ARC_OFF
    relaxed = dataclasses.replace(LIMITS, arc_required=False)
    for welding in WeldingState:
        off = dataclasses.replace(READY, robot=dataclasses.replace(dry, welding=welding))
        reason = {
            WeldingState.FAULT: GateReason.WELDING_FAULT,
            WeldingState.UNKNOWN: GateReason.NOT_WELDING,
        }.get(welding, GateReason.NONE)
        assert judge(conditions=off, limits=relaxed).reason is reason
    still = dataclasses.replace(READY, robot=dataclasses.replace(dry, motion=MotionState.STOPPED))
    assert judge(conditions=still, limits=relaxed).reason is GateReason.ROBOT_NOT_MOVING


def test_a_commanded_hold_repeats_the_last_offset_and_ends():
    hold = dataclasses.replace(READY, hold=True)
    decision = judge(conditions=hold, offset_y_mm=0.75)
    assert (decision.verdict, decision.reason) == (Verdict.HOLD, GateReason.HOLD_COMMANDED)
    assert decision.message.offset_y_mm == 0.5
    assert judge(conditions=hold, last=sent(below(NOW_S - 0.5))).verdict is Verdict.REFUSE


def test_disarming_forgets_the_last_offset():
    assert judge(conditions=dataclasses.replace(READY, armed=False)).last_sent == LastSent()


AT_AND_BEYOND = [
    ("confidence", 0.75, below(0.75), GateReason.LOW_CONFIDENCE),
    ("confidence", 1.0, above(1.0), GateReason.LOW_CONFIDENCE),
    ("sigma_y_mm", 0.0, below(0.0), GateReason.SIGMA_TOO_LARGE),
    ("sigma_y_mm", 0.25, above(0.25), GateReason.SIGMA_TOO_LARGE),
    ("sigma_z_mm", 0.5, above(0.5), GateReason.SIGMA_TOO_LARGE),
    ("captured_at_s", NOW_S, above(NOW_S), GateReason.CAPTURE_IN_FUTURE),
    ("captured_at_s", NOW_S - 0.125, below(NOW_S - 0.125), GateReason.CAPTURE_TOO_OLD),
    # A quarter of a second after the last one: 0.5 mm and 0.25 mm of change at most.
    ("offset_y_mm", 1.0, above(1.0), GateReason.RATE_TOO_HIGH),
    ("offset_y_mm", 0.0, -(2.0**-40), GateReason.RATE_TOO_HIGH),
    ("offset_z_mm", 0.0, 2.0**-40, GateReason.RATE_TOO_HIGH),
    ("offset_z_mm", -0.5, below(-0.5), GateReason.RATE_TOO_HIGH),
]


@pytest.mark.parametrize(("name", "at_limit", "beyond", "reason"), AT_AND_BEYOND)
def test_each_limit_is_inclusive_and_beyond_it_the_last_offset_is_held(name, at_limit, beyond, reason):
    assert judge(**{name: at_limit}).verdict is Verdict.SEND
    decision = judge(**{name: beyond})
    assert (decision.verdict, decision.reason) == (Verdict.HOLD, reason)
    assert (decision.message.offset_y_mm, decision.message.offset_z_mm) == (0.5, -0.25)
    assert (decision.message.confidence, decision.message.capture_age_ms) == (0.875, 250.0)
    assert decision.message.validity is Validity.HELD
    assert decision.last_sent == LAST


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("name", "limit"), [("offset_y_mm", 8.0), ("offset_z_mm", 4.0)])
def test_range_is_inclusive(name, limit, sign):
    measured = name.replace("offset", "measured")
    near = dataclasses.replace(LAST, **{name: sign * limit, measured: sign * limit})
    assert judge(last=near, **{name: sign * limit}).verdict is Verdict.SEND
    beyond = judge(last=near, **{name: sign * above(limit)})
    assert (beyond.verdict, beyond.reason) == (Verdict.HOLD, GateReason.OUT_OF_RANGE)
    assert abs(getattr(beyond.message, name)) == limit


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(Proposal)])
def test_what_is_not_finite_is_never_sent(name, value):
    decision = judge(**{name: value})
    assert decision.verdict is Verdict.HOLD
    expected = {
        "confidence": GateReason.LOW_CONFIDENCE,
        "sigma_y_mm": GateReason.SIGMA_TOO_LARGE,
        "sigma_z_mm": GateReason.SIGMA_TOO_LARGE,
    }
    assert decision.reason is expected.get(name, GateReason.NOT_MEASURED)


def test_an_axis_that_is_off_is_neither_checked_nor_sent():
    only_z = dataclasses.replace(READY, enable_y=False)
    decision = judge(conditions=only_z, offset_y_mm=math.nan, sigma_y_mm=math.nan)
    assert decision.verdict is Verdict.SEND
    assert math.isnan(decision.message.offset_y_mm)
    assert decision.message.offset_z_mm == -0.25
    assert decision.last_sent.captured_y_at_s == LAST.captured_at_s
    only_y = dataclasses.replace(READY, enable_z=False)
    decision = judge(conditions=only_y, offset_z_mm=100.0, sigma_z_mm=100.0)
    assert decision.verdict is Verdict.SEND
    assert math.isnan(decision.message.offset_z_mm)
    assert decision.message.offset_y_mm == 0.5


def test_a_held_offset_leaves_out_an_axis_that_was_switched_off_since():
    decision = judge(conditions=dataclasses.replace(READY, enable_y=False), confidence=0.0)
    assert decision.verdict is Verdict.HOLD
    assert math.isnan(decision.message.offset_y_mm)
    assert decision.message.offset_z_mm == -0.25


def test_switching_an_axis_off_and_on_does_not_pass_the_rate_limit():
    only_y = dataclasses.replace(READY, enable_z=False)
    off = judge(conditions=only_y, captured_at_s=NOW_S - 0.125)
    assert off.verdict is Verdict.SEND
    # A quarter of a second since z was sent: 0.25 mm at most.
    assert judge(last=off.last_sent, offset_z_mm=-0.5).verdict is Verdict.SEND
    jump = judge(last=off.last_sent, offset_z_mm=-1.0)
    assert (jump.verdict, jump.reason) == (Verdict.HOLD, GateReason.RATE_TOO_HIGH)
    # What is held is what went out last, and z was no part of it.
    assert (jump.message.offset_y_mm, jump.message.capture_age_ms) == (0.5, 125.0)
    assert math.isnan(jump.message.offset_z_mm)


def test_a_hold_needs_something_to_hold():
    assert judge(confidence=0.0, last=LastSent()).verdict is Verdict.REFUSE
    only_y = dataclasses.replace(LAST, offset_z_mm=math.nan, captured_z_at_s=math.nan)
    refused = judge(confidence=0.0, last=only_y, conditions=dataclasses.replace(READY, enable_y=False))
    assert (refused.verdict, refused.reason) == (Verdict.REFUSE, GateReason.LOW_CONFIDENCE)


def test_a_hold_ends():
    at_limit = sent(NOW_S - 0.5)
    assert judge(confidence=0.0, last=at_limit).verdict is Verdict.HOLD
    expired = sent(below(NOW_S - 0.5))
    decision = judge(confidence=0.0, last=expired)
    assert (decision.verdict, decision.reason) == (Verdict.REFUSE, GateReason.LOW_CONFIDENCE)
    assert decision.last_sent == expired


def test_a_clock_that_ran_backwards_holds_nothing():
    later = sent(NOW_S + 1.0)
    decision = judge(last=later)
    assert (decision.verdict, decision.reason) == (Verdict.REFUSE, GateReason.RATE_TOO_HIGH)


def test_the_first_offset_is_nought_and_keeps_to_the_range():
    first = judge(last=LastSent(), offset_y_mm=8.0, offset_z_mm=-4.0)
    assert (first.verdict, first.reason) == (Verdict.SEND, GateReason.SOFT_START)
    message = first.message
    assert (message.offset_y_mm, message.offset_z_mm, message.confidence) == (0.0, 0.0, 0.0)
    assert message.validity is Validity.VALID
    assert judge(last=LastSent(), offset_y_mm=above(8.0)).reason is GateReason.OUT_OF_RANGE
    # Nothing is on its way where nought was measured.
    assert judge(last=LastSent(), offset_y_mm=0.0, offset_z_mm=0.0).reason is GateReason.NONE


def test_a_soft_start_comes_to_the_seam_at_the_rate_limit():
    last, offsets_mm = LastSent(), []
    for n in range(12):
        at_s = NOW_S + 0.125 * n
        decision = judge(last=last, captured_at_s=at_s, now_s=at_s, offset_y_mm=2.0, offset_z_mm=-0.5)
        assert decision.verdict is Verdict.SEND
        last = decision.last_sent
        offsets_mm.append((decision.message.offset_y_mm, decision.message.offset_z_mm))
        is_there = offsets_mm[-1] == (2.0, -0.5)
        assert (decision.reason is GateReason.NONE) == is_there
        assert decision.message.confidence == (1.0 if is_there else 0.0)
    # 2 and 1 mm/s: a quarter and an eighth of a millimetre each time.
    assert offsets_mm == [(min(2.0, 0.25 * n), max(-0.5, -0.125 * n)) for n in range(12)]


def test_on_its_way_the_seam_may_not_jump():
    first = judge(last=LastSent(), offset_y_mm=2.0)
    later = {"captured_at_s": NOW_S + 0.25, "now_s": NOW_S + 0.25, "last": first.last_sent}
    assert judge(offset_y_mm=2.5, **later).verdict is Verdict.SEND
    assert judge(offset_y_mm=above(2.5), **later).reason is GateReason.RATE_TOO_HIGH


def test_a_jump_is_none_however_long_it_took():
    limits = dataclasses.replace(LIMITS, rate_y_mm_s=64.0, rate_z_mm_s=64.0)
    for name, start_mm in (("offset_y_mm", 0.5), ("offset_z_mm", -0.25)):
        for sign in (1.0, -1.0):
            decision = judge(limits=limits, **{name: start_mm + sign * 1.5})
            assert decision.verdict is Verdict.SEND
            decision = judge(limits=limits, **{name: start_mm + sign * (1.5 + 2.0**-40)})
            assert (decision.verdict, decision.reason) == (Verdict.HOLD, GateReason.JUMP)
    # After a silence a soft start is no faster either.
    started = dataclasses.replace(LAST, offset_y_mm=-2.0)
    assert judge(limits=limits, last=started).message.offset_y_mm == -0.5


def test_waiting_does_not_buy_more_than_the_hold():
    # hold 0.5 s at 2 mm/s: 1 mm, however long ago the last offset went out.
    long_ago = sent(NOW_S - 8.0)
    assert judge(last=long_ago, offset_y_mm=1.5).verdict is Verdict.SEND
    decision = judge(last=long_ago, offset_y_mm=above(1.5))
    assert (decision.verdict, decision.reason) == (Verdict.REFUSE, GateReason.RATE_TOO_HIGH)


def test_the_same_capture_again_is_sent_again_but_a_changed_one_is_not():
    same = sent(NOW_S)
    assert judge(last=same).verdict is Verdict.SEND
    changed = judge(last=same, offset_y_mm=above(0.5))
    assert (changed.verdict, changed.reason) == (Verdict.HOLD, GateReason.RATE_TOO_HIGH)


@pytest.mark.parametrize(
    "limit",
    [f.name for f in dataclasses.fields(GateLimits) if f.name != "arc_required"],
)
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_limits_must_make_sense(limit, value):
    with pytest.raises(ValueError, match=f"gate limit {limit}"):
        dataclasses.replace(LIMITS, **{limit: value})


def test_limits_must_fit_the_bus():
    dataclasses.replace(LIMITS, range_y_mm=32.767, range_z_mm=32.767, confidence=1.0)
    for changes in ({"range_y_mm": 32.768}, {"range_z_mm": 32.768}, {"confidence": above(1.0)}):
        with pytest.raises(ValueError, match="gate limit"):
            dataclasses.replace(LIMITS, **changes)


MAYBE = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-10.0, 10.0)


@pytest.mark.slow
@given(
    st.builds(Proposal, st.floats(15.0, 17.0) | MAYBE, MAYBE, MAYBE, MAYBE, MAYBE, MAYBE),
    st.builds(Conditions, st.booleans(), st.booleans(), st.booleans(), st.just(ROBOT) | st.none()),
    st.just(LAST) | st.just(LastSent()),
)
def test_whatever_comes_out_keeps_to_the_limits_and_fits_the_bus(proposal, conditions, last):
    decision = decide(proposal, conditions, LIMITS, last, NOW_S)
    encode(decision.message)
    assert (decision.verdict is Verdict.SEND) == (decision.reason in (GateReason.NONE, GateReason.SOFT_START))
    if decision.verdict is Verdict.REFUSE:
        return
    assert conditions.armed
    assert conditions.robot is not None
    for offset_mm, enabled, range_mm in (
        (decision.message.offset_y_mm, conditions.enable_y, LIMITS.range_y_mm),
        (decision.message.offset_z_mm, conditions.enable_z, LIMITS.range_z_mm),
    ):
        assert math.isnan(offset_mm) != (enabled and abs(offset_mm) <= range_mm)
