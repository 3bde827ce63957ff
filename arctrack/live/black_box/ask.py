"""Asking a run's black box to save what it has."""

from __future__ import annotations

from contextlib import suppress

from arctrack.live.journal.message_pipe import PipeEnd


class BlackBoxAsker:
    """Client of the black box process; never blocks.

    A request made while a recording is being saved is dropped: a queued one would be answered long after.
    """

    def __init__(self, connection: PipeEnd) -> None:
        self._connection = connection
        self._is_asked = False
        self._told: list[str] = []

    def save(self, reason: str) -> None:
        """Request that the latest frames be saved, unless that is under way."""
        self._hear(0.0)
        if not self._is_asked:
            with suppress(OSError):
                self._connection.send({"save": reason})
                self._is_asked = True

    def answers(self, wait_s: float = 0.0) -> list[str]:
        """Return a line for each answer that was not returned yet; one may come within a time, s."""
        self._hear(wait_s)
        told, self._told = self._told, []
        return told

    def _hear(self, wait_s: float) -> None:
        with suppress(EOFError, OSError):
            if not self._is_asked or not self._connection.poll(wait_s):
                return
            answer = self._connection.recv()
            self._is_asked = False
            said = f"saved {answer['saved']}" if "saved" in answer else answer["error"]
            self._told.append(f"black box: {said}")
