"""What is remembered of the seam from frame to frame, against the same by lists."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tracker import flags
from tracker.checks import Asked
from tracker.seam.gaussian_process import NO_HISTORY, SeamHistory
from tracker.seam.locate import Located
from tracker.seam.stretches import (
    JUMP_FLOOR_MM,
    JUMP_SIGMAS,
    JUMPS_TO_RELEARN,
    MAX_STRETCHES,
    RELEARN_MM,
    RELEARN_SHARE,
    PastStretches,
    SeenSeam,
    Stretches,
    aways,
    followed,
    history_at,
)

seeds = st.integers(0, 2**32 - 1)
VARIANCE_MM2 = (1e-4, 4e-4)


def drawn_history(rng: np.random.Generator, first_mm: float, n: int) -> SeamHistory:
    history = SeamHistory()
    for k in range(n):
        history = history.with_measurement(first_mm + 2.0 * k, rng.normal(size=2), VARIANCE_MM2)
    return history


def same(history: SeamHistory, other: SeamHistory) -> bool:
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(history, other, strict=True))


def test_stretches_are_kept_one_by_one() -> None:
    rng = np.random.default_rng(0)
    histories = [drawn_history(rng, 40.0 * i, 3 + i) for i in range(MAX_STRETCHES + 3)]
    kept = PastStretches.of(histories).histories
    assert len(kept) == MAX_STRETCHES
    assert all(map(same, kept, histories[-MAX_STRETCHES:]))


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
    stretch, is_present = history_at(present, PastStretches.of(past), station_mm)
    i = plain_stretch(stretches, station_mm) if past else 0
    assert same(stretch, stretches[i])
    assert is_present == (i == 0)


def plain_followed(before: Stretches, n: int, seen: SeenSeam) -> tuple[Stretches, bool]:
    """What is remembered after a frame, and whether its seam jumps, by the records' own methods."""
    history, station = before.history, seen.located.station_mm
    place = seen.located.displacement_mm

    def is_beyond(stretch: SeamHistory) -> bool:
        there = stretch.point_at(station)
        off = np.abs(np.subtract(place, there.displacement_mm))
        most = JUMP_SIGMAS * np.sqrt(np.square(there.sigma_mm) + seen.variance_mm2)
        return bool((off > np.maximum(most, JUMP_FLOOR_MM)).any())

    jumped = history.n > 0 and is_beyond(history)
    if not jumped:
        after = history.with_measurement(station, place, seen.variance_mm2)
        return Stretches(after, NO_HISTORY, before.behind, 0, before.jumped_at, 0), False
    jumps, beyond = before.jumps + 1, before.beyond
    if is_beyond(beyond):
        jumps, beyond = 1, NO_HISTORY
    since = n if jumps == 1 else before.jumped_at
    beyond = beyond.with_measurement(station, place, seen.variance_mm2)
    goes_on = jumps >= JUMPS_TO_RELEARN and abs(station - beyond.stations_mm[0]) >= RELEARN_MM
    if not goes_on or jumps / (1 + n - since) < RELEARN_SHARE:
        return Stretches(history, beyond, before.behind, jumps, since, before.lost), True
    past = [*before.behind.histories, history] if history.n >= JUMPS_TO_RELEARN else before.behind.histories
    return Stretches(beyond, NO_HISTORY, PastStretches.of(past), 0, since, 0), True


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_a_seam_is_remembered_as_its_twin_remembers_it(seed: int) -> None:
    """A seam that steps aside now and then, and is lost at times."""
    rng = np.random.default_rng(seed)
    stretches = twin = Stretches(NO_HISTORY, NO_HISTORY, PastStretches(), 0, 0, 0)
    station, place = 0.0, np.zeros(2)
    for n in range(1, 60):
        station += rng.uniform(0.2, 1.5)
        if rng.random() < 0.06:
            place = rng.normal(0.0, 2.0, 2)
        if rng.random() < 0.15:
            continue
        shown = place + rng.normal(0.0, 0.01, 2) + (rng.random() < 0.1) * rng.normal(0.0, 2.0, 2)
        located = Located((0.0, 0.0, 0.0), station, (float(shown[0]), float(shown[1])), (0.0, 0.0))
        away_mm, limit_mm = aways(stretches.history.point_at(station), located.displacement_mm, VARIANCE_MM2)
        after = stretches.history.with_measurement(station, shown, VARIANCE_MM2)
        seen, asked = SeenSeam(located, VARIANCE_MM2, away_mm, limit_mm, after), Asked.nothing()
        stretches = followed(asked, stretches, n, seen)
        twin, jumps = plain_followed(twin, n, seen)
        assert bool(asked.flags & flags.SEAM_JUMP.mask) == jumps
        assert stretches[3:] == twin[3:]
        assert same(stretches.history, twin.history)
        assert same(stretches.beyond, twin.beyond)
        assert len(stretches.behind.ends) == len(twin.behind.ends)
        assert all(map(same, stretches.behind.histories, twin.behind.histories))
