"""A motion that goes on with an experiment: the run is kept, the way over is smooth."""

import dataclasses

import numpy as np
import pytest

from noise_model.transforms import moved
from sim_to_real.decision.experiments import MENU
from validation.second_renderer.world_stated import JOINTS, ContinuedMotion, draw_stated

FROM_S, TO_S = 1.2, 1.8
BY_KEY = {one.key: one for one in MENU}


def motion_of(joint="v_groove"):
    return draw_stated(np.random.default_rng(5), joint)[1]


def continued(key, joint="v_groove"):
    return ContinuedMotion(motion_of(joint), BY_KEY[key], FROM_S, TO_S)


@pytest.mark.parametrize("key", BY_KEY)
@pytest.mark.parametrize("joint", JOINTS)
def test_the_run_stays_bit_for_bit(key, joint):
    motion, longer = motion_of(joint), continued(key, joint)
    for time_s in (-0.4, 0.0, 0.1, 0.7, FROM_S):
        np.testing.assert_array_equal(longer.T_base_tool(time_s), motion.T_base_tool(time_s))
        assert longer.height_at_mm(time_s) == motion.height_at_mm(time_s)


@pytest.mark.parametrize("key", sorted(BY_KEY.keys() - {"faster"}))
def test_the_tool_keeps_turn_and_move_over_the_same_motion(key):
    motion, longer, one = motion_of(), continued(key), BY_KEY[key]
    for time_s in (TO_S, 2.0, 2.7):
        want = moved(motion.T_base_tool(time_s), one.turn_deg, one.move_mm)
        np.testing.assert_allclose(longer.T_base_tool(time_s), want, atol=1e-12)
    rises_mm = 1.98 if key == "raised" else 0.0
    assert longer.height_at_mm(2.0) - motion.height_at_mm(2.0) == pytest.approx(rises_mm, abs=0.02)


def test_thrice_as_fast_is_the_same_motion_on_another_clock():
    motion, longer = motion_of(), continued("faster")
    # The speed rises evenly about its middle: 0.6 s at twice the speed on average.
    for time_s in (TO_S, 2.0, 2.7):
        run_s = FROM_S + 2.0 * (TO_S - FROM_S) + 3.0 * (time_s - TO_S)
        np.testing.assert_allclose(longer.T_base_tool(time_s), motion.T_base_tool(run_s), atol=1e-9)
        assert longer.height_at_mm(time_s) == pytest.approx(motion.height_at_mm(run_s))


@pytest.mark.parametrize("key", BY_KEY)
def test_the_way_over_is_smooth(key):
    still = (0.0, 1.0, 0.0)
    even = dataclasses.replace(motion_of(), weave=still, rise=still, roll=still, pitch=still)
    longer = ContinuedMotion(even, BY_KEY[key], FROM_S, TO_S)
    times_s = np.arange(FROM_S - 0.1, TO_S + 0.1, 0.001)
    poses = np.array([longer.T_base_tool(float(t)) for t in times_s])
    per_s = np.diff(poses, axis=0) / 0.001
    # In 1 ms no speed changes by more than 50 mm/s^2 and 3.2 rad/s^2 do.
    assert np.abs(np.diff(per_s[:, :3, 3], axis=0)).max() < 0.05
    assert np.abs(np.diff(per_s[:, :3, :3], axis=0)).max() < 0.0032
