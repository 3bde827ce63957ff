"""Plausible poses held against each bound: just within it, and just beyond."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot_io import MotionState
from robot_io.poses.nominal_path import NominalPath
from robot_io.poses.plausibility import Plausibility, update
from robot_io.poses.pose_questions import Implausibility, PoseArrival
from tests.robot_io.moving_robot import LIMITS, PATH, Robot, doubts, moved, on_the_bus, status
from tests.robot_io.test_plausibility import FAULT_S, names

STEP_S = 1.0 / 64.0
EXACT = replace(
    LIMITS, gap_s=0.125, prove_s=0.25, settle_s=0.25, frozen_s=0.125, window_s=0.5, time_jitter_s=0.0
)
"""Limits that are binary fractions, so that times at a limit are exactly at it."""


def still(t_s, place_mm=(10.0, 40.0, 0.0), quaternion=(0.0, 0.0, 0.0, 1.0), robot=None):
    sample = on_the_bus(t_s, place_mm, Rotation.identity())
    return PoseArrival(replace(sample, position_base_mm=place_mm, quaternion_xyzw=quaternion), robot)


def after(times_s, limits=EXACT, path=None, state=None, **seen):
    state = Plausibility() if state is None else state
    for t_s in times_s:
        state = update(state, still(t_s, **seen), limits, path)
    return state


def steps(from_s, to_s):
    """Yield times, both ends included."""
    return [from_s + STEP_S * n for n in range(round((to_s - from_s) / STEP_S) + 1)]


def test_trust_comes_exactly_with_the_time_that_proves():
    assert after(steps(1.0, 1.25 - STEP_S)).doubt is Implausibility.UNPROVEN
    assert after(steps(1.0, 1.25)).doubt is None


def test_poses_may_be_silent_for_exactly_the_gap():
    trusted = after(steps(1.0, 2.0))
    assert trusted.at(2.125, EXACT) is None
    assert trusted.at(2.125 + STEP_S, EXACT) is Implausibility.STOPPED
    assert trusted.at(1.875, EXACT) is None
    assert trusted.at(1.875 - STEP_S, EXACT) is Implausibility.STOPPED
    assert after([2.125], state=trusted).doubt is None
    stopped = after([2.125 + STEP_S], state=trusted)
    assert stopped.doubt is Implausibility.STOPPED
    # What was before the silence is no part of the window any more.
    assert len(stopped.window) == 1
    # As long back is a sample that is late, and longer a clock that was set back.
    late = after([1.875], state=trusted)
    assert late.doubt is Implausibility.TIME_BACKWARDS
    assert late.window == trusted.window
    set_back = after([1.875 - STEP_S], state=trusted)
    assert set_back.doubt is Implausibility.TIME_BACKWARDS
    assert len(set_back.window) == 1


def test_the_window_reaches_exactly_so_far_back():
    assert [k.time_s for k in after(steps(1.0, 2.0)).window] == steps(1.5, 2.0)


@pytest.mark.parametrize("n", range(8))
def test_each_value_of_a_pose_must_be_finite(n):
    values = [1.0, 10.0, 40.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    values[n] = math.inf
    seen = still(1.0)
    sample = replace(
        seen.sample,
        timestamp_s=values[0],
        position_base_mm=tuple(values[1:4]),
        quaternion_xyzw=tuple(values[4:]),
    )
    with pytest.raises(ValueError, match="not finite"):
        update(Plausibility(), replace(seen, sample=sample), EXACT, None)


@pytest.mark.parametrize(
    ("speed_mm_s", "other_mm_s", "is_same"),
    [(10.0, 10.5, True), (10.0, 9.5, True), (10.0, 10.53, False), (1.0, 1.09, True), (1.0, 1.13, False)],
)
def test_a_stated_speed_ripples_by_a_share_or_by_two_steps_of_the_bus(speed_mm_s, other_mm_s, is_same):
    state = after(steps(1.0, 2.0), robot=status(speed_mm_s=speed_mm_s))
    other = after([2.0 + STEP_S], state=state, robot=status(speed_mm_s=other_mm_s))
    assert (other.steady_from_s == state.steady_from_s == 1.25) == is_same
    assert is_same or other.steady_from_s == 2.25 + STEP_S
    # Of a robot that stands no speed is asked.
    stands = after(steps(1.0, 2.0), robot=status(MotionState.PAUSED, 0.0))
    stands = after([2.0 + STEP_S], state=stands, robot=status(MotionState.PAUSED, other_mm_s))
    assert stands.steady_from_s == 1.25
    assert after([2.0 + STEP_S], state=state, robot=status(MotionState.PAUSED)).steady_from_s > 2.0
    assert after([2.0 + STEP_S], state=state).steady_from_s == 1.25


def test_a_frozen_pose_is_told_once_the_way_must_show_and_not_before():
    """At 64 mm/s the way over 0.125 s is far beyond the noise: the time alone counts."""
    told = [after(steps(1.0, 1.25 + STEP_S * n), robot=status(speed_mm_s=64.0)).doubt for n in range(12)]
    assert told[:8] == [None] * 8
    assert told[8:] == [Implausibility.FROZEN] * 4


@pytest.mark.parametrize(("x_mm", "is_told"), [(0.1, False), (0.17, False), (0.18, True), (-0.18, True)])
def test_a_tool_that_stands_may_settle_by_a_tenth(x_mm, is_told):
    """Beyond the limit of 0.1 mm only what rounding makes: 7.3 sigma of 0.0072 mm, over two samples."""
    state = after(steps(1.0, 2.0), robot=status(MotionState.STOPPED, 0.0))
    limit_mm = 0.1 + LIMITS.sigmas * math.sqrt(2.0) * 0.025 / math.sqrt(12.0)
    assert limit_mm == pytest.approx(0.175, abs=0.001)
    settled = after(
        [2.0 + STEP_S],
        # Of a tool that stands, jitter makes no way.
        replace(EXACT, acceleration_mm_s2=1e5, time_jitter_s=0.05),
        state=state,
        place_mm=(10.0 + x_mm, 40.0, 0.0),
        robot=status(MotionState.STOPPED, 0.0),
    )
    assert (settled.doubt is Implausibility.MOVES) == is_told


@pytest.mark.parametrize(("share", "is_told"), [(0.97, False), (1.03, True)])
def test_a_jump_is_a_speed_beyond_the_largest_and_the_noise(share, is_told):
    limits = replace(EXACT, acceleration_mm_s2=1e9)
    noise_mm = limits.sigmas * math.sqrt(2.0) * 0.025 / math.sqrt(12.0)
    jump_mm = 250.0 * STEP_S + share * noise_mm
    state = after([2.0 + STEP_S], limits, state=after(steps(1.0, 2.0)), place_mm=(10.0, 40.0 + jump_mm, 0.0))
    assert (state.doubt is Implausibility.SPEED) == is_told


@pytest.mark.parametrize(("share", "is_told"), [(0.97, False), (1.03, True)])
def test_a_turn_is_told_beyond_the_largest_rate_and_the_noise(share, is_told):
    noise_rad = EXACT.sigmas * math.sqrt(2.0) * 4.0 * 4.32e-5 / math.sqrt(12.0)
    angle = math.pi * STEP_S + share * noise_rad
    turned = (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0))
    state = after([2.0 + STEP_S], state=after(steps(1.0, 2.0)), quaternion=turned)
    assert (state.doubt is Implausibility.ROTATION) == is_told


@pytest.mark.parametrize(
    ("beside_mm", "apart_s", "is_told"),
    [(17.0, 0.0, False), (17.01, 0.0, True), (17.5, 0.0625, False), (17.75, 0.0625, True)],
)
def test_the_program_may_lag_by_the_way_of_its_delay(beside_mm, apart_s, is_told):
    """15 mm, and 10 mm/s over the 0.2 s that a robot follows late, and over what the two are apart."""
    programmed = replace(still(2.0 - apart_s).sample, position_base_mm=(10.0, 40.0 + beside_mm, 0.0))
    seen = replace(still(2.0, robot=status()), programmed=programmed)
    doubt = update(Plausibility(), seen, LIMITS, None).doubt
    assert (doubt is Implausibility.PROGRAMMED_PLACE) == is_told


@pytest.mark.parametrize(("turned_deg", "is_told"), [(4.9, False), (5.1, True)])
def test_the_program_turns_as_the_tool_does(turned_deg, is_told):
    half = math.radians(turned_deg) / 2.0
    programmed = replace(still(2.0).sample, quaternion_xyzw=(0.0, math.sin(half), 0.0, math.cos(half)))
    doubt = update(Plausibility(), replace(still(2.0), programmed=programmed), LIMITS, None).doubt
    assert (doubt is Implausibility.PROGRAMMED_ROTATION) == is_told


@pytest.mark.parametrize(("noise_share", "is_told"), [(0.97, False), (1.03, True)])
def test_jitter_counts_at_the_speed_of_the_last_five_samples(noise_share, is_told):
    """The tool stands, and then moves at 100 mm/s over four steps before it jumps aside."""
    limits = replace(LIMITS, acceleration_mm_s2=20000.0, speed_mm_s=1000.0)
    noise_mm = limits.sigmas * math.sqrt(6.0) * math.hypot(0.025 / math.sqrt(12.0), 100.0 * 0.0005)
    jump_mm = 20000.0 * 0.01**2 + noise_share * noise_mm
    x_mm = [0.0] * 6 + [1.0, 2.0, 3.0, 4.0, 5.0]
    state = Plausibility()
    for n, x in enumerate(x_mm):
        y_mm = jump_mm if n == len(x_mm) - 1 else 0.0
        state = update(state, still(0.01 * n, (x, y_mm, 0.0)), limits, None)
    assert (state.doubt is Implausibility.ACCELERATION) == is_told


@pytest.mark.parametrize(
    ("creep_mm", "name"), [(0.088, Implausibility.FROZEN), (0.094, Implausibility.PROGRESS)]
)
def test_what_creeps_within_the_noise_is_frozen(creep_mm, name):
    """At 10 mm/s rounding and jitter make 7.3 sigma of 0.0088 mm, over two samples."""
    noise_mm = LIMITS.sigmas * math.sqrt(2.0) * math.hypot(0.025 / math.sqrt(12.0), 10.0 * 0.0005)
    assert noise_mm == pytest.approx(0.0908, abs=1e-3)
    path = NominalPath(((0.0, 40.0, 0.0), (100.0, 40.0, 0.0)))
    limits = replace(EXACT, time_jitter_s=0.0005)
    state = Plausibility()
    for t_s in steps(1.0, 1.5):
        place = (10.0 + creep_mm * (t_s - 1.0) / 0.125, 40.0, 0.0)
        state = update(state, still(t_s, place, robot=status()), limits, path)
    assert state.doubt is name


def test_a_slow_robot_is_given_the_time_that_its_way_takes_to_show():
    """It states 0.5 mm/s and goes 0.3, which it may: over a tenth of a second that is within the noise."""
    slow = Robot(speed_mm_s=0.3, weave_mm=0.0)
    found = doubts(slow.seen(4.0, lambda _, seen: replace(seen, robot=status(speed_mm_s=0.5))))
    assert names(found, 0.35) == {None}


def test_a_weave_on_the_spot_is_no_progress_and_no_way_back():
    def on_the_spot(t_s, seen):
        return moved(seen, (-10.0 * max(0.0, t_s - FAULT_S), 0.0, 0.0))

    found = names(doubts(Robot().seen(3.0, on_the_spot)), FAULT_S)
    assert Implausibility.PROGRESS in found
    assert Implausibility.BACKWARDS not in found


LINE = NominalPath(((0.0, 40.0, 0.0), (300.0, 40.0, 0.0)))


@pytest.mark.parametrize(
    ("by_mm", "is_rejoined"),
    [
        ((0.0, 2.0, 0.0), True),
        ((0.0, -2.0, 0.0), True),
        ((0.0, 0.0, 2.0), True),
        ((0.0, 0.0, -2.0), True),
        ((0.0, 2.0625, 0.0), False),
        ((0.0, -2.0625, 0.0), False),
        ((0.0, 0.0, -2.0625), False),
    ],
)
def test_after_a_doubt_the_tool_is_beside_the_path_as_before(by_mm, is_rejoined):
    trusted = after(steps(1.0, 2.0), path=LINE)
    place = tuple(p + d for p, d in zip((10.0, 40.0, 0.0), by_mm, strict=True))
    back = after(steps(2.5, 3.0), path=LINE, state=trusted, place_mm=place)
    assert back.doubt is (None if is_rejoined else Implausibility.NOT_REJOINED)


@pytest.mark.parametrize(
    ("noise_share", "is_told"), [(-0.95, False), (-1.05, True), (0.95, False), (1.05, True)]
)
def test_the_way_since_a_doubt_is_the_stated_one_within_its_share_and_the_noise(noise_share, is_told):
    """16 mm/s, half a second: 0.05 s and a twentieth of the way late, or a frozen stretch ahead of that."""
    limits = replace(EXACT, time_jitter_s=0.0005)
    noise_mm = limits.sigmas * math.sqrt(2.0) * math.hypot(0.025 / math.sqrt(12.0), 16.0 * 0.0005)
    allowed_mm = 16.0 * (0.05 + 0.05 * 0.5)
    state = Plausibility()
    for t_s in steps(1.0, 2.0):
        seen = still(t_s, (10.0 + 16.0 * (t_s - 1.0), 40.0, 0.0), robot=status(speed_mm_s=16.0))
        state = update(state, seen, limits, LINE)
    assert state.doubt is None
    ahead_mm = math.copysign(allowed_mm, noise_share) + noise_share * noise_mm
    if noise_share > 0.0:
        ahead_mm += 16.0 * 0.125
    seen = still(2.5, (10.0 + 16.0 * 1.5 + ahead_mm, 40.0, 0.0), robot=status(speed_mm_s=16.0))
    # The gap is a doubt of its own; the next sample begins a proof, where it has rejoined.
    state = update(state, seen, limits, LINE)
    next_mm = 16.0 * STEP_S * (1.0 + math.copysign(0.05, noise_share))
    x_mm = seen.sample.position_base_mm[0] + next_mm
    state = update(state, still(2.5 + STEP_S, (x_mm, 40.0, 0.0), robot=status(speed_mm_s=16.0)), limits, LINE)
    assert math.isnan(state.clean_from_s) == is_told


def test_a_tool_whose_speed_is_not_known_is_where_it_was():
    brief = replace(EXACT, window_s=1e-9)
    trusted = after(steps(1.0, 2.0), brief)
    assert len(trusted.window) == 1
    assert after(steps(5.0, 5.5), brief, state=trusted).doubt is None


UNIT = st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: math.hypot(*q) > 0.1)


TURNS_DEG = ((0, 0, 44), (0, 0, 46), (59, 0, 0), (61, 0, 0), (-59, 0, 0), (0, 44, 0), (0, 46, 0))


@given(UNIT, st.sampled_from(TURNS_DEG))
def test_a_tool_looks_along_a_seam_wherever_that_runs(q, turned_deg):
    """Seam and tool are turned as one: that changes nothing of how one stands to the other."""
    turn = Rotation.from_quat([x / math.hypot(*q) for x in q])
    ends = turn.apply([(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)])
    path = NominalPath(tuple(map(tuple, ends.tolist())), tuple(turn.apply((0.0, 0.0, 1.0)).tolist()))
    tool = turn * Rotation.from_euler("xyz", turned_deg, degrees=True)
    seen = still(1.0, tuple(turn.apply((10.0, 0.0, 0.0)).tolist()), tuple(tool.as_quat().tolist()))
    doubt = update(Plausibility(), seen, LIMITS, path).doubt
    is_along = max(abs(turned_deg[1]), abs(turned_deg[2])) < 45 and abs(turned_deg[0]) < 60
    assert (doubt is Implausibility.AGAINST_SEAM) != is_along


@pytest.mark.parametrize(
    ("place_mm", "beyond_mm"),
    [
        ((10.0, 40.0 + LIMITS.lateral_mm, 0.0), (0.0, 0.5, 0.0)),
        ((10.0, 40.0 - LIMITS.lateral_mm, 0.0), (0.0, -0.5, 0.0)),
        ((10.0, 40.0, LIMITS.above_mm), (0.0, 0.0, 0.5)),
        ((10.0, 40.0, -LIMITS.below_mm), (0.0, 0.0, -0.5)),
        ((-LIMITS.ends_mm, 40.0, 0.0), (-0.5, 0.0, 0.0)),
        ((300.0 + LIMITS.ends_mm, 40.0, 0.0), (0.5, 0.0, 0.0)),
    ],
)
def test_the_tool_may_be_exactly_so_far_from_the_seam(place_mm, beyond_mm):
    assert after(steps(1.0, 1.25), path=PATH, place_mm=place_mm).doubt is None
    x, y, z = (p + b for p, b in zip(place_mm, beyond_mm, strict=True))
    assert after([1.0], path=PATH, place_mm=(x, y, z)).doubt is Implausibility.OFF_SEAM


@pytest.mark.parametrize(("turned", "is_rejoined"), [(0.999, True), (1.001, False)])
def test_after_a_doubt_the_tool_is_turned_as_before(turned, is_rejoined):
    trusted = after(steps(1.0, 1.5))
    doubted = after([1.5 + STEP_S], state=trusted, place_mm=(60.0, 40.0, 0.0))
    assert doubted.doubt is Implausibility.SPEED
    half = math.radians(0.5 * turned * LIMITS.rejoin_deg)
    quaternion = (math.sin(half), 0.0, 0.0, math.cos(half))
    # The gap lets it turn: nothing is asked of the way in between.
    from_s = 1.75
    back = after(steps(from_s, from_s + 0.5), state=doubted, quaternion=quaternion)
    assert back.doubt is (None if is_rejoined else Implausibility.NOT_REJOINED)
