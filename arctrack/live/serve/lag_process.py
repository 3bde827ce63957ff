"""Estimation of the robot's lag in a subprocess: it takes as long as some frames' steps."""

from __future__ import annotations

from contextlib import suppress
from multiprocessing.connection import Connection, wait

from arctrack.control.look_ahead import Motions, lag_of
from arctrack.control.policy import LookAheadPolicy
from arctrack.live.journal.message_pipe import PipeEnd
from robot_io.clocks.lag import Lag, LagLimits


class LagAsker:
    """Client of the process that estimates the robot's lag; never blocks."""

    def __init__(self, connection: PipeEnd) -> None:
        self._connection = connection
        self._is_asked = False

    def ask(self, motions: Motions) -> None:
        """Send what an estimate rests on, unless the process still has what it was sent before."""
        if not self._is_asked:
            with suppress(OSError):
                self._connection.send(motions)
                self._is_asked = True

    def answer(self) -> Lag | None:
        """Return an estimate that has come."""
        if not (self._is_asked and self._connection.poll()):
            return None
        try:
            lag: Lag = self._connection.recv()
        except (EOFError, OSError):
            return None
        self._is_asked = False
        return lag


def estimate_lags(parent: Connection, asked: PipeEnd) -> None:
    """Report readiness, and answer each requested `Motions` with the lag, until the parent is gone."""
    policy, limits = LookAheadPolicy(), LagLimits()
    # The parent may be gone before it is ready.
    try:
        parent.send([])
        while wait([parent, asked.fileno()]) == [asked.fileno()]:
            asked.send(lag_of(asked.recv(), policy, limits))
    except (EOFError, ConnectionResetError, BrokenPipeError):
        return
