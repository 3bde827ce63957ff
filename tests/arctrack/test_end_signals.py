"""Ctrl-C and SIGTERM wait for a safe point, and come behind the block as they would have."""

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from arctrack.end_signals import ENDING, ends_at_safe_points

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(params=ENDING)
def number(request: pytest.FixtureRequest) -> Iterator[signal.Signals]:
    """Give a signal whose handler is Python's for Ctrl-C meanwhile."""
    before = signal.signal(request.param, signal.default_int_handler)
    yield request.param
    assert signal.signal(request.param, before) is signal.default_int_handler


def test_a_signal_waits_for_the_next_safe_point(number: signal.Signals) -> None:
    reached = []

    def run() -> None:
        with ends_at_safe_points() as check:
            check()
            signal.raise_signal(number)
            reached.append("behind the signal")
            check()
            reached.append("behind the safe point")

    with pytest.raises(KeyboardInterrupt):
        run()
    assert reached == ["behind the signal"]


def test_a_signal_behind_the_last_safe_point_is_not_lost(number: signal.Signals) -> None:
    reached = []

    def run() -> None:
        with ends_at_safe_points():
            signal.raise_signal(number)
            reached.append("behind the signal")

    with pytest.raises(KeyboardInterrupt):
        run()
    assert reached


def test_a_second_signal_does_not_wait(number: signal.Signals) -> None:
    reached = []

    def run() -> None:
        with ends_at_safe_points():
            signal.raise_signal(number)
            reached.append("behind the first")
            signal.raise_signal(number)
            reached.append("behind the second")

    with pytest.raises(KeyboardInterrupt):
        run()
    assert reached == ["behind the first"]


def test_without_a_signal_nothing_happens(number: signal.Signals) -> None:
    with ends_at_safe_points() as check:
        check()
    with pytest.raises(OSError, match="the disk is gone"), ends_at_safe_points():
        raise OSError("the disk is gone")


def test_what_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with ends_at_safe_points() as check:
            signal.raise_signal(signal.SIGINT)
            check()
    finally:
        signal.signal(signal.SIGINT, before)


INTERRUPTED = """
import random
import signal
import time
from typing import NamedTuple

import numpy as np

from noise_model.compiled.kernel import kernel


class Point(NamedTuple):
    x: float
    y: float


class Line(NamedTuple):
    first: Point
    second: Point
    values: np.ndarray


@kernel(allocates=True)
def slow(value):
    values = np.full(3, value)
    for n in range(100_000):
        values[n % 3] = np.sqrt(values[n % 3] + n)
    return Line(Point(value, values[0]), Point(values[1], value), values)


slow(1.0)
signal.signal(signal.SIGALRM, signal.default_int_handler)
rng, interrupts = random.Random(1), 0
ends_s = time.monotonic() + 1.0
while time.monotonic() < ends_s:
    try:
        signal.setitimer(signal.ITIMER_REAL, rng.uniform(1e-3, 4e-3))
        while True:
            slow(1.0)
    except KeyboardInterrupt:
        interrupts += 1
print(interrupts)
"""


@pytest.mark.slow
def test_a_signal_in_a_kernel_is_an_interrupt_of_its_caller() -> None:
    """A kernel that runs nearly all the time: the signal comes while numba makes its result."""
    arguments = [sys.executable, "-c", INTERRUPTED]
    finished = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)
    assert finished.returncode == 0, finished.stderr
    assert int(finished.stdout) > 10


@pytest.mark.slow
def test_numba_itself_still_crashes() -> None:
    """The report's own lines, plain numba: once it ends well, arctrack's own way to make results may go."""
    page = (ROOT / "docs/explanation/interrupts.md").read_text()
    program = page.partition("```{code-block} python\n")[2].partition("```")[0]
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False, timeout=120)
    assert finished.returncode == -signal.SIGSEGV


def test_in_another_thread_signals_stay_with_the_main_one() -> None:
    handlers = []

    def hold() -> None:
        with ends_at_safe_points() as check:
            check()
            handlers.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=hold)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGINT)]


def test_sigterm_ends_a_process_that_has_no_handler_of_its_own() -> None:
    code = (
        "import signal\n"
        "from arctrack.end_signals import ends_at_safe_points\n"
        "with ends_at_safe_points():\n"
        "    signal.raise_signal(signal.SIGTERM)\n"
        "    print('closed', flush=True)\n"
        "print('went on')\n"
    )
    finished = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=False)
    assert finished.returncode == -signal.SIGTERM
    assert finished.stdout == b"closed\n"
