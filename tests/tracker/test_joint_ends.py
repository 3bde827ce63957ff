"""Start and end of a joint among found and missed looks: odds, false alarms, delay, stated sigma."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rendered import frame_of, pose_at, small_setup

from noise_model.surface.joint import Joint, SeamSegments
from tracker.seam.joint_ends import (
    DECIDE_MM,
    FALSE_ALARM,
    FALSE_SHARE,
    FOUND_SHARE,
    LOOK_MM,
    Change,
    JointEnds,
    nominal_ends,
)
from tracker.tracker import Tracker

RATIO = FOUND_SHARE / FALSE_SHARE
"""Of a look that finds; as the shares are 0.9 and 0.1, one that does not has one over it."""

DIVERGENCE = (FOUND_SHARE - FALSE_SHARE) * math.log(RATIO)
NOMINAL = (0.0, 400.0)


def ratios(found: Iterable[bool]) -> Iterator[float]:
    for is_found in found:
        yield RATIO if is_found else 1.0 / RATIO


@given(st.lists(st.tuples(st.floats(1.0, 4.0), st.booleans()), min_size=2, max_size=60))
def test_the_odds_are_the_sum_over_all_places(looks: list[tuple[float, bool]]) -> None:
    """Every place written out: the likelihood of what was seen if the change is there, over that of none."""
    stations = np.cumsum([step for step, _ in looks])
    log_ratio = np.array([math.log(ratio) for ratio in ratios(found for _, found in looks)])
    change = Change()
    for station, ratio in zip(stations, np.exp(log_ratio), strict=True):
        change = change.with_look(float(station), float(ratio))
    likelihood = np.exp(np.cumsum(log_ratio[::-1])[::-1])
    weights, low, high = likelihood[1:], stations[:-1], stations[1:]
    mean = np.sum(weights * (low + high) / 2.0) / weights.sum()
    second = np.sum(weights * (high**3 - low**3) / (3.0 * (high - low))) / weights.sum()
    assert change.before == pytest.approx(likelihood[0])
    assert change.odds == pytest.approx(weights.sum())
    assert change.station_mm == pytest.approx(mean)
    assert change.sigma_mm**2 == pytest.approx(second - mean**2, rel=1e-6, abs=1e-6)


def test_false_alarms_are_as_rare_as_is_stated() -> None:
    """R_n - n is a martingale: the looks until R passes a bound are on average what R then is."""
    rng, bound = np.random.default_rng(1), 60.0
    lengths, odds = [], []
    for _ in range(1500):
        change, n = Change().with_look(0.0, 1.0), 0
        while change.odds < bound:
            n += 1
            change = change.with_look(float(n), RATIO if rng.random() < FALSE_SHARE else 1.0 / RATIO)
        lengths.append(n)
        odds.append(change.odds)
    gap = np.array(odds) - lengths
    error = gap.std() / math.sqrt(len(gap))
    print(f"{np.mean(lengths):.0f} looks to a false alarm, odds {np.mean(odds):.0f}, bound {bound:.0f}")
    assert abs(gap.mean()) < 4.0 * error
    assert np.mean(lengths) > bound
    assert error < 0.1 * np.mean(lengths)


def walk(rng: np.random.Generator, at_mm: float) -> Iterator[tuple[float, bool]]:
    """Looks 1 mm apart along a joint that starts somewhere."""
    for n in range(1000):
        share = FOUND_SHARE if n >= at_mm else FALSE_SHARE
        yield float(n), bool(rng.random() < share)


def test_delay_and_place_of_a_start() -> None:
    """Wald: no later than ln(ratio / false alarm) / divergence on average; the stated sigma is honest."""
    rng = np.random.default_rng(2)
    delays, errors, alarms = [], [], 0
    for _ in range(2000):
        at_mm = float(rng.uniform(20.0, 60.0))
        change = Change()
        for station, found in walk(rng, at_mm):
            change = change.with_look(station, RATIO if found else 1.0 / RATIO)
            if change.is_decided:
                break
        assert change.is_seen
        if change.looked_mm < at_mm:
            alarms += 1
            continue
        delays.append(change.looked_mm - at_mm)
        errors.append((change.station_mm - at_mm, change.sigma_mm))
    error, sigma = np.array(errors).T
    chi2 = float(np.mean((error / sigma) ** 2))
    wald = math.log(RATIO / FALSE_ALARM) / DIVERGENCE
    print(
        f"declared after {np.mean(delays):.2f} mm (Wald's bound {wald:.2f}), rms error {error.std():.2f} mm, "
        f"mean {error.mean():.3f} mm, chi2 {chi2:.2f}, {alarms} false alarms in some 80 000 looks"
    )
    assert np.mean(delays) < wald
    assert np.mean(delays) > 0.5 * math.log(1.0 / FALSE_ALARM) / DIVERGENCE
    assert alarms <= 2000 * 60 * FALSE_ALARM + 3.0 * math.sqrt(2000 * 60 * FALSE_ALARM)
    assert abs(error.mean()) < 4.0 * error.std() / math.sqrt(len(error)) + 0.05
    assert 0.8 < chi2 < 1.25


def seen(found: Iterable[tuple[float, bool]], within_mm: float = 40.0) -> JointEnds:
    ends = JointEnds()
    for station, is_found in found:
        ends = ends.with_look(station, is_found, NOMINAL, within_mm)
    return ends


def along(start_mm: float, end_mm: float, low_mm: float, high_mm: float) -> Iterator[tuple[float, bool]]:
    for station in np.arange(low_mm, high_mm, LOOK_MM):
        yield float(station), bool(start_mm <= station < end_mm)


def test_both_ends_are_found() -> None:
    ends = seen(along(7.0, 388.0, -60.0, 460.0))
    assert ends.start.is_seen
    assert ends.end.is_seen
    assert ends.start.station_mm == pytest.approx(6.5, abs=0.2)
    assert ends.end.station_mm == pytest.approx(387.5, abs=0.2)
    assert ends.start.sigma_mm < 1.0
    assert ends.stretch_mm(NOMINAL, 40.0) == (ends.start.station_mm, ends.end.station_mm)


def test_what_is_there_from_the_first_look_has_no_start_and_is_not_ended_by_a_loss_amid() -> None:
    lost = [
        (station, found and not 150.0 < station < 250.0) for station, found in along(-99.0, 999.0, 5, 420)
    ]
    ends = seen(lost)
    assert ends.start.is_decided
    assert not ends.start.is_seen
    assert not ends.end.is_decided
    assert ends.stretch_mm(NOMINAL, 40.0) == (-40.0, 440.0)


def test_a_seam_lost_before_the_end_can_come_has_no_end_either() -> None:
    ends = seen(along(7.0, 330.0, -60.0, 460.0))
    assert ends.end.is_decided
    assert not ends.end.is_seen


def test_a_start_in_the_last_place_it_may_be_is_still_found() -> None:
    assert seen(along(40.0, 999.0, -60.0, 40.0 + DECIDE_MM)).start.is_seen
    assert not seen(along(70.0, 999.0, -60.0, 300.0)).start.is_decided


@pytest.mark.parametrize("per_look", [2, 10])
def test_a_high_frame_rate_is_no_more_evidence(per_look: int) -> None:
    looks = list(along(7.0, 999.0, -10.0, 30.0))
    often = [(station + k / per_look, found) for station, found in looks for k in range(per_look)]
    np.testing.assert_array_equal(seen(often), seen(looks))


def test_the_ends_of_the_nominal_line() -> None:
    angle = Joint("flat", {}, ((-20.0, 0.0, 0.0), (60.0, 0.0, 0.0), (60.0, 90.0, 0.0)))
    # Stations run on through the corner: 80 mm of the first segment, 90 of the second.
    assert nominal_ends(SeamSegments.of(angle)) == pytest.approx((-20.0, 150.0))
    straight = Joint("flat", {}, ((-20.0, 5.0, 1.0), (60.0, 5.0, 1.0)))
    assert nominal_ends(SeamSegments.of(straight)) == (-20.0, 60.0)


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["v_groove", "lap", "corrugation"])
def test_a_plate_without_a_joint_is_not_taken_for_one(joint: str) -> None:
    """FALSE_SHARE holds on rendered frames."""
    setup = small_setup(joint)
    plate = replace(setup, joint=replace(setup.joint, type="flat", dimensions={}))
    tracker = Tracker(setup)
    poses = [pose_at(2.3 * n) for n in range(12)]
    tracks = [tracker.step(frame_of(setup, pose, index=n, of=plate), pose) for n, pose in enumerate(poses)]
    assert sum(track.valid for track in tracks) <= FALSE_SHARE * len(tracks)


def test_a_tool_that_goes_back_looks_at_nothing_new() -> None:
    change = Change().with_look(10.0, RATIO).with_look(12.0, RATIO)
    assert change.with_look(11.0, RATIO) == change
