"""What kernels return: the same objects as from Python, and whole however a signal comes."""

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from noise_model.arrays import Float64
from noise_model.kernel import kernel

ROOT = Path(__file__).resolve().parents[2]


class Inner(NamedTuple):
    """Two of a kind: numba has another type for it than for `Outer`."""

    first: float
    second: float


class Outer(NamedTuple):
    """Named tuples in a tuple in a named tuple, and an array."""

    inner: Inner
    count: int
    pair: tuple[bool, Inner]
    values: Float64


@kernel(allocates=True)
def nested(value: float) -> Outer:
    """Return something of everything."""
    return Outer(Inner(value, 2.0), 3, (value > 0.0, Inner(1.0, value)), np.full(3, value))


@kernel
def given(values: Float64) -> tuple[Float64, Inner]:
    """Return an array that the caller made."""
    values[0] = 5.0
    return values, Inner(values[0], values[1])


@kernel(allocates=True)
def slow(value: float) -> Outer:
    """Take some 0.1 ms, and return what `nested` does."""
    values = np.full(3, value)
    for n in range(100_000):
        values[n % 3] = np.sqrt(values[n % 3] + n)
    return Outer(Inner(value, values[0]), 3, (True, Inner(1.0, value)), values)


def test_what_a_kernel_returns_is_what_python_would_make() -> None:
    result, plain = nested(0.5), nested.py_func(0.5)  # type: ignore[attr-defined]
    assert result[:3] == plain[:3]
    assert type(result) is Outer
    assert type(result.inner) is type(result.pair[1]) is Inner
    assert type(result.values) is np.ndarray
    np.testing.assert_array_equal(result.values, plain.values)


def test_an_array_that_was_given_comes_back_itself() -> None:
    values = np.zeros(2)
    back, inner = given(values)
    assert back is values
    assert inner == Inner(5.0, 0.0)


def test_no_reference_to_a_class_stays_behind() -> None:
    nested(0.5)
    classes = (Inner, Outer, np.ndarray, tuple)
    before = [sys.getrefcount(class_) for class_ in classes]
    for _ in range(1000):
        nested(0.5)
    grown = [sys.getrefcount(class_) - count for class_, count in zip(classes, before, strict=True)]
    assert max(grown) < 100


INTERRUPTED = """
import random
import signal

from tests.noise_model.test_boxing import slow

def interrupt(number, frame):
    raise KeyboardInterrupt

slow(1.0)
signal.signal(signal.SIGALRM, interrupt)
rng, interrupts = random.Random(1), 0
while interrupts < 100:
    try:
        signal.setitimer(signal.ITIMER_REAL, rng.uniform(1e-3, 4e-3))
        while True:
            slow(1.0)
    except KeyboardInterrupt:
        interrupts += 1
"""


@pytest.mark.slow
def test_a_signal_in_a_kernel_is_an_interrupt_of_its_caller() -> None:
    """A kernel that runs nearly all the time: the signal waits for what makes its result."""
    arguments = [sys.executable, "-c", INTERRUPTED]
    finished = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)
    assert finished.returncode == 0, finished.stderr
