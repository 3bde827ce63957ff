from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest

from robot_io import RobotPosePosition, RobotPoseRotation, message_layout
from robot_io.poses.plausibility_limits import MAY_BE_ZERO, PlausibilityLimits, noise_sigmas

LIMITS = PlausibilityLimits()


def test_the_steps_are_those_of_the_bus():
    position, rotation = (
        message_layout(RobotPosePosition.__name__),
        message_layout(RobotPoseRotation.__name__),
    )
    assert position.get_signal_by_name("x_mm").scale == LIMITS.position_step_mm
    assert rotation.get_signal_by_name("small_a").scale == LIMITS.quaternion_step


@pytest.mark.parametrize("rate", [0.5, 0.01, 1e-6, 1e-9, 1e-12])
def test_the_bound_is_met_at_the_stated_rate(rate):
    x = noise_sigmas(rate) ** 2
    assert (x / 3.0) ** 1.5 * math.exp((3.0 - x) / 2.0) == pytest.approx(rate, rel=1e-6)
    assert x > 3.0


def test_no_more_than_the_stated_share_of_rounding_is_beyond_the_bound():
    rng = np.random.default_rng(1)
    for rate in (0.1, 0.01, 0.001):
        errors = rng.uniform(-0.5, 0.5, (200_000, 3, 3)) * LIMITS.position_step_mm
        second_difference = errors[:, 0] - 2.0 * errors[:, 1] + errors[:, 2]
        beyond = np.linalg.norm(second_difference, axis=1) > (
            noise_sigmas(rate) * math.sqrt(6.0) * LIMITS.position_sigma_mm(0.0)
        )
        assert beyond.mean() < rate


def test_jitter_counts_as_much_as_the_tool_is_fast():
    still, fast = LIMITS.position_sigma_mm(0.0), LIMITS.position_sigma_mm(100.0)
    assert still == pytest.approx(0.025 / math.sqrt(12.0))
    assert fast == pytest.approx(math.hypot(still, 0.05))


def test_rounding_of_a_rotation_stays_within_its_sigma():
    rng = np.random.default_rng(2)
    q = rng.normal(size=(5000, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    step = LIMITS.quaternion_step
    turns = []
    for row in q:
        message = RobotPoseRotation.from_quaternion(tuple(row))
        rounded = RobotPoseRotation(
            message.largest,
            *(step * round(c / step) for c in (message.small_a, message.small_b, message.small_c)),
            0.0,
        )
        turns.append(2.0 * math.dist(message.quaternion_xyzw, rounded.quaternion_xyzw))
    assert np.sqrt(np.mean(np.square(turns)) / 3.0) < LIMITS.rotation_sigma_rad(0.0)
    assert max(turns) < LIMITS.sigmas * LIMITS.rotation_sigma_rad(0.0)


@pytest.mark.parametrize("name", [f.name for f in fields(PlausibilityLimits) if f.name != "age_required"])
def test_limits_must_be_positive_and_finite(name):
    for bad in (-1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match=name):
            PlausibilityLimits(**{name: bad})
    if name in MAY_BE_ZERO:
        PlausibilityLimits(**{name: 0.0})
    else:
        with pytest.raises(ValueError, match=name):
            PlausibilityLimits(**{name: 0.0})


@pytest.mark.parametrize("name", ["false_alarm", "speed_share"])
def test_shares_stay_below_the_whole(name):
    with pytest.raises(ValueError, match=name):
        PlausibilityLimits(**{name: 1.0})
