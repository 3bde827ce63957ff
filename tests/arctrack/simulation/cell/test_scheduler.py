from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arctrack.simulation.cell.scheduler import Scheduler


@given(st.lists(st.floats(0.0, 10.0), max_size=30))
def test_all_happens_in_order_of_its_time_and_of_asking(times_s):
    scheduler, done = Scheduler(), []
    for n, time_s in enumerate(times_s):
        scheduler.at(time_s, lambda n=n: done.append((scheduler.now_s, n)))
    scheduler.run(10.0)
    assert done == sorted((time_s, n) for n, time_s in enumerate(times_s))


def test_what_is_over_happens_at_once_and_what_is_not_due_waits():
    scheduler, done = Scheduler(), []
    scheduler.at(2.0, lambda: scheduler.at(1.0, lambda: done.append(scheduler.now_s)))
    scheduler.at(3.0, lambda: done.append(scheduler.now_s))
    scheduler.run(2.5)
    assert done == [2.0]
    assert scheduler.now_s == 2.5


def test_a_period_does_not_drift():
    scheduler, times_s = Scheduler(), []
    scheduler.every(0.1, lambda: times_s.append(scheduler.now_s), 0.05)
    scheduler.run(100.0)
    assert times_s == pytest.approx([0.05 + 0.1 * n for n in range(1000)], abs=1e-9)
