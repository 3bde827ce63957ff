"""What is remembered of the seam from frame to frame, through jumps and back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered import small_setup

from tracker import flags
from tracker.checks import FrameChecks
from tracker.judge import JUMPS_TO_RELEARN, jump_limit_mm, jump_of, remember
from tracker.seam.gaussian_process import MAX_STRETCHES, NO_HISTORY, SeamHistory, stretch_at
from tracker.seam.locate import SeamSource
from tracker.tracker_state import TrackerMemory

seeds = st.integers(0, 2**32 - 1)
VARIANCE_MM2 = (1e-4, 4e-4)
SOURCE = SeamSource.of(small_setup("v_groove"))


def drawn_history(rng: np.random.Generator, first_mm: float, n: int) -> SeamHistory:
    history = SeamHistory()
    for k in range(n):
        history = history.with_measurement(first_mm + 2.0 * k, rng.normal(size=2), VARIANCE_MM2)
    return history


def same(history: SeamHistory, other: SeamHistory) -> bool:
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(history, other, strict=True))


def plain_stretch(stretches: list[SeamHistory], station_mm: float) -> int:
    """Which of the stretches, the present one first, then back in time, a station lies on."""
    spans = [(h.stations_mm.min(), h.stations_mm.max()) if h.n else (math.nan, math.nan) for h in stretches]
    measured = [i for i, (low, high) in enumerate(spans) if low <= station_mm <= high]
    if measured:
        return measured[0]
    for i in range(len(spans) - 1):
        if station_mm >= 0.5 * (spans[i + 1][1] + spans[i][0]):
            return i
    return len(spans) - 1


@settings(deadline=None, max_examples=60)
@given(seeds, st.integers(0, 4), st.floats(-20.0, 220.0))
def test_a_station_lies_on_the_latest_stretch_that_measured_it(seed: int, k: int, station_mm: float) -> None:
    rng = np.random.default_rng(seed)
    past = [drawn_history(rng, 40.0 * i + rng.uniform(0.0, 15.0), 6) for i in range(k)]
    present = drawn_history(rng, 40.0 * k, rng.integers(0, 6))
    stretches = [present, *reversed(past)]
    stretch, is_present = stretch_at(present, past, station_mm)
    i = plain_stretch(stretches, station_mm) if past else 0
    assert same(stretch, stretches[i])
    assert is_present == (i == 0)


def remembered(
    places_mm: list[tuple[float, float]], state: TrackerMemory
) -> tuple[TrackerMemory, list[bool]]:
    """Return the state after frames that show a seam at (station, y), and which of them jumped."""
    jumped = []
    for station_mm, y_mm in places_mm:
        frame_checks = FrameChecks()
        state = remember(frame_checks, SOURCE, state, station_mm, (y_mm, 0.0), VARIANCE_MM2)
        state = state._replace(frames=state.frames + 1)
        jumped.append(bool(frame_checks.flags & flags.SEAM_JUMP.mask))
    return state, jumped


STRAIGHT = [(1.5 * n, 0.0) for n in range(10)]


def test_a_rim_that_shows_for_some_frames_moves_no_seam() -> None:
    """Two jumps to one place, then two to others, then the seam again."""
    before, _ = remembered(STRAIGHT, TrackerMemory())
    state, jumped = remembered([(15.0, 3.0), (16.5, 3.0), (18.0, -3.0), (19.5, 2.0)], before)
    assert all(jumped)
    assert same(state.history, before.history)
    assert (state.jumps, state.beyond.n) == (1, 1)
    state, jumped = remembered([(21.0, 0.0)], state)
    assert jumped == [False]
    assert (state.history.n, state.jumps, state.beyond.n) == (11, 0, 0)


def test_a_doubtful_new_seam_is_one_once_a_second_frame_shows_it_there() -> None:
    state, confirmed = TrackerMemory(), []
    for station_mm, y_mm in ((0.0, 3.0), (1.0, -2.0), (2.0, -2.0), (3.0, -2.0)):
        frame_checks = FrameChecks()
        state = remember(frame_checks, SOURCE, state, station_mm, (y_mm, 0.0), VARIANCE_MM2, True)
        confirmed.append(not frame_checks.flags & flags.JOINT_NOT_FOUND.mask)
    assert confirmed == [False, False, True, True]
    assert (state.history.n, state.beyond.n) == (3, 0)
    assert state.history.point_at(2.0).displacement_mm[0] == pytest.approx(-2.0, abs=0.01)


def test_a_seam_that_goes_on_elsewhere_is_learned_anew() -> None:
    before, _ = remembered(STRAIGHT, TrackerMemory(lost=4))
    assert before.lost == 0
    state, jumped = remembered([(15.0 + n, 3.0) for n in range(JUMPS_TO_RELEARN)], before)
    assert all(jumped)
    assert (state.jumps, state.beyond.n, state.history.n) == (0, 0, JUMPS_TO_RELEARN)
    (behind,) = state.behind
    assert same(behind, before.history)


def test_jumps_over_too_short_a_way_or_too_seldom_are_no_new_seam() -> None:
    before, _ = remembered(STRAIGHT, TrackerMemory())
    state, _ = remembered([(15.0 + 0.1 * n, 3.0) for n in range(8)], before)
    assert same(state.history, before.history)
    # Every third frame of the last shows the joint there, the others show none.
    seldom = before
    for n in range(4):
        seldom, _ = remembered([(15.0 + 3.0 * n, 3.0)], seldom._replace(frames=seldom.frames + 2))
    assert same(seldom.history, before.history)


@given(st.floats(0.0, 1.0), st.floats(0.0, 0.1), st.floats(-5.0, 5.0))
def test_how_far_a_seam_may_lie_is_five_sigmas_of_the_difference(
    sigma_mm: float, variance_mm2: float, y_mm: float
) -> None:
    assert jump_limit_mm(sigma_mm, variance_mm2) == pytest.approx(
        max(5.0 * math.hypot(sigma_mm, variance_mm2**0.5), 0.3)
    )
    history = NO_HISTORY.with_measurement(0.0, (0.5, 0.5), VARIANCE_MM2)
    (away_y_mm, _), _ = jump_of(SOURCE, history, 0.0, (y_mm, 0.0), VARIANCE_MM2)
    assert away_y_mm == abs(y_mm - history.point_at(0.0).displacement_mm[0])


def test_the_latest_stretches_alone_are_remembered() -> None:
    state = TrackerMemory()
    for k in range(MAX_STRETCHES + 3):
        places = [(10.0 * k + n, 3.0 * (-1) ** k) for n in range(JUMPS_TO_RELEARN + 1)]
        state, _ = remembered(places, state)
    assert len(state.behind) == MAX_STRETCHES
    assert state.behind[-1].stations_mm[-1] == 10.0 * (MAX_STRETCHES + 1) + JUMPS_TO_RELEARN
