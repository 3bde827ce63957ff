"""The process of a live run: scheduling, watchdog, latency, and what else it says of itself."""

from __future__ import annotations

import gc
import math
import os
import subprocess
import sys
import textwrap
from dataclasses import astuple

import numpy as np
import pytest

from arctrack.control.cell_file import ProcessChoice
from arctrack.live.serve.latency import LatencyCounts
from arctrack.live.serve.process import garbage_left, schedule

HANGS = """
    import time
    from arctrack.live.serve.process import Watchdog
    with Watchdog(1.0) as watchdog:
        ends_s = time.monotonic() + 1.5
        while time.monotonic() < ends_s:
            watchdog.feed()
            time.sleep(0.01)
        print("fed", flush=True)
        time.sleep(600.0)
"""


def test_what_the_machine_allows_is_set_and_what_not_is_said() -> None:
    before = os.sched_getaffinity(0)
    cpu = min(before)
    try:
        assert schedule(ProcessChoice(cpus=(cpu,))) == ([f"[process] cpus = [{cpu}]: set"], [])
        assert os.sched_getaffinity(0) == {cpu}
    finally:
        os.sched_setaffinity(0, before)
    done, refused = schedule(ProcessChoice(cpus=(4095,)))
    assert done == []
    (line,) = refused
    assert line.startswith("[process] cpus = [4095]: ")
    assert str(sorted(before)) in line
    assert schedule(ProcessChoice()) == ([], [])


@pytest.mark.slow
def test_a_process_that_hangs_is_ended_and_says_where() -> None:
    words = [sys.executable, "-c", textwrap.dedent(HANGS)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.stdout == "fed\n"
    assert done.returncode == 1
    assert "Timeout" in done.stderr
    assert 'File "<string>", line 10' in done.stderr


def test_no_garbage_is_collected_meanwhile() -> None:
    with garbage_left():
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize("middle_s", [0.0004, 0.01, 0.4, 1.7, 60.0])
def test_quantiles_of_latencies_are_true_to_a_hundredth_however_long_they_are(middle_s) -> None:
    took_s = middle_s * np.exp(0.7 * np.random.default_rng(1).standard_normal(5000))
    counts = LatencyCounts()
    for each_s in took_s:
        counts.add(float(each_s))
    quantiles = counts.quantiles()
    true_ms = 1000.0 * np.quantile(took_s, [0.5, 0.99, 0.999], method="inverted_cdf")
    found_ms = np.array([quantiles.p50_ms, quantiles.p99_ms, quantiles.p999_ms])
    assert (found_ms >= true_ms - 1e-9).all()
    assert (found_ms <= np.maximum(1.01 * true_ms, true_ms + 0.1)).all()
    assert quantiles.max_ms == 1000.0 * took_s.max()


def test_latencies_are_counted_to_a_bin() -> None:
    counts = LatencyCounts()
    assert all(map(math.isnan, astuple(counts.quantiles())))
    assert str(counts.quantiles()) == "none"
    for n in range(100):
        counts.add(0.001 * (n + 0.55))
    counts.add(7.0)
    quantiles = counts.quantiles()
    assert counts.up_to_buckets() == (5, 10, 20, 50, 100, 100, 100, 100, 100, 100, 101, 101, 101)
    assert counts.sum_s == pytest.approx(0.001 * (4950 + 55) + 7.0)
    assert quantiles.p50_ms == pytest.approx(50.6, abs=0.1)
    assert quantiles.p99_ms == pytest.approx(99.6, abs=0.1)
    assert quantiles.max_ms == 7000.0
    few = LatencyCounts()
    few.add(0.00112)
    assert few.quantiles().p99_ms == few.quantiles().max_ms == pytest.approx(1.12)
