"""Signals that end a run, and where it may end: between two frames, not inside one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


def _known(*names: str) -> tuple[signal.Signals, ...]:
    """Return the signals of some names that this system has."""
    return tuple(getattr(signal, name) for name in names if hasattr(signal, name))


ENDING = _known("SIGINT", "SIGTERM", "SIGHUP")
"""Signals that end a run: Ctrl-C, the end of a service, a terminal that is closed."""

SAVING = dict.fromkeys(_known("SIGUSR1"), "asked by SIGUSR1") | dict.fromkeys(
    _known("SIGHUP"), "terminal closed"
)
"""Signals on which a run saves its black box, and why."""

PARENTS = ENDING + _known("SIGQUIT", "SIGUSR1")
"""Signals that a terminal or a service manager sends to all processes of a run, and means for one."""


def is_ignored(number: signal.Signals) -> bool:
    """Return True if this process was started to ignore a signal, as by nohup, or in the background."""
    return signal.getsignal(number) in (signal.SIG_IGN, None)


def leave_signals_to_parent() -> None:
    """Ignore in this process the signals that its parent handles."""
    for number in PARENTS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def ends_at_safe_points() -> Iterator[Callable[[], None]]:
    """Defer KeyboardInterrupt until the block's code calls the yielded function, or the block ends.

    It may otherwise come between any two lines: in a message that is half sent, or in a file that is half
    closed. A second signal is not deferred, for the first may be held back by a disk that hangs. In another
    thread than the main one nothing is deferred, for signals are the main one's.
    """
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if len(came) > 1:
            signal.default_int_handler(number, frame)

    def check() -> None:
        if came:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    held = {number: signal.signal(number, note) for number in ENDING if not is_ignored(number)}
    try:
        yield check
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
