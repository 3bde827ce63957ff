from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot_io.poses.pose_buffer import PoseBuffer, PoseError, PoseRefusal, PoseStatus

VELOCITY_MM_S = np.array([8.0, -1.0, 0.5])
SPIN_RAD_S = np.array([0.1, -0.2, 0.3])
START = Rotation.from_euler("xyz", (10.0, -20.0, 30.0), degrees=True)


def true_pose(t_s):
    T_base_tool = np.eye(4)
    T_base_tool[:3, :3] = (Rotation.from_rotvec(SPIN_RAD_S * t_s) * START).as_matrix()
    T_base_tool[:3, 3] = VELOCITY_MM_S * t_s
    return T_base_tool


def filled(times_s, **options):
    buffer = PoseBuffer(**options)
    for t_s in times_s:
        buffer.push(t_s, true_pose(t_s))
    return buffer


STEADY_S = 0.01 * np.arange(50)


def same(a, b):
    return (
        (a.timestamp_s, a.status, a.refusal) == (b.timestamp_s, b.status, b.refusal)
        and np.array_equal(a.T_base_tool, b.T_base_tool, equal_nan=True)
        and np.array_equal(a.velocity_base_mm_s, b.velocity_base_mm_s, equal_nan=True)
        and np.array_equal(a.period_s, b.period_s, equal_nan=True)
    )


@pytest.mark.parametrize("t_s", [0.1, 0.1001, 0.105, 0.1099, 0.48])
def test_within_a_bracket_the_pose_is_interpolated(t_s):
    pose = filled(STEADY_S).at(t_s)
    assert (pose.status, pose.refusal) == (PoseStatus.INTERPOLATED, None)
    np.testing.assert_allclose(pose.T_base_tool, true_pose(t_s), atol=1e-9)
    np.testing.assert_allclose(pose.velocity_base_mm_s, VELOCITY_MM_S, rtol=1e-9)
    np.testing.assert_allclose(pose.angular_velocity_base_rad_s, SPIN_RAD_S, rtol=1e-9)
    assert pose.period_s == pytest.approx(0.01)


def test_a_pose_that_was_pushed_comes_back():
    buffer = filled(STEADY_S)
    pose = buffer.at(STEADY_S[-1])
    assert pose.status is PoseStatus.INTERPOLATED
    np.testing.assert_allclose(pose.T_base_tool, true_pose(STEADY_S[-1]), atol=1e-12)


def test_poses_at_once_are_those_one_by_one():
    rng = np.random.default_rng(3)
    rotations = Rotation.from_quat(rng.normal(size=(200, 4))).as_matrix()
    turns = [(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)]
    rotations[:4] = [np.diag(turn) for turn in turns]
    # As a controller rounds them off.
    rotations[100:] = rotations[100:].round(4)
    T_base_tool = np.tile(np.eye(4), (200, 1, 1))
    T_base_tool[:, :3, :3] = rotations
    T_base_tool[:, :3, 3] = rng.normal(size=(200, 3))
    times_s = 0.01 * np.arange(200)
    single, at_once = PoseBuffer(), PoseBuffer()
    for t_s, pose in zip(times_s, T_base_tool, strict=True):
        single.push(t_s, pose)
    at_once.push_all(times_s, T_base_tool)
    assert len(at_once) == 200
    for t_s in np.arange(0.0, 2.0, 0.003):
        assert same(at_once.at(t_s), single.at(t_s))


def test_many_times_at_once_are_answered_as_each_alone():
    buffer = filled([*STEADY_S, 0.6, 0.61, 0.62, 0.63])
    times_s = np.random.default_rng(5).uniform(-0.05, 0.8, 300).tolist()
    answers = buffer.at_all(times_s)
    assert {answer.status for answer in answers} == set(PoseStatus)
    for t_s, answer in zip(times_s, answers, strict=True):
        assert answer.timestamp_s == t_s
        assert same(answer, buffer.at(t_s))
    assert buffer.at_all([]) == []
    with pytest.raises(ValueError, match="must be finite"):
        buffer.at_all([0.1, np.nan])


def lower_left(value):
    T_base_tool = np.eye(4)
    T_base_tool[3, 0] = value
    return T_base_tool


@pytest.mark.parametrize(
    "bad",
    [
        2.0 * np.eye(4),
        np.full((4, 4), np.nan),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        # Within what is rounded off, but a mirror.
        np.diag([1.0, 1.0, -0.9999, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.diag([1.0, 1.0, 1.0, 0.0]),
        lower_left(1.0),
        lower_left(-1.0),
    ],
)
@pytest.mark.parametrize("k", [0, 3])
def test_of_poses_at_once_the_first_that_is_none_is_named(bad, k):
    T_base_tool = np.tile(np.eye(4), (5, 1, 1))
    T_base_tool[k] = bad
    buffer = PoseBuffer()
    with pytest.raises(PoseError, match=rf"pose at 0\.{k}00000 s: "):
        buffer.push_all(0.1 * np.arange(5), T_base_tool)
    assert len(buffer) == k


def test_each_pose_has_a_time():
    buffer = PoseBuffer()
    with pytest.raises(PoseError, match="3 times for 2 poses"):
        buffer.push_all([0.0, 0.1, 0.2], np.tile(np.eye(4), (2, 1, 1)))
    assert len(buffer) == 0
    buffer.push_all([], np.empty((0, 4, 4)))
    assert len(buffer) == 0


@pytest.mark.parametrize(("stretch", "is_taken"), [(0.0004, True), (-0.0004, True), (0.0006, False)])
def test_what_a_controller_rounds_off_is_a_rotation(stretch, is_taken):
    """R R^T is then off the identity by twice as much."""
    buffer = PoseBuffer()
    pose = np.diag([1.0 + stretch, 1.0, 1.0, 1.0])
    if is_taken:
        buffer.push(0.0, pose)
        buffer.push_quaternion(0.1, np.zeros(3), (0.0, 0.0, 0.0, 1.0 + 2.0 * stretch))
        assert len(buffer) == 2
        return
    with pytest.raises(PoseError, match="no rotation"):
        buffer.push(0.0, pose)
    with pytest.raises(PoseError, match="no rotation"):
        buffer.push_quaternion(0.1, np.zeros(3), (0.0, 0.0, 0.0, 1.0 + 2.0 * stretch))


def test_beyond_the_last_pose_it_is_extrapolated_and_then_refused():
    buffer = filled(STEADY_S)
    pose = buffer.at(0.49 + 0.0299)
    assert (pose.status, pose.refusal) == (PoseStatus.EXTRAPOLATED, None)
    np.testing.assert_allclose(pose.T_base_tool, true_pose(0.5199), atol=1e-9)
    pose = buffer.at(0.49 + 0.0301)
    assert (pose.status, pose.refusal) == (PoseStatus.REFUSED, PoseRefusal.POSES_STOPPED)
    for value, shape in (
        (pose.T_base_tool, (4, 4)),
        (pose.velocity_base_mm_s, (3,)),
        (pose.angular_velocity_base_rad_s, (3,)),
    ):
        assert value.shape == shape
        assert np.isnan(value).all()
    assert pose.period_s == pytest.approx(0.01)


def test_the_extrapolation_limit_is_set_in_periods():
    assert filled(STEADY_S, max_extrapolation_periods=6.0).at(0.549).status is PoseStatus.EXTRAPOLATED
    assert filled(STEADY_S, max_extrapolation_periods=0.0).at(0.4901).refusal is PoseRefusal.POSES_STOPPED
    assert filled(STEADY_S, max_extrapolation_periods=0.0).at(0.105).status is PoseStatus.INTERPOLATED


def test_a_later_pose_counts_only_within_one_period():
    # The pose after 0.49 s comes 1.5 periods late: a live run has stopped waiting for it by 0.4949 s.
    buffer = filled([*STEADY_S, 0.505])
    assert buffer.at(0.4949).status is PoseStatus.EXTRAPOLATED
    assert buffer.at(0.4951).status is PoseStatus.INTERPOLATED


@pytest.mark.slow
@settings(deadline=None)
@given(
    jitter=st.lists(st.floats(-0.004, 0.004), min_size=40, max_size=40),
    dropped=st.sets(st.integers(2, 38), max_size=12),
    t_s=st.floats(-0.01, 0.45),
)
def test_replay_sees_what_live_saw(jitter, dropped, t_s):
    times_s = [0.01 * i + jitter[i] for i in range(40) if i not in dropped]
    replay = filled(times_s).at(t_s)
    period_s = replay.period_s
    known_live = [s for s in times_s if s <= t_s] if np.isnan(period_s) else None
    live = filled(known_live or [s for s in times_s if s <= t_s + period_s]).at(t_s)
    assert same(replay, live)


@settings(deadline=None)
@given(
    intervals=st.lists(st.floats(0.0005, 0.03), min_size=5, max_size=60),
    fraction=st.floats(0.0, 1.0),
    extra_s=st.floats(0.0, 0.2),
)
def test_poses_beyond_one_period_never_change_an_answer(intervals, fraction, extra_s):
    times_s = np.cumsum(intervals)
    t_s = float(times_s[0] + fraction * (times_s[-1] - times_s[0]))
    replay = filled(times_s)
    answer = replay.at(t_s)
    later_s = max(times_s[-1], t_s + (0.0 if np.isnan(answer.period_s) else answer.period_s)) + extra_s + 1e-6
    replay.push(later_s, true_pose(later_s))
    assert same(replay.at(t_s), answer)


def test_only_the_two_neighbours_count():
    """The tool accelerates: what was before them says nothing of the way between them, nor beyond."""
    buffer = PoseBuffer()
    for t_s, x_mm in ((0.0, 0.0), (0.01, 0.0), (0.02, 0.0), (0.03, 1.0), (0.04, 3.0)):
        buffer.push_quaternion(t_s, (x_mm, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    for t_s, x_mm, velocity_mm_s in ((0.025, 0.5, 100.0), (0.035, 2.0, 200.0), (0.045, 4.0, 200.0)):
        pose = buffer.at(t_s)
        assert pose.T_base_tool[0, 3] == pytest.approx(x_mm)
        assert pose.velocity_base_mm_s[0] == pytest.approx(velocity_mm_s)
    # Two that are half a period apart, or nearer, make no speed: the one before them is taken.
    buffer.push_quaternion(0.0449, (3.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert buffer.at(0.0499).velocity_base_mm_s[0] == pytest.approx(2.0 / 0.0149)
    few = PoseBuffer()
    for t_s, x_mm in ((0.0, 0.0), (0.01, 1.0), (0.0101, 1.0)):
        few.push_quaternion(t_s, (x_mm, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert few.at(0.0105).velocity_base_mm_s[0] == pytest.approx(1.0 / 0.0101)


def test_what_lies_exactly_one_period_later_counts_and_three_are_bridged():
    times_s = [0.25 * i for i in range(8)]
    later = filled([*times_s, 2.25])
    assert later.at(2.0).status is PoseStatus.INTERPOLATED
    assert later.at(2.0 - 2.0**-20).status is PoseStatus.EXTRAPOLATED
    assert filled(times_s).at(2.5).status is PoseStatus.EXTRAPOLATED
    assert filled(times_s).at(2.5 + 2.0**-20).refusal is PoseRefusal.POSES_STOPPED


def test_a_gap_begins_beyond_four_periods():
    times_s = [0.25 * i for i in range(8)]
    for gap_s, status in ((1.0, PoseStatus.EXTRAPOLATED), (1.0625, PoseStatus.REFUSED)):
        buffer = filled([*times_s, times_s[-1] + gap_s])
        assert buffer.at(times_s[-1] + gap_s + 0.25).status is status
        assert buffer.at(times_s[-1] + gap_s).status is PoseStatus.INTERPOLATED


def test_nothing_to_go_by_is_refused():
    assert PoseBuffer().at(0.0).refusal is PoseRefusal.TOO_FEW_POSES
    assert filled([0.0]).at(0.0).refusal is PoseRefusal.TOO_FEW_POSES
    assert filled(STEADY_S).at(-0.001).refusal is PoseRefusal.TOO_FEW_POSES
    assert filled(STEADY_S).at(0.009).refusal is PoseRefusal.TOO_FEW_POSES


def test_a_gap_is_not_bridged():
    buffer = filled([*STEADY_S, 0.6, 0.61, 0.62, 0.63])
    assert buffer.at(0.51).status is PoseStatus.EXTRAPOLATED
    assert buffer.at(0.55).refusal is PoseRefusal.POSES_STOPPED
    assert buffer.at(0.595).refusal is PoseRefusal.GAP
    assert buffer.at(0.605).status is PoseStatus.INTERPOLATED
    without_next = filled([*STEADY_S, 0.6])
    assert without_next.at(0.6).status is PoseStatus.INTERPOLATED
    assert without_next.at(0.605).refusal is PoseRefusal.GAP


def test_two_poses_almost_at_once_do_not_make_a_speed():
    buffer = filled(STEADY_S)
    buffer.push_quaternion(0.4901, VELOCITY_MM_S * 0.49 + 0.025, START.as_quat())
    pose = buffer.at(0.51)
    assert pose.status is PoseStatus.EXTRAPOLATED
    np.testing.assert_allclose(pose.velocity_base_mm_s, VELOCITY_MM_S, atol=3.0)


def test_the_period_follows_a_change_of_rate():
    slow_s = 0.49 + 0.02 * np.arange(1, 32)
    buffer = filled([*STEADY_S, *slow_s])
    assert buffer.at(0.4).period_s == pytest.approx(0.01)
    # The median of the last 31 intervals: of 15 slow ones it is still the quick one.
    assert buffer.at(slow_s[14]).period_s == pytest.approx(0.01)
    assert buffer.at(slow_s[15]).period_s == pytest.approx(0.02)
    assert buffer.at(slow_s[-1]).period_s == pytest.approx(0.02)


def test_a_buffer_remembers_a_thousand_and_24_poses_unless_told():
    buffer = PoseBuffer()
    for i in range(1026):
        buffer.push_quaternion(0.01 * i, np.zeros(3), (0.0, 0.0, 0.0, 1.0))
    assert len(buffer) == 1024
    assert buffer.at(0.025).refusal is PoseRefusal.BEFORE_BUFFER
    assert buffer.at(0.03).status is PoseStatus.INTERPOLATED


def test_memory_is_bounded_and_says_so():
    buffer = PoseBuffer(capacity=8)
    for i in range(1000):
        buffer.push(0.01 * i, true_pose(0.01 * i))
        assert len(buffer) == min(i + 1, 8)
    np.testing.assert_allclose(buffer.at(9.985).T_base_tool, true_pose(9.985), atol=1e-9)
    assert buffer.at(9.0).refusal is PoseRefusal.BEFORE_BUFFER


@pytest.mark.slow
@settings(deadline=None)
@given(st.integers(2, 9), st.integers(2, 60))
def test_a_small_buffer_agrees_with_a_large_one(capacity, count):
    times_s = 0.01 * np.arange(count)
    small, large = filled(times_s, capacity=capacity), filled(times_s)
    t_s = float(times_s[-1]) + 0.003
    np.testing.assert_allclose(small.at(t_s).T_base_tool, large.at(t_s).T_base_tool, atol=1e-12)


def test_times_that_run_backwards_are_an_error():
    buffer = filled([0.0, 0.01])
    for t_s in (0.005, 0.01):
        with pytest.raises(PoseError, match=r"run backwards: 0\.0.* s after 0\.010000 s"):
            buffer.push(t_s, np.eye(4))
    buffer.push(0.02, np.eye(4))


@pytest.mark.parametrize(
    ("position", "quaternion", "message"),
    [
        ((0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "3 coordinates"),
        ((0.0, np.nan, 0.0), (0.0, 0.0, 0.0, 1.0), "not finite"),
        ((0.0, 0.0, 0.0), (0.0, np.inf, 0.0, 1.0), "not finite"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.99), "norm 0.99"),
    ],
)
def test_what_is_no_pose_is_an_error(position, quaternion, message):
    with pytest.raises(PoseError, match=message):
        PoseBuffer().push_quaternion(0.0, position, quaternion)


def test_what_is_no_rigid_matrix_is_an_error():
    buffer = PoseBuffer()
    with pytest.raises(PoseError, match="not finite"):
        buffer.push(np.nan, np.eye(4))
    for bad in (np.eye(3), np.diag([1.0, 1.0, 1.0, 2.0])):
        with pytest.raises(PoseError, match="4x4"):
            buffer.push(0.0, bad)
    for bad in (np.diag([1.0, 1.0, 1.01, 1.0]), np.diag([1.0, 1.0, -1.0, 1.0])):
        with pytest.raises(PoseError, match="no rotation"):
            buffer.push(0.0, bad)


def test_settings_and_times_must_make_sense():
    with pytest.raises(ValueError, match="capacity 1"):
        PoseBuffer(capacity=1)
    with pytest.raises(ValueError, match="max_extrapolation_periods -1"):
        PoseBuffer(max_extrapolation_periods=-1.0)
    with pytest.raises(ValueError, match="finite"):
        filled(STEADY_S).at(np.nan)
