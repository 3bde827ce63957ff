"""Ctrl-C and SIGTERM: what was interrupted, what is kept, and where; or a run that they end as it should."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from arctrack.safe_points import ENDING


class InterruptedCommandError(Exception):
    """A command that Ctrl-C or SIGTERM ended; its text says what was interrupted and what is kept."""


@contextmanager
def interruptible(what: str, kept: str) -> Iterator[None]:
    """Say of what runs within, where Ctrl-C or SIGTERM ends it, what it was and what is kept."""
    # Signals are the main thread's: in another one SIGTERM ends the process as before.
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, signal.default_int_handler) if is_main else None
    try:
        yield
    except KeyboardInterrupt:
        raise InterruptedCommandError(f"{what} interrupted; {kept}") from None
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)


@contextmanager
def stoppable(*others: signal.Signals) -> Iterator[Callable[[], set[signal.Signals]]]:
    """Give what says which signals came since it was asked last; nothing that runs within is interrupted.

    The signals are Ctrl-C's, SIGTERM, and others that are named.
    """
    came: set[signal.Signals] = set()

    def take() -> set[signal.Signals]:
        taken = came.copy()
        came.difference_update(taken)
        return taken

    before = {
        number: signal.signal(number, lambda which, _: came.add(signal.Signals(which)))
        for number in (*ENDING, *others)
    }
    try:
        yield take
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
