from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest
from scipy.signal import lsim

from robot_io.clocks.lag import LagLimits, LagUnestimated, Motion, estimate_lag
from tests.robot_io.first_order import STEP_S, follow

LIMITS = LagLimits()


class World:
    """A robot that follows offsets along a seam, seen with noise: 50 commands and 100 poses a second."""

    def __init__(self, seed, seconds=6.0, noise_mm=None, spread_mm=1.0):
        rng = np.random.default_rng(seed)
        self.dead_s, self.constant_s = rng.uniform(0.02, 0.3), rng.uniform(0.03, 0.25)
        self.gain, self.zero_mm = rng.uniform(0.8, 1.1), rng.uniform(-5.0, 5.0)
        noise_mm = rng.uniform(0.01, 0.08) if noise_mm is None else noise_mm
        sent_s = STEP_S * np.round(np.cumsum(rng.uniform(0.015, 0.025, round(seconds * 50))) / STEP_S)
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
        moved = follow(self.commanded, seen_s, self.dead_s, self.constant_s)
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
    slow = Motion(world.commanded.times_s, follow(world.commanded, world.commanded.times_s, 0.4, 0.1))
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


@pytest.mark.parametrize("between", ["held", "straight"])
@pytest.mark.parametrize(("dead_s", "constant_s"), [(0.12, 0.0), (0.0, 0.15), (0.2, 0.03), (0.05, 0.4)])
def test_a_robot_without_noise_shows_its_lag_and_gain(between, dead_s, constant_s):
    t_s = 1e-3 * np.arange(8000)
    commanded = Motion(t_s[::50], np.random.default_rng(4).normal(size=160).cumsum())
    place_mm = np.interp(t_s, commanded.times_s, commanded.values_mm)
    if between == "held":
        place_mm = np.repeat(commanded.values_mm, 50)
    if constant_s > 0.0:
        _, place_mm, _ = lsim(([1.0], [constant_s, 1.0]), place_mm, t_s, interp=between == "straight")
    seen_s = t_s[1005::10]
    seen = Motion(seen_s, 0.9 * np.interp(seen_s - dead_s, t_s, place_mm) + 2.0)
    lag = estimate_lag(commanded, seen, LIMITS, between)
    assert lag.unestimated is None
    assert [lag.dead_time_s, lag.time_constant_s] == pytest.approx([dead_s, constant_s], abs=1e-3)
    assert lag.gain == pytest.approx(0.9, rel=1e-3)


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
