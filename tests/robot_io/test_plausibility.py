from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot_io import MotionState, PoseKind
from robot_io.poses.nominal_path import NominalPath
from robot_io.poses.plausibility import Plausibility, clock_set, update
from robot_io.poses.pose_questions import Implausibility, PoseArrival, turn_rad
from tests.robot_io.moving_robot import LIMITS, PATH, Robot, doubts, moved, on_the_bus, status

FAULT_S, END_S = 2.0, 3.0
"""When a fault begins and ends."""


def between(fault):
    """Return a change that holds from FAULT_S to END_S."""
    return lambda t_s, seen: fault(t_s, seen) if FAULT_S <= t_s < END_S else seen


def names(found, from_s=-math.inf, to_s=math.inf):
    return {doubt for t_s, doubt in found if from_s <= t_s < to_s}


def delay_s(found):
    """Return how long after FAULT_S the first doubt came."""
    return next(t_s for t_s, doubt in found if t_s >= FAULT_S - 0.005 and doubt is not None) - FAULT_S


def recovers(found):
    return found[-1][1] is None


def test_an_honest_robot_is_trusted_once_it_has_shown_enough():
    found = doubts(Robot().seen(5.0))
    assert names(found, 0.0, 0.29) == {Implausibility.UNPROVEN}
    assert names(found, 0.32) == {None}


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    speed=st.floats(0.5, 40.0),
    weave=st.floats(0.0, 3.0),
    hz=st.floats(0.2, 4.0),
    turned=st.tuples(st.floats(-10.0, 10.0), st.floats(-20.0, 20.0), st.floats(-15.0, 15.0)),
    seed=st.integers(0, 10**6),
)
def test_no_honest_robot_is_ever_doubted(speed, weave, hz, turned, seed):
    robot = Robot(speed, weave, hz, turned_deg=turned, seed=seed)
    assert names(doubts(robot.seen(4.0)), 0.35) == {None}


@pytest.mark.slow
def test_false_alarms_stay_below_their_rate_at_a_far_higher_one():
    # At the stated rate none would ever be seen: here one question in a hundred may be wrong, no more.
    limits = replace(LIMITS, false_alarm=0.01, acceleration_mm_s2=1.0, time_jitter_s=0.0003, still_mm=1e-9)
    robot = Robot(weave_mm=0.0, jitter_s=0.0)
    asked = alarms = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        start = rng.uniform(0.0, 1.0, 3)
        state = Plausibility()
        for n in range(300):
            t_s = 0.01 * n + rng.normal(0.0, 0.0003)
            place = start + np.array([0.1 * n, 40.0, 0.0])
            state = update(state, PoseArrival(on_the_bus(t_s, place, robot.rotation), status()), limits, PATH)
            asked += 1
            alarms += state.doubt is Implausibility.ACCELERATION
    assert alarms <= 0.01 * asked


def test_poses_that_freeze_are_found_and_recover():
    robot = Robot()
    stuck = on_the_bus(0.0, robot.place(FAULT_S), robot.rotation)
    freeze = between(lambda t_s, seen: replace(seen, sample=replace(stuck, timestamp_s=t_s)))
    found = doubts(robot.seen(5.0, freeze))
    assert delay_s(found) < 0.13
    assert Implausibility.FROZEN in names(found, FAULT_S, END_S)
    assert None not in names(found, FAULT_S + 0.15, END_S)
    assert recovers(found)


@pytest.mark.parametrize("speed", [0.5, 2.0, 10.0, 40.0])
def test_a_slow_robot_takes_as_long_to_be_found_as_its_way_takes_to_tell(speed):
    robot = Robot(speed, weave_mm=0.0)
    stuck = on_the_bus(0.0, robot.place(FAULT_S), robot.rotation)
    freeze = between(lambda t_s, seen: replace(seen, sample=replace(stuck, timestamp_s=t_s)))
    noise_mm = LIMITS.sigmas * math.sqrt(2.0) * LIMITS.position_sigma_mm(speed)
    found = doubts(robot.seen(5.0, freeze))
    assert delay_s(found) < max(LIMITS.frozen_s, 4.0 * noise_mm / speed) + 0.03


def test_a_flipped_sign_is_a_jump_and_ends_with_the_jump_back():
    flip = between(lambda _, seen: moved(seen, (0.0, -2.0 * seen.sample.position_base_mm[1], 0.0)))
    found = doubts(Robot().seen(5.0, flip))
    assert delay_s(found) < 0.005
    assert names(found, FAULT_S - 0.005, END_S - 0.005) == {Implausibility.SPEED, Implausibility.OFF_SEAM}
    assert recovers(found)


def test_a_flipped_sign_from_the_first_sample_is_off_the_seam():
    def flip(_, seen):
        return moved(seen, (0.0, -2.0 * seen.sample.position_base_mm[1], 0.0))

    assert names(doubts(Robot().seen(2.0, flip))) == {Implausibility.OFF_SEAM}


def conjugated(_, seen):
    x, y, z, w = seen.sample.quaternion_xyzw
    return replace(seen, sample=replace(seen.sample, quaternion_xyzw=(-x, -y, -z, w)))


def test_a_conjugated_quaternion_is_a_jump():
    found = doubts(Robot().seen(5.0, between(conjugated)))
    assert delay_s(found) < 0.005
    assert Implausibility.ROTATION in names(found, FAULT_S, FAULT_S + 0.02)
    assert None not in names(found, FAULT_S, END_S)
    assert recovers(found)


def test_a_conjugated_quaternion_from_the_first_sample_shows_against_seam_or_program():
    turned = Robot(turned_deg=(0.0, 0.0, 60.0), y_mm=0.0)
    along = NominalPath(((0.0, 0.0, 0.0), (100.0, 173.0, 0.0)))
    # The robot moves elsewhere than this path; what is asked of its place comes after.
    state = Plausibility()
    for seen in turned.seen(0.1, conjugated):
        state = update(state, seen, replace(LIMITS, lateral_mm=100.0, speed_share=0.9), along)
    assert state.doubt is Implausibility.AGAINST_SEAM
    robot = Robot()

    def beside_program(t_s, seen):
        programmed = on_the_bus(t_s, (10.0 * t_s, 40.0, 1.0), robot.rotation, kind=PoseKind.PROGRAMMED)
        return replace(seen, programmed=programmed)

    def conjugated_beside(t_s, seen):
        return conjugated(t_s, beside_program(t_s, seen))

    assert names(doubts(robot.seen(2.0, beside_program)), 0.35) == {None}
    assert names(doubts(robot.seen(2.0, conjugated_beside))) == {Implausibility.PROGRAMMED_ROTATION}


def test_the_program_tells_what_is_off_it():
    def programmed_at(place_mm, robot, apart_s=0.0):
        def beside(t_s, seen):
            programmed = on_the_bus(t_s + apart_s, place_mm(t_s), robot.rotation, kind=PoseKind.PROGRAMMED)
            return replace(seen, programmed=programmed)

        return beside

    robot = Robot()
    off = programmed_at(lambda t_s: (10.0 * t_s, 60.0, 1.0), robot)
    assert names(doubts(robot.seen(2.0, off))) == {Implausibility.PROGRAMMED_PLACE}
    old = programmed_at(lambda t_s: (10.0 * t_s, 60.0, 1.0), robot, -0.2)
    assert None in names(doubts(robot.seen(2.0, old)))

    def without_status(t_s, seen):
        return replace(off(t_s, seen), robot=None)

    # The robot's own speed is not known: it may be as fast as it can.
    assert None in names(doubts(robot.seen(2.0, without_status)))

    def without_speed(t_s, seen):
        return replace(off(t_s, seen), robot=status(speed_mm_s=math.nan))

    assert None in names(doubts(robot.seen(2.0, without_speed)))


@pytest.mark.parametrize(
    ("jump_mm", "name"),
    [(5.0, Implausibility.SPEED), (-5.0, Implausibility.SPEED), (1.2, Implausibility.ACCELERATION)],
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_jump_that_stays_is_doubted_until_a_new_state(jump_mm, name, axis):
    by_mm = tuple(jump_mm * (n == axis) for n in range(3))

    def jump(t_s, seen):
        return moved(seen, by_mm) if t_s >= FAULT_S else seen

    found = doubts(Robot(weave_mm=0.0).seen(4.0, jump))
    assert found[200][1] is name
    if abs(jump_mm) > LIMITS.rejoin_mm and axis > 0:
        assert found[-1][1] is Implausibility.NOT_REJOINED


def test_poses_behind_on_the_path_after_a_jump_are_late():
    def late(t_s, seen):
        if FAULT_S <= t_s < FAULT_S + 0.2:
            return None
        if t_s < FAULT_S:
            return seen
        robot = Robot(weave_mm=0.0)
        return replace(seen, sample=on_the_bus(t_s, robot.place(t_s - 0.2), robot.rotation))

    found = doubts(Robot(weave_mm=0.0).seen(4.0, late))
    assert names(found, FAULT_S + 0.19, FAULT_S + 0.28) == {Implausibility.STOPPED}
    assert names(found, FAULT_S + 0.3, 4.0) == {Implausibility.LATE}


def test_poses_that_stop_and_come_back_are_trusted_again():
    found = doubts(Robot().seen(5.0, between(lambda *_: None)))
    assert found[200][1] is Implausibility.STOPPED
    assert names(found, END_S, END_S + 0.28) == {Implausibility.STOPPED}
    assert names(found, END_S + 0.35) == {None}


def test_a_doubt_comes_with_silence():
    state = Plausibility()
    assert state.at(0.0, LIMITS) is Implausibility.UNPROVEN
    for seen in Robot(jitter_s=0.0).seen(1.0):
        state = update(state, seen, LIMITS, PATH)
    assert state.at(0.99, LIMITS) is None
    assert state.at(1.08, LIMITS) is None
    assert state.at(1.1, LIMITS) is Implausibility.STOPPED
    assert state.at(0.5, LIMITS) is Implausibility.STOPPED
    assert state.at(math.nan, LIMITS) is Implausibility.STOPPED


def test_poses_that_run_backwards_are_found():
    robot = Robot()

    def back(t_s, seen):
        sample = on_the_bus(t_s, robot.place(2.0 * FAULT_S - t_s), robot.rotation)
        return replace(seen, sample=sample)

    found = doubts(robot.seen(3.5, between(back)))
    assert delay_s(found) < 0.2
    assert Implausibility.BACKWARDS in names(found, FAULT_S, END_S)
    assert None not in names(found, FAULT_S + 0.2, END_S)


@pytest.mark.parametrize(
    ("factor", "is_told"),
    [(0.3, True), (0.52, False), (0.6, False), (1.4, False), (1.48, False), (1.8, True), (-1.0, True)],
)
def test_another_speed_than_the_stated_one_is_told_beyond_a_share(factor, is_told):
    robot = Robot(speed_mm_s=factor * 10.0, weave_mm=0.0)

    def beside(_, seen):
        return moved(replace(seen, robot=status()), (100.0, 0.0, 0.0))

    found = names(doubts(robot.seen(2.0, beside)), 0.5)
    assert (None not in found) == is_told
    told = {Implausibility.BACKWARDS} if factor < 0 else {Implausibility.PROGRESS, Implausibility.FROZEN}
    assert not is_told or found <= told


def test_a_robot_that_stands_must_not_move():
    for motion in (MotionState.STOPPED, MotionState.PAUSED):
        found = doubts(Robot().seen(2.0, lambda _, seen, m=motion: replace(seen, robot=status(m, 0.0))))
        assert Implausibility.MOVES in names(found, 0.3)
        still = Robot(speed_mm_s=1e-9, weave_mm=0.0)
        found = doubts(still.seen(2.0, lambda _, seen, m=motion: replace(seen, robot=status(m, 0.0))))
        assert names(found, 0.35) == {None}


def test_what_the_robot_does_not_say_is_not_asked():
    still = Robot(speed_mm_s=1e-9, weave_mm=0.0)
    for robot in (None, status(MotionState.RETRACTING), status(speed_mm_s=math.nan), status(speed_mm_s=0.0)):
        found = doubts(still.seen(2.0, lambda _, seen, r=robot: replace(seen, robot=r)))
        assert names(found, 0.35) == {None}


def test_a_delay_shows_though_the_status_was_silent_with_the_poses():
    robot = Robot(weave_mm=0.0)

    def late(t_s, seen):
        if t_s < FAULT_S:
            return seen
        if t_s < FAULT_S + 0.3:
            return None
        status_now = None if t_s < FAULT_S + 0.35 else seen.robot
        return replace(seen, sample=on_the_bus(t_s, robot.place(t_s - 0.3), robot.rotation), robot=status_now)

    assert doubts(robot.seen(4.0, late))[-1][1] is Implausibility.LATE


def test_a_change_of_motion_is_given_time():
    robot = Robot()

    def stops(t_s, seen):
        if t_s < FAULT_S:
            return seen
        place = robot.place(FAULT_S)
        return replace(
            seen, sample=on_the_bus(t_s, place, robot.rotation), robot=status(MotionState.PAUSED, 0.0)
        )

    smooth = replace(LIMITS, acceleration_mm_s2=50000.0)
    assert names(doubts(robot.seen(4.0, stops), smooth), 0.35) == {None}


def test_round_a_corner_the_tool_may_look_along_either_piece():
    corner = NominalPath(((0.0, 0.0, 0.0), (50.0, 0.0, 0.0), (50.0, 50.0, 0.0)))
    state = Plausibility()
    for n in range(600):
        along_mm = 0.1 * n + 20.0
        place = (along_mm, 0.0, 0.0) if along_mm < 50.0 else (50.0, along_mm - 50.0, 0.0)
        turned = float(np.clip((along_mm - 45.0) * 9.0, 0.0, 90.0))
        rotation = Rotation.from_euler("z", turned, degrees=True)
        state = update(
            state,
            PoseArrival(on_the_bus(0.01 * n, place, rotation), status()),
            replace(LIMITS, speed_share=0.6),
            corner,
        )
        assert n < 35 or state.doubt is None


def test_times_that_repeat_or_run_backwards_are_named():
    robot = Robot(jitter_s=0.0)
    again = doubts(robot.seen(3.0, lambda t_s, s: moved(s, by_s=-0.01) if t_s == FAULT_S else s))
    assert again[200][1] is Implausibility.TIME_REPEATED
    back = doubts(robot.seen(3.0, lambda t_s, s: moved(s, by_s=-0.035) if t_s == FAULT_S else s))
    assert back[200][1] is Implausibility.TIME_BACKWARDS
    assert recovers(again)
    assert recovers(back)


@pytest.mark.parametrize("times", [2, 3])
def test_a_sample_that_comes_again_with_its_age_says_nothing_new(times):
    """Some controllers send poses more often than they sample them; each way over the bus has its jitter."""
    rng, taken, count = np.random.default_rng(3), None, 0

    def again(_, seen):
        nonlocal taken, count
        if count % times == 0:
            taken = seen.sample
        count += 1
        jittered_s = taken.timestamp_s + float(rng.normal(0.0, 0.0005))
        return replace(seen, sample=replace(taken, timestamp_s=jittered_s))

    assert names(doubts(Robot().seen(4.0, again)), 0.35) == {None}


def test_the_speed_is_that_of_the_newest_samples():
    state = Plausibility()
    assert state.speed_mm_s == 0.0
    for n, seen in enumerate(Robot(speed_mm_s=12.0, weave_mm=0.0, jitter_s=0.0).seen(0.3)):
        state = update(state, seen, LIMITS, PATH)
        if n == 0:
            assert state.speed_mm_s == 0.0
    assert state.speed_mm_s == pytest.approx(12.0, rel=0.1)


def test_a_sample_that_comes_again_for_good_has_stopped():
    robot = Robot()
    state = Plausibility()
    for seen in robot.seen(1.0):
        state = update(state, seen, LIMITS, PATH)
        last_s = seen.sample.timestamp_s
    assert state.doubt is None
    for _ in range(30):
        state = update(state, seen, LIMITS, PATH)
    assert state.at(last_s + 0.9 * LIMITS.gap_s, LIMITS) is None
    assert state.at(last_s + 1.1 * LIMITS.gap_s, LIMITS) is Implausibility.STOPPED


@pytest.mark.parametrize("step_s", [-1.0, -0.2])
def test_a_clock_set_back_is_named_and_recovers(step_s):
    found = doubts(
        Robot(jitter_s=0.0).seen(4.0, lambda t_s, s: moved(s, by_s=step_s) if t_s >= FAULT_S else s)
    )
    assert found[200][1] is Implausibility.TIME_BACKWARDS
    assert recovers(found)


def test_an_age_that_is_not_known_is_refused_unless_it_may_be():
    def without_age(_, seen):
        return replace(seen, sample=replace(seen.sample, sample_age_s=math.nan))

    assert names(doubts(Robot().seen(1.0, without_age))) == {Implausibility.AGE_UNKNOWN}
    calibrated = replace(LIMITS, age_required=False)
    assert names(doubts(Robot().seen(1.0, without_age), calibrated), 0.35) == {None}


@pytest.mark.parametrize(
    ("by_mm", "is_near"),
    [
        ((0.0, 14.9, 0.0), True),
        ((0.0, 15.1, 0.0), False),
        ((0.0, -15.1, 0.0), False),
        ((0.0, 0.0, 28.9), True),
        ((0.0, 0.0, 29.1), False),
        ((0.0, 0.0, -15.9), True),
        ((0.0, 0.0, -16.1), False),
        ((-57.0, 0.0, 0.0), False),
        ((351.0, 0.0, 0.0), False),
        ((-50.5, 0.0, 0.0), True),
    ],
)
def test_the_tool_must_be_near_the_seam(by_mm, is_near):
    found = doubts(Robot(weave_mm=0.0).seen(0.5, lambda _, seen: moved(seen, by_mm)))
    assert found[-1][1] is (None if is_near else Implausibility.OFF_SEAM)


@pytest.mark.parametrize(
    ("turned", "is_along"),
    [((0, 0, 44), True), ((0, 0, 46), False), ((59, 0, 0), True), ((61, 0, 0), False), ((0, 0, 180), False)],
)
def test_the_tool_must_look_along_the_seam(turned, is_along):
    found = doubts(Robot(turned_deg=turned).seen(0.5))
    assert found[-1][1] is (None if is_along else Implausibility.AGAINST_SEAM)


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_which_way_the_tool_looks_is_that_of_its_rotation(q):
    norm = math.hypot(*q)
    if norm < 0.1:
        return
    rotation = Rotation.from_quat([x / norm for x in q])
    R = rotation.as_matrix()
    travel, tilt = (math.degrees(math.acos(np.clip(R[n, n], -1.0, 1.0))) for n in (0, 2))
    if min(abs(travel - LIMITS.travel_deg), abs(tilt - LIMITS.tilt_deg)) < 0.1:
        return
    seen = PoseArrival(on_the_bus(0.0, (10.0, 40.0, 0.0), rotation), status())
    is_along = travel < LIMITS.travel_deg and tilt < LIMITS.tilt_deg
    doubt = update(Plausibility(), seen, LIMITS, PATH).doubt
    assert (doubt is Implausibility.AGAINST_SEAM) != is_along


@pytest.mark.parametrize("speed", [0.0, 10.0, 100.0])
@pytest.mark.parametrize(("share", "is_told"), [(0.98, False), (1.02, True)])
def test_a_jump_is_told_beyond_what_acceleration_rounding_and_jitter_make(speed, share, is_told):
    limits = replace(LIMITS, acceleration_mm_s2=2000.0)
    sample = on_the_bus(0.0, (0.0, 0.0, 0.0), Rotation.identity())
    noise_mm = limits.sigmas * math.sqrt(6.0) * limits.position_sigma_mm(speed)
    jump_mm = share * (2000.0 * 0.01**2 + noise_mm)
    state = Plausibility()
    for n in range(20):
        x_mm = speed * 0.01 * n
        place = (x_mm, jump_mm if n == 19 else 0.0, 0.0)
        told = replace(sample, timestamp_s=0.01 * n, position_base_mm=place)
        state = update(state, PoseArrival(told, None), limits)
    assert (state.doubt is Implausibility.ACCELERATION) == is_told


def test_without_a_path_a_straight_way_is_rejoined():
    robot = Robot(weave_mm=0.0)
    found = doubts(robot.seen(5.0, between(lambda *_: None)), path=None)
    assert recovers(found)
    assert names(found, END_S, END_S + 0.2) == {Implausibility.STOPPED}

    def jump(t_s, seen):
        return moved(seen, (0.0, 5.0, 0.0)) if t_s >= FAULT_S else seen

    assert doubts(robot.seen(4.0, jump), path=None)[-1][1] is Implausibility.NOT_REJOINED


def test_a_tool_that_is_turned_after_a_doubt_has_not_rejoined():
    robot, turned = Robot(weave_mm=0.0), Robot(weave_mm=0.0, turned_deg=(4.0, 8.0, 25.0))

    def turn(t_s, seen):
        place = seen.sample.position_base_mm
        return replace(seen, sample=on_the_bus(t_s, place, turned.rotation)) if t_s >= FAULT_S else seen

    assert doubts(robot.seen(4.0, turn))[-1][1] is Implausibility.NOT_REJOINED


def test_poses_ahead_after_a_doubt_have_not_rejoined():
    def skips(t_s, seen):
        if FAULT_S <= t_s < FAULT_S + 0.2:
            return None
        return moved(seen, (10.0, 0.0, 0.0)) if t_s >= FAULT_S else seen

    assert doubts(Robot(weave_mm=0.0).seen(4.0, skips))[-1][1] is Implausibility.NOT_REJOINED


def test_where_the_motion_changed_meanwhile_the_way_is_not_asked():
    def skips(t_s, seen):
        if FAULT_S <= t_s < FAULT_S + 0.2:
            return None
        if t_s < FAULT_S:
            return seen
        slower = status(speed_mm_s=8.0) if t_s < FAULT_S + 0.5 else seen.robot
        return moved(replace(seen, robot=slower), (10.0, 0.0, 0.0))

    assert recovers(doubts(Robot(weave_mm=0.0).seen(4.0, skips)))


def test_a_weave_does_not_hide_a_jump_that_stays():
    def jump(t_s, seen):
        return moved(seen, (0.0, 4.7, 0.0)) if t_s >= FAULT_S else seen

    found = names(doubts(Robot(weave_mm=2.5).seen(6.0, jump)), FAULT_S - 0.005)
    assert found == {Implausibility.SPEED, Implausibility.NOT_REJOINED}


def test_a_weave_rejoins_wherever_it_was_when_a_doubt_began():
    for n in range(20):
        begin_s = FAULT_S + 0.025 * n

        def gap(t_s, seen, begin_s=begin_s):
            return None if begin_s <= t_s < begin_s + 0.3 else seen

        assert recovers(doubts(Robot(weave_mm=2.5).seen(4.0, gap)))


def test_no_trust_comes_back_while_the_image_contradicts():
    def gap(t_s, seen):
        if FAULT_S <= t_s < FAULT_S + 0.3:
            return None
        return replace(seen, is_contradicted=FAULT_S <= t_s < END_S)

    found = doubts(Robot().seen(4.0, gap))
    assert names(found, FAULT_S + 0.35, END_S - 0.01) == {Implausibility.STOPPED}
    assert names(found, END_S + 0.02) == {None}


def test_a_clock_that_someone_saw_being_set_is_no_delay():
    def set_on(t_s, seen):
        return moved(seen, by_s=1.0) if t_s >= FAULT_S else seen

    state = Plausibility()
    robot = Robot()
    for seen in robot.seen(4.0, set_on):
        state = update(state, seen, LIMITS, PATH)
        if abs(seen.sample.timestamp_s - FAULT_S - 1.2) < 0.004:
            assert state.doubt is not None
            state = clock_set(state, seen.sample.timestamp_s, LIMITS)
    assert state.doubt is None
    assert doubts(robot.seen(4.0, set_on))[-1][1] is Implausibility.LATE
    assert clock_set(Plausibility(), 0.0, LIMITS).anchor is None


def test_a_single_trusted_sample_has_no_velocity():
    limits = replace(LIMITS, prove_s=1e-9)
    robot = Robot(weave_mm=0.0, jitter_s=0.0)
    seen = list(robot.seen(0.5))
    state = Plausibility()
    state = update(state, seen[0], limits, None)
    # The first sample begins the proof, and 0 s of it are enough only with the next.
    assert state.doubt is Implausibility.UNPROVEN
    state = update(state, seen[1], limits, None)
    assert state.doubt is None
    state = update(state, seen[30], limits, None)
    assert state.doubt is Implausibility.STOPPED


def test_values_that_are_not_finite_are_an_error():
    seen = next(Robot().seen(0.1))
    with pytest.raises(ValueError, match="not finite"):
        update(Plausibility(), moved(seen, (math.nan, 0.0, 0.0)), LIMITS, PATH)


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4), st.floats(0.0, math.pi))
def test_a_turn_is_the_angle_between_rotations(q, angle):
    norm = math.hypot(*q)
    if norm < 0.1:
        return
    a = Rotation.from_quat([x / norm for x in q])
    b = Rotation.from_rotvec([0.0, angle, 0.0]) * a
    for sign in (1.0, -1.0):
        assert turn_rad(tuple(a.as_quat()), tuple(sign * b.as_quat())) == pytest.approx(angle, abs=1e-6)


def test_the_rate_of_turning_is_that_of_the_newest_samples():
    state, rate_rad_s = Plausibility(), 0.5
    assert state.turn_rad_s == 0.0
    for n in range(8):
        turned = Rotation.from_euler("z", rate_rad_s * 0.01 * n)
        state = update(
            state, PoseArrival(on_the_bus(0.01 * n, (0.1 * n, 40.0, 1.0), turned), None), LIMITS, PATH
        )
    assert state.turn_rad_s == pytest.approx(rate_rad_s, rel=0.05)
