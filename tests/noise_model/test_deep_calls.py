"""However deep calls go, none of them takes memory from the operating system each time."""

import gc
import resource

import pytest

from noise_model.compiled.deep_calls import RARELY, call_with_room

LEVELS, CALLS = 300, 200
"""So many levels of short calls fill several chunks of 16 kB."""


def page_faults_by_level(level: int, faults: list[int]) -> list[int]:
    """Return how many new pages of memory CALLS calls took at each level."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(CALLS):
        do_nothing(level)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    return page_faults_by_level(level + 1, faults) if level < LEVELS else faults


def do_nothing(level: int) -> None:
    return None


def test_no_level_of_deep_calls_takes_memory_at_each_call() -> None:
    faults = call_with_room(page_faults_by_level, 0, [])
    assert max(faults) < CALLS // 2


def test_what_a_function_returns_or_raises_comes_through() -> None:
    assert call_with_room(divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        call_with_room(divmod, 7, 0)


def test_the_collector_looks_as_often_as_before_once_a_kernel_is_compiled() -> None:
    before = gc.get_threshold()
    assert call_with_room(gc.get_threshold) == RARELY
    with pytest.raises(ZeroDivisionError):
        call_with_room(divmod, 7, 0)
    assert gc.get_threshold() == before
