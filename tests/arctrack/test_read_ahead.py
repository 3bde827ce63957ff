"""Frames are read ahead in a thread: nothing changes but who waits."""

import threading
from collections.abc import Generator
from pathlib import Path

import pytest

from arctrack.recording import read_recording
from arctrack.recording.ahead import ITEMS_AHEAD, read_ahead


def threads_ahead() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "frames ahead"]


def test_what_is_taken_is_what_the_generator_yields() -> None:
    with read_ahead(n * n for n in range(100)) as items:
        assert list(items) == [n * n for n in range(100)]
        assert list(items) == []
    with read_ahead(n for n in ()) as items:
        assert list(items) == []


def test_an_error_comes_behind_the_items_before_it() -> None:
    def three_then_none() -> Generator[int, None, None]:
        yield from range(3)
        raise OSError("the disk is gone")

    taken: list[int] = []
    with pytest.raises(OSError, match="the disk is gone"), read_ahead(three_then_none()) as items:
        taken.extend(items)
    assert taken == [0, 1, 2]
    assert not threads_ahead()


@pytest.mark.parametrize("end", [KeyboardInterrupt, ValueError, None])
def test_the_thread_ends_with_who_takes(end: type[BaseException] | None) -> None:
    given: list[int] = []
    closed = threading.Event()

    def endless() -> Generator[int, None, None]:
        try:
            while True:
                given.append(len(given))
                yield given[-1]
        finally:
            closed.set()

    def take() -> None:
        with read_ahead(endless()) as items:
            assert [next(items) for _ in range(5)] == list(range(5))
            assert len(threads_ahead()) == 1
            if end is not None:
                raise end

    if end is None:
        take()
    else:
        with pytest.raises(end):
            take()
    assert closed.is_set()
    assert not threads_ahead()
    assert len(given) <= 5 + ITEMS_AHEAD


def test_nothing_is_read_far_ahead() -> None:
    given = 0
    is_full = threading.Event()

    def counted() -> Generator[int, None, None]:
        nonlocal given
        for n in range(10 * ITEMS_AHEAD):
            given += 1
            if given == ITEMS_AHEAD:
                is_full.set()
            yield n

    with read_ahead(counted()) as items:
        assert is_full.wait(10.0)
        assert given == ITEMS_AHEAD
        assert len(list(items)) == 10 * ITEMS_AHEAD


def test_a_recordings_frames_come_as_they_do_without(recording: Path) -> None:
    read = read_recording(recording)
    with read_ahead(read.frames()) as frames:
        for frame, alone in zip(frames, read.frames(), strict=True):
            assert frame.index == alone.index
            assert (frame.image_dn == alone.image_dn).all()
