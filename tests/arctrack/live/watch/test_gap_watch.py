"""A change of the map's misfit is told soon, from where it began, and seldom where there is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from arctrack.live.watch.process import GapPolicy, GapWatch
from tracker.state import Track

RATE_HZ = 10.0


def blocks(count: int, rng: np.random.Generator, rho: float = 0.3) -> np.ndarray:
    """Return ln(misfit) of blocks that neighbours share `rho` of, with 1 sigma 0.1 about misfit 1."""
    noise = rng.normal(size=count)
    for n in range(1, count):
        noise[n] = rho * noise[n - 1] + math.sqrt(1.0 - rho**2) * noise[n]
    return 0.1 * noise


def watched(levels: np.ndarray) -> list[tuple[bool, float]]:
    """Let a watch see blocks of ten frames."""
    watch, seen = GapWatch(), []
    for block, level in enumerate(levels):
        for n in range(10):
            watch.see(Track(n, block + n / RATE_HZ, 0, map_misfit=math.exp(level)))
        seen.append((watch.is_gap, watch.since_s))
    return seen


@pytest.mark.parametrize("size", [0.4, 0.8])
def test_a_change_is_told_soon_and_from_where_it_began(size: float) -> None:
    delays, starts = [], []
    for seed in range(20):
        levels = blocks(120, np.random.default_rng(seed))
        levels[60:] += size
        seen = watched(levels)
        first = next(n for n, (is_gap, _) in enumerate(seen) if is_gap)
        assert first >= 60
        delays.append(first - 60)
        starts.append(seen[first][1] - 60.0)
    # A block is judged once the next one has begun.
    assert np.median(delays) <= 8
    assert np.abs(np.median(starts)) <= 2.0


def test_no_change_is_told_in_a_day() -> None:
    seen = watched(blocks(40_000, np.random.default_rng(1)))
    assert not any(is_gap for is_gap, _ in seen)


def test_what_the_map_states_is_no_gap_however_it_changes() -> None:
    levels = blocks(90, np.random.default_rng(2)) - 1.5
    levels[45:] += 1.0
    assert not any(is_gap for is_gap, _ in watched(levels))


def test_a_map_that_is_wrong_from_the_start_is_told() -> None:
    seen = watched(blocks(30, np.random.default_rng(3)) + 1.0)
    assert seen[-1][0]
    assert seen[-1][1] <= 2.0


def test_what_was_accepted_is_no_gap_and_a_change_from_there_is() -> None:
    watch, told = GapWatch(), []
    levels = blocks(180, np.random.default_rng(5)) + 0.5
    levels[120:] += 0.8
    for block, level in enumerate(levels):
        for n in range(10):
            watch.see(Track(n, block + n / RATE_HZ, 0, map_misfit=math.exp(level)))
        if block == 50:
            assert watch.is_gap
            watch.accept()
        told.append(watch.is_gap)
    assert not any(told[50:120])
    assert told[130]
    assert watch.since_s == pytest.approx(120.0, abs=3.0)


@pytest.mark.parametrize("alike", [0.3, 0.6])
def test_runs_whose_blocks_are_alike_tell_none(alike: float) -> None:
    # What half a minute tells of a level is off by half a sigma then: learned for ever it told some.
    for run in range(5):
        levels = math.log(1.15) + blocks(2000, np.random.default_rng([7, run]), alike)
        assert not any(is_gap for is_gap, _ in watched(levels))


def test_a_gap_that_goes_is_over() -> None:
    levels = blocks(200, np.random.default_rng(4))
    levels[40:60] += 0.8
    seen = watched(levels)
    assert seen[59][0]
    assert not seen[-1][0]
    assert math.isnan(seen[-1][1])


def test_frames_without_a_misfit_say_nothing() -> None:
    watch = GapWatch(GapPolicy())
    for misfit in (math.nan, math.inf, 0.0):
        watch.see(Track(0, 0.0, 0, map_misfit=misfit))
    assert math.isnan(watch.misfit)
    assert not watch.is_gap
