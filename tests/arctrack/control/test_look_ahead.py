from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from arctrack.control.look_ahead import LookAhead
from robot_io import Command, PoseKind, PoseSample, SeamOffset, Switch, TrackerCommand, Validity
from robot_io.clocks.lag import Lag, LagUnestimated, Motion
from robot_io.poses.nominal_path import NominalPath
from tests.robot_io.first_order import follow
from tracker.state import AT_ONCE
from validation.fault_schedules.judged_cell import JudgedCell
from validation.fault_schedules.worlds import draw_world

PATH = NominalPath(((0.0, 0.0, 0.0), (500.0, 0.0, 0.0)))
DISARM = TrackerCommand(Command.DISARM, True, True, 0, 1, 1, Switch.ON)
DEAD_S, CONSTANT_S, SPEED_MM_S = 0.07, 0.09, 10.0


def lead_at(ahead, now_s):
    ahead.update(now_s)
    return ahead.offset_look_ahead()


def offset(y_mm, validity=Validity.VALID, age_ms=15.0):
    return SeamOffset(y_mm, 0.0, age_ms, 0.9, validity)


def sample(t_s, y_mm, age_s=0.002):
    return PoseSample(t_s, (SPEED_MM_S * t_s, y_mm, 0.0), (0.0, 0.0, 0.0, 1.0), PoseKind.ACTUAL, age_s)


def drive(ahead, seconds=4.0, weave_hz=1.7, disarmed=True, begin_s=0.0, gap_s=None):
    """Let a robot weave, and follow offsets that go to 3 mm in a soft start; some time is not trusted."""
    sent_s = begin_s + np.arange(0.4, seconds, 0.04)
    sent_mm = np.minimum(20.0 * (sent_s - sent_s[0]), 3.0)
    before = Motion(np.concatenate([[begin_s - 5.0], sent_s]), np.concatenate([[0.0], sent_mm]))
    seen_s = begin_s + np.arange(0.0, seconds, 0.01)
    followed = follow(before, seen_s, DEAD_S, CONSTANT_S)
    rng = np.random.default_rng(2)
    y_mm = followed + 1.5 * np.sin(2.0 * np.pi * weave_hz * seen_s + 0.4) + rng.normal(0.0, 0.01, len(seen_s))
    if disarmed:
        ahead.hear(DISARM)
    events = [(t_s, None, y) for t_s, y in zip(seen_s, y_mm, strict=True)]
    events += [(t_s + 0.015, u, None) for t_s, u in zip(sent_s, sent_mm, strict=True)]
    for t_s, u, y in sorted(events, key=lambda event: event[0]):
        if u is not None:
            ahead.sent(offset(u), t_s)
        else:
            ahead.see(sample(t_s, y), gap_s is None or not gap_s[0] < t_s < gap_s[1])
        lead_at(ahead, t_s)


@pytest.mark.parametrize("weave_hz", [0.9, 1.7, 3.3])
def test_a_soft_start_tells_the_lag_beside_any_weave(weave_hz):
    ahead = LookAhead(PATH)
    drive(ahead, weave_hz=weave_hz)
    assert abs(ahead.lag.lag_s - (DEAD_S + CONSTANT_S)) < 4.0 * ahead.lag.sigma_s
    assert ahead.lag.sigma_s < 0.005
    # Half a period of the frames on top.
    lead = lead_at(ahead, 4.0)
    assert lead.time_s == pytest.approx(ahead.lag.lag_s + 0.02, abs=1e-9)
    assert lead.way_mm == pytest.approx(SPEED_MM_S * lead.time_s, rel=1e-6)


def test_a_robot_that_was_not_seen_at_nought_tells_nothing_by_its_soft_start():
    ahead = LookAhead(PATH)
    drive(ahead, disarmed=False)
    assert ahead.lag.unestimated is not None
    assert lead_at(ahead, 4.0) == AT_ONCE


def test_what_is_doubted_or_of_unknown_age_or_refused_is_forgotten():
    ahead = LookAhead(PATH)
    drive(ahead, gap_s=(0.5, 1.5))
    assert ahead.lag.unestimated is not None
    ahead = LookAhead(PATH)
    for n in range(200):
        ahead.see(sample(0.01 * n, 0.0, age_s=math.nan), True)
    ahead.sent(offset(1.0), 2.0)
    ahead.sent(offset(1.0), 2.04)
    assert lead_at(ahead, 2.1) == AT_ONCE
    ahead = LookAhead(PATH)
    drive(ahead)
    assert lead_at(ahead, 4.0).way_mm > 0.0
    ahead.sent(offset(math.nan, Validity.REFUSED), 4.0)
    # The lag is the robot's own and stays; how fast it goes is seen anew.
    assert ahead.lag.unestimated is None
    assert lead_at(ahead, 4.0) == AT_ONCE


def test_the_better_estimate_is_kept_until_another_lag_shows():
    ahead = LookAhead(PATH)
    first = Lag(0.2, 0.002)
    for lag, kept in (
        (Lag(unestimated=LagUnestimated.TOO_STILL), Lag(unestimated=LagUnestimated.TOO_STILL)),
        (first, first),
        (Lag(0.205, 0.004), first),
        (Lag(unestimated=LagUnestimated.TOO_UNSURE), first),
        (Lag(0.199, 0.001), Lag(0.199, 0.001)),
        (Lag(0.3, 0.01), Lag(0.3, 0.01)),
    ):
        ahead.keep_better(lag)
        assert repr(ahead.lag) == repr(kept)


def test_a_robot_that_goes_back_is_not_looked_ahead_of():
    ahead = LookAhead(PATH)
    drive(ahead)
    for n in range(1, 61):
        back = sample(4.0 + 0.01 * n, 3.0)
        ahead.see(replace(back, position_base_mm=(40.0 - 0.2 * n, 3.0, 0.0)), True)
    assert lead_at(ahead, 4.6).way_mm == 0.0


@pytest.mark.slow
def test_looking_ahead_takes_a_torch_along_a_bent_seam_in_the_cell():
    off_mm = []
    for looks_ahead in (False, True):
        rng = np.random.default_rng(1)
        world = replace(
            draw_world(rng), slope=(-0.05, 0.0), bend_mm=1.0, bend_length_mm=120.0, speed_mm_s=10.0
        )
        cell = JudgedCell(world, rng)
        cell.tracker.poses.looks_ahead = looks_ahead
        cell.run(8.0)
        errors = np.array([error for t_s, error in cell.torch_error_mm if t_s > 4.0])
        off_mm.append(math.sqrt((errors**2).mean()))
    lag = cell.tracker.poses.look_ahead.lag
    # From the capture: exposure, computing and the bus are in it.
    true_s = world.latency_s + world.time_constant_s + 0.015
    assert abs(lag.lag_s - true_s) < 4.0 * lag.sigma_s
    assert off_mm[0] > 0.05
    assert off_mm[1] < 0.3 * off_mm[0]
