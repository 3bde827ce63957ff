"""Ctrl-C and SIGTERM: what was interrupted, what is kept, and where; or a run that they end as it should."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


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
def stoppable() -> Iterator[Callable[[], bool]]:
    """Give what says whether Ctrl-C or SIGTERM has asked what runs within to end; nothing is interrupted."""
    asked = threading.Event()
    before = {
        number: signal.signal(number, lambda *_: asked.set()) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
