"""What `benchmarks/latency.py` rests on: its frames' times, its clock, and its frames at equal error."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any, Any]:
    pytest.importorskip("skimage")
    monkeypatch.syspath_prepend(BENCHMARKS)
    return __import__("latency_worker"), __import__("latency_cases"), __import__("latency_peers")


def test_a_stretch_goes_on_by_a_tick_and_lies_where_the_approach_has_been(
    modules: tuple[Any, Any, Any],
) -> None:
    worker, cases, _ = modules
    times_s = np.array(cases.times_s())
    approach, stretches = np.split(times_s, [worker.APPROACH])
    stretches = stretches.reshape(worker.STRETCHES, worker.STRETCH)
    np.testing.assert_allclose(np.diff(stretches, axis=1), worker.PERIOD_S)
    assert (np.diff(stretches[:, 0]) > 1.0).all()
    assert approach.min() < stretches.min() - 1.0
    assert approach.max() > stretches.max()


def test_a_late_step_takes_the_next_tick(modules: tuple[Any, Any, Any]) -> None:
    worker = modules[0]
    now_s = time.perf_counter()
    tick_s = worker.wait_for_tick(now_s - 2.5 * worker.PERIOD_S)
    assert time.perf_counter() >= tick_s
    ticks = (tick_s - now_s) / worker.PERIOD_S + 2.5
    assert ticks >= 2.0
    assert ticks == pytest.approx(round(ticks))


def test_noise_is_averaged_away_and_a_bias_is_not(modules: tuple[Any, Any, Any]) -> None:
    peers = modules[2]
    noise_px = 0.4 * np.random.default_rng(0).standard_normal((peers.FRAMES, 2000))
    assert peers.spread_px(noise_px, 1) == pytest.approx(0.4, rel=0.02)
    assert peers.spread_px(noise_px, 16) == pytest.approx(0.1, rel=0.03)
    assert peers.frames_for(noise_px, 0.4 / 3.0) in (8, 9, 10)
    assert peers.frames_for(noise_px + 0.3, 0.4 / 3.0) is None
    assert peers.frames_for(noise_px, 0.5) == 1


def test_means_along_the_stripe_leave_gross_centres_out(modules: tuple[Any, Any, Any]) -> None:
    peers = modules[2]
    straight_px = 100.0 + 0.1 * np.arange(200.0)[None]
    spoiled_px = straight_px.copy()
    spoiled_px[0, ::9] += 50.0
    spoiled_px[0, 5::17] = np.nan
    reach = peers.NEIGHBOURS // 2
    inside = np.s_[:, reach:-reach]
    np.testing.assert_allclose(peers.along_the_stripe(straight_px)[inside], straight_px[inside])
    np.testing.assert_allclose(peers.along_the_stripe(spoiled_px)[inside], straight_px[inside], atol=0.2)
