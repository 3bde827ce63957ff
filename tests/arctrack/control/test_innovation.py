from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.stats import chi2

from arctrack.control.innovation import InnovationLimits, SeamInnovation, SeamMeasurement, SeamMotion
from tracker.seam.gaussian_process import SeamHistory

LIMITS = InnovationLimits()
RATE_HZ, SPEED_MM_S = 50.0, 10.0
WEAVE_MM, WEAVE_HZ = 2.0, 2.0


def weave(t_s):
    return WEAVE_MM * math.sin(2.0 * math.pi * WEAVE_HZ * t_s)


def seam_mm(station_mm):
    # Bends by half a millimetre over some 60 mm, and lies 2 mm off its line.
    return 2.0 + 0.5 * math.sin(station_mm / 40.0), -0.7 + 0.3 * math.cos(station_mm / 50.0)


def run(seed, error=lambda t_s: (0.0, 0.0), until_s=6.0, sigma_mm=0.05, direction=1.0, limits=LIMITS):
    """Yield time and verdict of a seam that is measured from poses with an error (y, z) in mm."""
    rng = np.random.default_rng(seed)
    state = SeamInnovation()
    for n in range(round(until_s * RATE_HZ)):
        t_s = n / RATE_HZ
        station_mm = direction * SPEED_MM_S * t_s
        noise, off = rng.normal(0.0, sigma_mm, 2), error(t_s)
        y, z = seam_mm(station_mm)
        measured = SeamMeasurement(
            station_mm, (y + noise[0] + off[0], z + noise[1] + off[1]), (sigma_mm, sigma_mm)
        )
        state = state.with_seam(measured, limits)
        yield t_s, state


def motions(states, from_s=0.0, to_s=math.inf):
    return {state.motion for t_s, state in states if from_s <= t_s < to_s}


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_seam_that_stands_still_in_base_is_consistent(direction):
    for seed in range(30):
        states = list(run(seed, direction=direction))
        assert motions(states, 0.0, 0.4) == {SeamMotion.UNPROVEN}
        assert motions(states, 0.42) == {SeamMotion.CONSISTENT}


FAULT_S, END_S = 2.0, 4.0
FAULTS = {
    "late by 100 ms": lambda t_s: (weave(t_s - 0.1) - weave(t_s), 0.0),
    "late by 30 ms": lambda t_s: (weave(t_s - 0.03) - weave(t_s), 0.0),
    "mirrored": lambda t_s: (-2.0 * weave(t_s), 0.0),
    "frozen": lambda t_s: (weave(FAULT_S) - weave(t_s), 0.0),
    "drifting by 2 mm/s": lambda t_s: (2.0 * (t_s - FAULT_S), 0.0),
    "height jumps": lambda _: (0.0, 1.0),
    "jumps to and fro": lambda t_s: (0.0 if int(2.0 * t_s) % 2 else 2.0, 0.0),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_pose_is_contradicted_and_recovers(name):
    def error(t_s):
        return FAULTS[name](t_s) if FAULT_S <= t_s < END_S else (0.0, 0.0)

    for seed in range(5):
        states = list(run(seed, error))
        assert motions(states, 0.5, FAULT_S) == {SeamMotion.CONSISTENT}
        told_s = next(t_s for t_s, state in states if state.motion is SeamMotion.CONTRADICTED)
        assert FAULT_S < told_s < FAULT_S + 0.4
        assert states[-1][1].motion is SeamMotion.CONSISTENT


@pytest.mark.parametrize("name", ["late by 100 ms", "mirrored"])
def test_a_pose_that_is_wrong_from_the_first_frame_is_never_consistent(name):
    states = list(run(1, FAULTS[name]))
    assert SeamMotion.CONSISTENT not in motions(states)
    assert states[-1][1].motion is SeamMotion.CONTRADICTED


@pytest.mark.parametrize(("jump_mm", "until_s"), [(1.0, 3.0), (1.5, 4.0), (-3.0, 8.0)])
def test_a_seam_that_stays_elsewhere_stays_contradicted_as_long_as_none_bends_so(jump_mm, until_s):
    states = list(run(2, lambda t_s: (jump_mm, 0.0) if t_s >= FAULT_S else (0.0, 0.0), until_s=until_s))
    assert motions(states, FAULT_S + 0.4) == {SeamMotion.CONTRADICTED}


def test_a_slow_drift_is_a_seam_that_runs_off():
    # What no single pass can tell: docs/explanation/plausibility.md says so.
    states = run(3, lambda t_s: (0.1 * t_s, 0.0))
    assert motions(states, 0.42) == {SeamMotion.CONSISTENT}


def test_one_bad_frame_is_no_wrong_pose():
    states = run(4, lambda t_s: (5.0, -5.0) if abs(t_s - 3.0) < 0.001 else (0.0, 0.0))
    assert motions(states, 0.42) == {SeamMotion.CONSISTENT}


@pytest.mark.slow
def test_windows_fail_no_more_often_than_stated():
    limits = replace(LIMITS, false_alarm=0.02, sigma_floor_mm=0.001, max_sigmas=100.0)
    failed = windows = 0
    for seed in range(150):
        # A window that begins where the filter has learnt, and shares nothing with another.
        states = list(run(seed, until_s=1.7, limits=replace(limits, false_alarm=1e-12)))
        for k in (40, 60, 80):
            windows += 1
            failed += states[k][1].chi2 > limits.chi2
    assert failed <= windows * 0.02 + 3.0 * math.sqrt(windows * 0.02)


def test_innovations_are_as_wide_as_they_say():
    limits = replace(LIMITS, max_sigmas=100.0, sigma_floor_mm=0.001)
    states = [state for seed in range(8) for _, state in run(seed, limits=limits)]
    values = np.array([state.innovations[-1] for state in states if state.innovations])
    assert 0.85 < values[:, 0].std() < 1.05
    assert abs(values.mean()) < 0.1


def test_the_filter_is_the_process_of_the_seam():
    rng = np.random.default_rng(5)
    history, state = SeamHistory(), SeamInnovation()
    stations = np.cumsum(rng.uniform(1.1, 6.0, 12))
    for n, station_mm in enumerate(stations):
        y, z = rng.normal(0.0, 0.3, 2)
        measured = SeamMeasurement(float(station_mm), (y, z), (0.2, 0.1))
        if n:
            value, sigma = history.at(float(station_mm))
            expected = (np.array([y, z]) - value) / np.sqrt(sigma**2 + [0.2**2 + 1e-4, 0.1**2 + 1e-4])
        state = state.with_seam(measured, replace(LIMITS, max_sigmas=100.0, false_alarm=1e-30))
        if n:
            np.testing.assert_allclose(state.innovations[-1], expected, rtol=1e-6, atol=1e-9)
        history = history.with_measurement(float(station_mm), np.array([y, z]), np.array([0.2**2, 0.1**2]))


def test_the_way_back_is_the_way_there_in_a_mirror():
    there, back = SeamInnovation(), SeamInnovation()
    rng = np.random.default_rng(6)
    for n in range(15):
        pair = tuple(rng.normal(0.0, 0.1, 2))
        there = there.with_seam(SeamMeasurement(0.7 * n, pair, (0.05, 0.05)), LIMITS)
        back = back.with_seam(SeamMeasurement(-0.7 * n, pair, (0.05, 0.05)), LIMITS)
    np.testing.assert_allclose(there.innovations, back.innovations, rtol=1e-9)


def test_a_seam_far_on_begins_anew_and_what_is_not_known_says_nothing():
    *_, (_, state) = run(7)
    assert state.with_seam(SeamMeasurement(math.nan, (0.0, 0.0), (0.1, 0.1)), LIMITS) is state
    assert state.with_seam(SeamMeasurement(60.0, (0.0, math.nan), (0.1, 0.1)), LIMITS) is state
    far = state.with_seam(SeamMeasurement(100.0, (9.0, 9.0), (0.1, 0.1)), LIMITS)
    assert far.innovations == ()
    assert far.motion is SeamMotion.CONSISTENT


def test_the_limit_is_a_quantile():
    assert pytest.approx(chi2.isf(1e-6, 40), rel=1e-9) == LIMITS.chi2


@pytest.mark.parametrize("name", [f.name for f in fields(InnovationLimits)])
def test_limits_must_be_positive_and_finite(name):
    for bad in (0, -1, math.inf, math.nan):
        with pytest.raises(ValueError, match=name):
            InnovationLimits(**{name: bad})


TURNED_LEGS = (((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
"""Left and up before and behind a corner to the left."""


@pytest.mark.parametrize(
    ("height_mm", "motion"), [(0.5, SeamMotion.CONSISTENT), (3.0, SeamMotion.CONTRADICTED)]
)
def test_behind_a_corner_a_displaced_part_lies_elsewhere_across_but_not_in_height(height_mm, motion):
    """By (2, 1, 0.5) mm in base: 1 mm to the left of the first leg, 2 mm to the right of the second."""
    state, seen = SeamInnovation(), set()
    for leg, (y_mm, z_mm) in enumerate([(1.0, 0.5), (-2.0, height_mm)]):
        for n in range(40):
            station_mm = 30.0 * leg + 0.5 * n
            measured = SeamMeasurement(station_mm, (y_mm, z_mm), (0.03, 0.03), TURNED_LEGS[leg])
            state = state.with_seam(measured, LIMITS)
            seen.add(state.motion)
    assert (SeamMotion.CONTRADICTED in seen) == (motion is SeamMotion.CONTRADICTED)


def test_a_tool_that_turns_makes_the_seam_as_unsure_as_its_lever_is_long():
    measured = SeamMeasurement(10.0, (0.0, 0.0), (0.03, 0.04), lever_mm=35.0)
    moving = measured.at_speed(10.0, 1.0, LIMITS)
    spread_mm = LIMITS.pose_time_s * 45.0
    assert moving.sigma_mm == pytest.approx((math.hypot(0.03, spread_mm), math.hypot(0.04, spread_mm)))


def test_a_fast_weave_whose_poses_are_off_by_a_millisecond_is_no_contradiction():
    """A weave at up to 42 mm/s moves the seam by 0.04 mm in a millisecond, beyond a sharp image's sigma."""
    weave_mm, rate = 2.4, 2.0 * math.pi * 2.8
    verdicts = {0.001: [], 0.1: []}
    for late_s, motions_seen in verdicts.items():
        for seed in range(20):
            rng, state = np.random.default_rng(seed), SeamInnovation()
            for n in range(150):
                t_s = n / RATE_HZ
                off_mm = weave_mm * (math.sin(rate * (t_s - late_s)) - math.sin(rate * t_s))
                y, z = seam_mm(6.5 * t_s) + rng.normal(0.0, 0.03, 2)
                measured = SeamMeasurement(6.5 * t_s, (y + off_mm, z), (0.03, 0.03))
                speed_mm_s = math.hypot(6.5, weave_mm * rate * math.cos(rate * t_s))
                state = state.with_seam(measured.at_speed(speed_mm_s, 0.0, LIMITS), LIMITS)
                if state.motion is SeamMotion.CONTRADICTED:
                    break
            motions_seen.append(state.motion)
    assert set(verdicts[0.001]) == {SeamMotion.CONSISTENT}
    assert set(verdicts[0.1]) == {SeamMotion.CONTRADICTED}
