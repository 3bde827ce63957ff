from __future__ import annotations

import pytest

from robot_io.clocks.bus_clock import BusClock

START_S = 1.7e9
"""When the adapter's clock was 0, Unix time."""


def test_a_frame_that_waited_keeps_its_own_time():
    clock = BusClock()
    delays_s = (0.004, 0.0, 0.15, 0.14, 0.13, 0.0)
    times_s = [
        clock.wall_s(100.0 + 0.02 * n, START_S + 100.0 + 0.02 * n + delay_s)
        for n, delay_s in enumerate(delays_s)
    ]
    assert times_s[1:] == pytest.approx([START_S + 100.0 + 0.02 * n for n in range(1, 6)], abs=1e-6)


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_clocks_that_drift_apart_are_compared_anew(drift):
    clock = BusClock()
    for n in range(50 * 3600):
        at_s = 0.02 * n
        wall_s = clock.wall_s((1.0 + drift) * at_s, START_S + at_s)
        assert abs(wall_s - START_S - at_s) < 0.0025


def test_an_adapter_that_starts_anew():
    clock = BusClock()
    clock.wall_s(5000.0, START_S + 5000.0)
    assert clock.wall_s(0.5, START_S + 5003.0) == START_S + 5003.0


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_after_a_long_silence_nothing_old_counts(drift):
    clock = BusClock()
    clock.wall_s(0.0, START_S)
    assert clock.wall_s((1.0 + drift) * 7200.0, START_S + 7200.0) == pytest.approx(START_S + 7200.0, abs=1e-6)
