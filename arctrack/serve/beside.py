"""The processes beside a live run: what they do touches neither its loop nor its time."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from arctrack.errors import ArctrackError

ENDS_S = 60.0
"""How long a process may take to end, s: it may write what it holds."""

SPAWN = multiprocessing.get_context("spawn")
"""A fork would have the loop's own threads, locked memory and real-time priority."""


class Beside:
    """A process beside this one. It says over a connection that it is ready, and ends once that is closed.

    Parameters
    ----------
    name : str
        What it is called.
    target : callable
        What it runs: takes the arguments, then its end of the connection, then the other ones.
    arguments : tuple
        What comes before its end of the connection.
    others : tuple of Connection
        Other ends that it takes over; they are closed here.
    niceness : int
        By how much it yields to other processes.
    """

    def __init__(
        self,
        name: str,
        target: Callable[..., None],
        arguments: tuple[Any, ...] = (),
        others: tuple[Connection, ...] = (),
        niceness: int = 0,
    ) -> None:
        self.name = name
        self.told, its_end = SPAWN.Pipe()
        self._process = SPAWN.Process(
            target=_begin,
            args=(niceness, target, *arguments, its_end, *others),
            name=f"arctrack {name}",
            daemon=True,
        )
        self._process.start()
        for end in (its_end, *others):
            end.close()

    def wait_ready(self) -> Any:
        """Wait until it is ready, and return what it said; ArctrackError with its reason where it cannot."""
        try:
            said = self.told.recv()
        except (EOFError, ConnectionResetError):
            raise ArctrackError(f"the process of the {self.name} ended by itself") from None
        if isinstance(said, str) and said.startswith("error: "):
            raise ArctrackError(said.removeprefix("error: "))
        return said

    def end(self, message: str | None = None) -> None:
        """Let it end, with a last word to it where it waits for one."""
        if message is not None:
            with suppress(BrokenPipeError):
                self.told.send(message)
        self.told.close()
        self._process.join(ENDS_S)
        if self._process.is_alive():
            self._process.kill()


def _begin(niceness: int, target: Callable[..., None], *arguments: Any) -> None:
    """Run a process beside: Ctrl-C and the end of a service are meant for the loop, which ends it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    os.nice(niceness)
    target(*arguments)


@contextmanager
def ended(beside: Beside, message: str | None = None) -> Iterator[Beside]:
    """End a process in the end."""
    try:
        yield beside
    finally:
        beside.end(message)
