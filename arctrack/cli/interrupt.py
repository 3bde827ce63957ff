"""Ctrl-C and SIGTERM: what was interrupted, what is kept, and where."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
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
