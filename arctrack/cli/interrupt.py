"""Signals that end a command: what they interrupted, what is kept, and where; or a run that they end well."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from arctrack.end_signals import ENDING, is_ignored


class InterruptedCommandError(Exception):
    """A command that Ctrl-C, SIGTERM or SIGHUP ended; its text says what was interrupted and what is kept."""


@contextmanager
def interruptible(what: str, kept: str) -> Iterator[None]:
    """Print, where Ctrl-C, SIGTERM or SIGHUP ends the block, what it was and what is kept."""
    # Signals are the main thread's: in another one they end the process as before.
    is_main = threading.current_thread() is threading.main_thread()
    before = {
        number: signal.signal(number, signal.default_int_handler)
        for number in ENDING
        if is_main and number != signal.SIGINT and not is_ignored(number)
    }
    try:
        yield
    except KeyboardInterrupt:
        raise InterruptedCommandError(f"{what} interrupted; {kept}") from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def lost_interrupts() -> Iterator[list[BaseException | None]]:
    """Give the list of Ctrl-C that Python drops: those that come in a callback of LLVM's, or in a finaliser.

    What LLVM compiles is missing then, and numba fails over it.
    """
    lost: list[BaseException | None] = []
    tell = sys.unraisablehook

    def note(unraisable: sys.UnraisableHookArgs) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            lost.append(unraisable.exc_value)
        else:
            tell(unraisable)

    sys.unraisablehook = note
    try:
        yield lost
    finally:
        sys.unraisablehook = tell


@contextmanager
def stoppable(*others: signal.Signals) -> Iterator[Callable[[], set[signal.Signals]]]:
    """Yield a function that returns the signals since its last call; the block is not interrupted.

    The signals are those that end a run, and others that are named. A run under nohup goes on without its
    terminal.
    """
    came: set[signal.Signals] = set()

    def take() -> set[signal.Signals]:
        taken = came.copy()
        came.difference_update(taken)
        return taken

    before = {
        number: signal.signal(number, lambda which, _: came.add(signal.Signals(which)))
        for number in {*ENDING, *others}
        if number == signal.SIGINT or not is_ignored(number)
    }
    try:
        yield take
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
