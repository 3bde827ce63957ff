from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from robot_io import RobotSync, message_layout
from robot_io.clocks.sync import SEQUENCE_BITS, TIME_BITS, ClockSync, Exchange, SyncLimits, Unestimated

LIMITS = SyncLimits()


class World:
    """Two clocks, a bus that queues either way, and messages that get lost."""

    def __init__(self, seed, skew=0.0, offset_s=1000.0, there_ms=1.0, back_ms=1.0, lost=0.0):
        self.rng = np.random.default_rng(seed)
        self.skew, self.offset_s = skew, offset_s
        self.there_s, self.back_s = there_ms * 1e-3, back_ms * 1e-3
        self.lost = lost
        self.start_us = int(self.rng.integers(2**TIME_BITS))
        self.round_trip_us = None

    def tracker_s(self, true_s):
        return self.offset_s + true_s * (1.0 + self.skew)

    def queue(self, mean_s):
        # The frame itself takes 0.27 ms at 500 kbit/s; now and then something holds it for far longer.
        held_s = self.rng.exponential(20.0 * mean_s) if self.rng.random() < 0.05 else 0.0
        return 0.00027 + self.rng.exponential(mean_s) + held_s

    def exchange(self, n, period_s=0.1):
        """Return the n-th message and when it is read, None where it got lost."""
        sent_s = n * period_s
        robot_us = (self.start_us + round(sent_s * 1e6)) % 2**TIME_BITS
        message = RobotSync(n % 2**SEQUENCE_BITS, robot_us, self.round_trip_us)
        there_s, back_s = self.queue(self.there_s), self.queue(self.back_s)
        self.round_trip_us = None
        if self.rng.random() < self.lost:
            return message, None
        if self.rng.random() >= self.lost:
            round_trip_us = round((there_s + back_s) * 1e6)
            self.round_trip_us = round_trip_us if round_trip_us < 65535 else None
        return message, self.tracker_s(sent_s + there_s)

    def run(self, count, state=None, first=0):
        state = state or ClockSync()
        arrived_s = math.nan
        for n in range(first, first + count):
            message, read_s = self.exchange(n)
            if read_s is not None:
                arrived_s = read_s
                state = state.on_sync(message, arrived_s, LIMITS)
        return state, arrived_s


def true_offset_s(world, state, n):
    # The state counts the robot's time from its own nought: at the n-th message both are known.
    return world.tracker_s(n * 0.1) - state.exchanges[-1].robot_s


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    skew=st.floats(-95e-6, 95e-6),
    there=st.floats(0.01, 5.0),
    back=st.floats(0.01, 5.0),
    lost=st.floats(0.0, 0.3),
)
def test_the_truth_is_always_within_the_bounds(seed, skew, there, back, lost):
    world = World(seed, skew, there_ms=there, back_ms=back, lost=lost)
    state = ClockSync()
    for n in range(150):
        message, read_s = world.exchange(n)
        if read_s is None:
            continue
        state = state.on_sync(message, read_s, LIMITS)
        offset = state.offset(read_s, replace(LIMITS, width_s=1.0))
        if offset.unestimated is None:
            truth_s = true_offset_s(world, state, n)
            assert offset.lower_s <= truth_s <= offset.upper_s
            assert offset.skew[0] <= skew <= offset.skew[1]
    assert state.steps == 0


@pytest.mark.slow
def test_no_queue_biases_the_estimate():
    # The way there queues ten times as long as the way back: an average would be off by 2.5 ms.
    errors_s, sigmas_s = [], []
    for seed in range(25):
        world = World(seed, skew=30e-6, there_ms=5.0, back_ms=0.5)
        state, read_s = world.run(250)
        offset = state.offset(read_s, LIMITS)
        assert offset.unestimated is None
        errors_s.append(offset.offset_s - true_offset_s(world, state, 249))
        sigmas_s.append(offset.sigma_s)
    assert abs(np.mean(errors_s)) < 1e-4
    assert np.max(np.abs(errors_s)) < 5e-4
    assert np.mean(np.abs(errors_s) < 2.0 * np.array(sigmas_s)) > 0.95


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(6, 40))
def test_the_bounds_are_those_of_a_linear_programme(seed, count):
    rng = np.random.default_rng(seed)
    robot_s = np.sort(rng.uniform(0.0, 20.0, count))
    there_s, back_s = rng.exponential(0.002, (2, count))
    skew = rng.uniform(-90e-6, 90e-6)
    state = ClockSync()
    limits = replace(LIMITS, width_s=1.0)
    exchanges = [
        Exchange(t, t + 5.0 + skew * t + d, d + b) for t, d, b in zip(robot_s, there_s, back_s, strict=True)
    ]
    for exchange in exchanges:
        state = state.exchanged(exchange, limits)
    offset = state.offset(exchanges[-1].arrived_s, limits)
    x = robot_s - robot_s[-1]
    apart = np.array([e.arrived_s - e.robot_s for e in exchanges])
    lower = apart - (there_s + back_s) - limits.resolution_s
    A = np.concatenate([np.stack([np.ones(count), x], 1), -np.stack([np.ones(count), x], 1)])
    b = np.concatenate([apart + limits.resolution_s, -lower])
    for sign, bound in ((1.0, offset.lower_s), (-1.0, offset.upper_s)):
        best = linprog([sign, 0.0], A, b, bounds=[(None, None), (-limits.skew, limits.skew)], method="highs")
        assert best.x[0] == pytest.approx(bound, abs=2e-7)


@pytest.mark.parametrize("step_s", [1.0, -1.0])
def test_a_clock_that_is_set_is_seen_and_forgotten(step_s):
    world = World(7, skew=50e-6)
    state, _ = world.run(100)
    assert state.steps == 0
    world.offset_s += step_s
    state, read_s = world.run(2, state, 100)
    assert state.steps == 1
    assert state.offset(read_s, LIMITS).unestimated is Unestimated.TOO_FEW
    state, read_s = world.run(60, state, 102)
    offset = state.offset(read_s, LIMITS)
    assert offset.unestimated is None
    assert abs(offset.offset_s - true_offset_s(world, state, 161)) < 1e-3
    assert state.steps == 1


def test_a_clock_that_drifts_beyond_the_stated_skew_counts_as_set():
    state, limits = ClockSync(), replace(LIMITS, resolution_s=1e-9)
    for n in range(20):
        t_s = 0.1 * n
        state = state.exchanged(Exchange(t_s, 5.0 + 1.001 * t_s + 1e-5, 2e-5), limits)
    assert state.steps > 0


def test_too_few_exchanges_tell_nothing():
    world = World(1)
    state, read_s = world.run(5)
    assert state.offset(read_s, LIMITS).unestimated is Unestimated.TOO_FEW
    assert all(math.isnan(bound) for bound in state.delay_s(read_s, LIMITS))
    state, read_s = world.run(1, state, 5)
    assert state.offset(read_s, replace(LIMITS, width_s=0.1)).unestimated is None
    assert ClockSync().offset(0.0, LIMITS).unestimated is Unestimated.TOO_FEW


def test_without_round_trips_nothing_bounds_the_offset_from_below():
    state = ClockSync()
    for n in range(50):
        state = state.on_sync(RobotSync(n, 100_000 * n, None), 0.1 * n + 0.001, LIMITS)
    assert state.offset(4.9, LIMITS).unestimated is Unestimated.TOO_FEW


def test_silence_makes_it_stale_and_slow_ways_make_it_wide():
    world = World(2)
    state, read_s = world.run(100)
    assert state.offset(read_s + 0.99, LIMITS).unestimated is None
    for now_s in (read_s + 1.01, read_s - 1.01, math.nan):
        assert state.offset(now_s, LIMITS).unestimated is Unestimated.STALE
    assert state.offset(read_s, replace(LIMITS, width_s=1e-5)).unestimated is Unestimated.TOO_WIDE


@pytest.mark.parametrize("late_s", [0.0, 0.05, 0.1, 1.0])
def test_a_message_that_came_late_is_told_by_how_much(late_s):
    world = World(3, skew=-40e-6)
    state, _ = world.run(100)
    message, read_s = world.exchange(100)
    state = state.on_sync(message, read_s + late_s, LIMITS)
    min_s, max_s = state.delay_s(read_s + late_s, LIMITS)
    true_s = read_s + late_s - world.tracker_s(10.0)
    assert min_s <= true_s <= max_s
    assert min_s > late_s - 0.001
    assert max_s - min_s < 0.001


def test_a_round_trip_belongs_to_the_message_before():
    state = ClockSync().on_sync(RobotSync(10, 0, 999), 5.0, LIMITS)
    assert math.isnan(state.exchanges[0].round_trip_s)
    state = state.on_sync(RobotSync(12, 200_000, 999), 5.2, LIMITS)
    assert math.isnan(state.exchanges[0].round_trip_s)
    state = state.on_sync(RobotSync(13, 300_000, 999), 5.3, LIMITS)
    assert state.exchanges[1].round_trip_s == pytest.approx(999e-6)
    assert math.isnan(state.exchanges[2].round_trip_s)


def test_the_robots_time_and_number_run_round():
    layout = message_layout(RobotSync.__name__)
    assert layout.get_signal_by_name("robot_time_us").length == TIME_BITS
    assert layout.get_signal_by_name("sequence").length == SEQUENCE_BITS
    state = ClockSync().on_sync(RobotSync(255, 2**TIME_BITS - 50_000, None), 5.0, LIMITS)
    before_s = state.robot_s
    state = state.on_sync(RobotSync(0, 50_000, 700), 5.1, LIMITS)
    assert state.robot_s - before_s == pytest.approx(0.1)
    assert state.exchanges[0].round_trip_s == pytest.approx(700e-6)


@pytest.mark.slow
def test_what_is_too_old_no_longer_counts():
    world = World(4)
    state, _ = world.run(400)
    assert len(state.exchanges) == pytest.approx(301, abs=1)


@pytest.mark.parametrize("name", [f.name for f in fields(SyncLimits)])
def test_limits_must_be_positive_and_finite(name):
    for bad in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match=name):
            SyncLimits(**{name: bad})
