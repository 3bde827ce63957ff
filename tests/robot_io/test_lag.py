from __future__ import annotations

import math
from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from robot_io.clocks.lag import LagLimits, LagUnestimated, Motion, estimate_lag, respond

LIMITS = LagLimits()


class World:
    """A robot that follows offsets along a seam, seen with noise: 50 commands and 100 poses a second."""

    def __init__(self, seed, seconds=6.0, noise_mm=None, spread_mm=1.0):
        rng = np.random.default_rng(seed)
        self.dead_s, self.constant_s = rng.uniform(0.02, 0.3), rng.uniform(0.03, 0.25)
        self.gain, self.zero_mm = rng.uniform(0.8, 1.1), rng.uniform(-5.0, 5.0)
        noise_mm = rng.uniform(0.01, 0.08) if noise_mm is None else noise_mm
        sent_s = np.cumsum(rng.uniform(0.015, 0.025, round(seconds * 50)))
        # A seam with a bend and a step now and then: a tack, a soft start.
        wave = sum(
            rng.normal(0.0, spread_mm / (n + 1))
            * np.sin(rng.uniform(0.3, 1.0) * (n + 1) * sent_s + rng.uniform(0, 6))
            for n in range(4)
        )
        steps = sum(rng.normal(0.0, 0.3 * spread_mm) * (sent_s > rng.uniform(0.5, seconds)) for _ in range(3))
        self.commanded = Motion(sent_s, np.round(wave + steps, 3))
        seen_s = np.arange(0.0, seconds, 0.01) + 100e-6 * rng.normal(size=round(seconds / 0.01))
        seen_s = np.sort(seen_s)
        moved = respond(self.commanded, seen_s - self.dead_s, self.constant_s, "held")
        self.seen = Motion(seen_s, self.gain * moved + self.zero_mm + rng.normal(0.0, noise_mm, len(seen_s)))

    @property
    def lag_s(self):
        return self.dead_s + self.constant_s


@pytest.mark.slow
def test_the_lag_is_unbiased_and_its_sigma_covers_over_four_hundred_worlds():
    z, sigmas_s, unestimated = [], [], 0
    for seed in range(420):
        world = World(seed)
        lag = estimate_lag(world.commanded, world.seen, LIMITS)
        if lag.unestimated is not None:
            unestimated += 1
            continue
        z.append((lag.lag_s - world.lag_s) / lag.sigma_s)
        sigmas_s.append(lag.sigma_s)
    z = np.array(z)
    assert unestimated < 40
    assert abs(z.mean()) < 3.0 / math.sqrt(len(z))
    assert 0.9 < z.std() < 1.12
    assert 0.93 < np.mean(np.abs(z) < 2.0) < 0.975
    assert np.abs(z).max() < 4.5
    assert np.median(sigmas_s) < 0.004


@pytest.mark.slow
def test_no_lag_is_told_of_a_robot_that_hardly_moves():
    for seed in range(60):
        world = World(seed, spread_mm=0.003, noise_mm=0.05)
        lag = estimate_lag(world.commanded, world.seen, LIMITS)
        assert lag.unestimated is not None
        assert math.isnan(lag.lag_s)
        assert math.isnan(lag.sigma_s)


@pytest.mark.slow
def test_a_robot_that_does_not_obey_has_no_lag():
    rng = np.random.default_rng(3)
    for seed in range(40):
        world = World(seed)
        alone = Motion(world.seen.times_s, rng.normal(0.0, 0.05, len(world.seen.times_s)))
        assert estimate_lag(world.commanded, alone, LIMITS).unestimated is not None


def weaving(t_s):
    return 1.5 * np.sin(2.0 * np.pi * 2.0 * t_s)


@pytest.mark.slow
def test_a_weave_beside_the_offsets_is_taken_out():
    for seed in range(20):
        world = World(seed, noise_mm=0.02)
        t_s = world.seen.times_s
        seen = Motion(t_s, world.seen.values_mm + weaving(t_s))
        columns = np.column_stack([np.sin(4.0 * np.pi * t_s), np.cos(4.0 * np.pi * t_s)])
        lag = estimate_lag(world.commanded, seen, LIMITS, nuisances=columns)
        assert lag.unestimated is None
        assert abs(lag.lag_s - world.lag_s) < 4.0 * lag.sigma_s


@pytest.mark.slow
def test_the_delay_between_poses_and_the_camera_is_that_of_a_weave():
    rng = np.random.default_rng(5)
    z = []
    for _ in range(120):
        delay_s = rng.uniform(0.0, 0.2)
        poses_s, frames_s = np.arange(0.0, 4.0, 0.01), np.arange(0.01, 4.0, 0.02)
        hz, phase = rng.uniform(0.8, 1.4), rng.uniform(0.0, 6.0)

        def place(t_s, hz=hz, phase=phase):
            return 1.5 * np.sin(2.0 * np.pi * hz * t_s + phase) + 0.3 * np.sin(1.1 * t_s)

        poses = Motion(poses_s, place(poses_s))
        seen = Motion(frames_s, place(frames_s - delay_s) + rng.normal(0.0, 0.05, len(frames_s)))
        lag = estimate_lag(poses, seen, LIMITS, "straight", first_order=False)
        assert lag.unestimated is None
        z.append((lag.lag_s - delay_s) / lag.sigma_s)
        assert lag.time_constant_s == 0.0
    assert abs(np.mean(z)) < 0.35
    assert 0.8 < np.std(z) < 1.2


def test_a_pure_weave_may_have_lagged_by_a_period_more():
    poses_s, frames_s = np.arange(0.0, 4.0, 0.01), np.arange(0.01, 4.0, 0.02)
    rng = np.random.default_rng(6)
    # Three periods of 0.2 s fit into what is searched.
    place = [1.5 * np.sin(2.0 * np.pi * 5.0 * t_s) for t_s in (poses_s, frames_s - 0.05)]
    seen = Motion(frames_s, place[1] + rng.normal(0.0, 0.03, len(frames_s)))
    lag = estimate_lag(Motion(poses_s, place[0]), seen, LIMITS, "straight", first_order=False)
    assert lag.unestimated is LagUnestimated.AMBIGUOUS


def test_what_is_too_little_or_too_far_is_named():
    world = World(1)
    few = Motion(world.seen.times_s[:80], world.seen.values_mm[:80])
    assert estimate_lag(world.commanded, few, LIMITS).unestimated is LagUnestimated.TOO_FEW
    nothing = Motion(np.empty(0), np.empty(0))
    assert estimate_lag(nothing, world.seen, LIMITS).unestimated is LagUnestimated.TOO_FEW
    still = Motion(world.commanded.times_s, np.zeros(len(world.commanded.times_s)))
    assert estimate_lag(still, world.seen, LIMITS).unestimated is LagUnestimated.TOO_STILL
    late = Motion(world.seen.times_s + 2.0, world.seen.values_mm)
    assert estimate_lag(world.commanded, late, LIMITS).unestimated in (
        LagUnestimated.AT_BOUND,
        LagUnestimated.TOO_STILL,
        LagUnestimated.TOO_UNSURE,
    )
    unsure = LagLimits(sigma_s=1e-6)
    assert estimate_lag(world.commanded, world.seen, unsure).unestimated is LagUnestimated.TOO_UNSURE
    slow = Motion(
        world.commanded.times_s, respond(world.commanded, world.commanded.times_s - 0.4, 0.1, "held")
    )
    bounded = LagLimits(longest_s=0.35)
    assert estimate_lag(world.commanded, slow, bounded).unestimated is LagUnestimated.AT_BOUND


def test_nuisances_that_are_one_and_the_same_leave_a_lag_or_a_reason():
    """A sum of variances that rounding makes negative once ended a live run."""
    sent_s, seen_s = 0.1 * np.arange(40), np.arange(0.7, 4.0, 0.02)
    for seed in (85, 150, 188, 295):
        rng = np.random.default_rng(seed)
        offsets_mm = np.append(0.0, 3.0 + rng.normal(0, 10.0 ** rng.uniform(-9, -2), 39))
        noise_mm = rng.normal(0, 10.0 ** rng.uniform(-9, -2), len(seen_s))
        seen = Motion(seen_s, np.interp(seen_s - 0.16, sent_s, offsets_mm) + noise_mm)
        drift = seen_s / seen_s[-1]
        near = drift * (1.0 + 1e-9 * rng.normal(size=len(seen_s)))
        nuisances = np.column_stack([drift, near] * 2) * 10.0 ** rng.uniform(-2, 5)
        lag = estimate_lag(Motion(sent_s, offsets_mm), seen, LIMITS, nuisances=nuisances)
        assert (lag.unestimated is None) == (lag.sigma_s >= 0.0)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6), constant=st.floats(0.01, 0.5), between=st.sampled_from(["held", "straight"])
)
def test_the_response_solves_its_equation(seed, constant, between):
    rng = np.random.default_rng(seed)
    t_s = np.cumsum(rng.uniform(0.02, 0.3, 8))
    motion = Motion(t_s, rng.normal(0.0, 1.0, 8))

    def command(time_s):
        if between == "straight":
            return np.interp(time_s, motion.times_s, motion.values_mm)
        return motion.values_mm[max(np.searchsorted(t_s, time_s, side="right") - 1, 0)]

    asked_s = np.linspace(t_s[0], t_s[-1] + 0.5, 40)
    r = [motion.values_mm[0]]
    for a_s, b_s in pairwise(asked_s):
        knots = [a_s, *t_s[(t_s > a_s) & (t_s < b_s)], b_s]
        value = r[-1]
        for low_s, high_s in pairwise(knots):
            middle = command(0.5 * (low_s + high_s))

            def rate(time_s, y, middle=middle):
                return (command(time_s) if between == "straight" else middle) - y

            value = solve_ivp(
                lambda time_s, y, rate=rate: rate(time_s, y) / constant, (low_s, high_s), [value], rtol=1e-9
            ).y[0, -1]
        r.append(value)
    np.testing.assert_allclose(respond(motion, asked_s, constant, between), r, atol=1e-5)


def test_without_a_time_constant_the_response_is_the_motion():
    motion = Motion(np.array([1.0, 2.0, 3.0]), np.array([0.0, 4.0, 2.0]))
    asked_s = np.array([0.0, 1.0, 1.5, 2.0, 2.5, 9.0])
    np.testing.assert_allclose(respond(motion, asked_s, 0.0, "straight"), [0.0, 0.0, 2.0, 4.0, 3.0, 2.0])
    np.testing.assert_allclose(respond(motion, asked_s, 0.0, "held"), [0.0, 0.0, 0.0, 4.0, 4.0, 2.0])
    np.testing.assert_allclose(
        respond(motion, asked_s, 1e-5, "straight"), [0.0, 0.0, 2.0, 4.0, 3.0, 2.0], atol=1e-3
    )


@pytest.mark.parametrize(
    ("times_s", "values_mm", "message"),
    [
        ([0.0, 1.0], [0.0], "a value for each"),
        ([[0.0]], [[0.0]], "a value for each"),
        ([0.0, 1.0], [0.0, math.nan], "not finite"),
        ([0.0, math.inf], [0.0, 1.0], "not finite"),
        ([0.0, 0.0], [0.0, 1.0], "rise"),
    ],
)
def test_what_is_no_motion_is_an_error(times_s, values_mm, message):
    with pytest.raises(ValueError, match=message):
        Motion(np.array(times_s), np.array(values_mm))


@pytest.mark.parametrize("name", [f.name for f in fields(LagLimits)])
def test_limits_must_be_positive_and_finite(name):
    for bad in (0, -1, math.inf, math.nan):
        with pytest.raises(ValueError, match=name):
            LagLimits(**{name: bad})
