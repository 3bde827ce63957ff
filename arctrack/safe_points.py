"""Ctrl-C and SIGTERM where a run may end: between two frames, not inside one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = (signal.SIGINT, signal.SIGTERM)
"""What ends a run."""


@contextmanager
def ends_at_safe_points() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C and SIGTERM back until what runs within may end, and give what it asks then.

    A KeyboardInterrupt may otherwise come between any two lines: in a message that is half sent, or in a file
    that is half closed. A second signal does not wait, for the first may be held back by a disk that hangs.
    Behind the block the signal comes as if it had not been held back. In another thread than the main one
    nothing is held back, for signals are the main one's.

    Yields
    ------
    callable
        Raises KeyboardInterrupt if a signal came.
    """
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        came.append(number)
        if len(came) > 1:
            raise KeyboardInterrupt

    def check() -> None:
        if came:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    # What a shell starts in the background ignores Ctrl-C, and None is a handler that Python does not know.
    before = {number: signal.getsignal(number) for number in ENDING}
    held = {number: was for number, was in before.items() if was not in (signal.SIG_IGN, None)}
    for number in held:
        signal.signal(number, note)
    try:
        yield check
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
