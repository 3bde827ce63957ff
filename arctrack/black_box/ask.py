"""Asking a run's black box to save what it has."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.connection import Connection


class BlackBoxAsker:
    """Asks over a connection, and hears the answers when they come; nobody waits.

    Parameters
    ----------
    connection : Connection
        To the black box' process.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._asked = 0

    def save(self, reason: str) -> None:
        """Ask that the latest frames be saved."""
        with suppress(BrokenPipeError):
            self._connection.send({"save": reason})
            self._asked += 1

    def answers(self, wait_s: float = 0.0) -> Iterator[str]:
        """Yield a line for each answer that has come, or comes within a time, s."""
        while self._asked and self._connection.poll(wait_s):
            answer = self._connection.recv()
            self._asked -= 1
            yield (
                f"black box: saved {answer['saved']}"
                if "saved" in answer
                else (f"black box: {answer['error']}")
            )
