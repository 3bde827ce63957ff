"""Estimation of the robot's lag in a subprocess: it takes as long as some frames' steps."""

from multiprocessing.connection import Connection, wait

from arctrack.control.look_ahead import lag_of
from arctrack.control.policy import LookAheadPolicy
from arctrack.live.journal.message_pipe import PipeEnd
from robot_io.clocks.lag import LagLimits


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
