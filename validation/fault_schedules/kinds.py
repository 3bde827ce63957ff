"""All that may go wrong in a cell with a cheap camera, in the table's order."""

from __future__ import annotations

import numpy as np

from arctrack.simulation.cell.cell import BRIDGE_MM, Cell
from arctrack.simulation.cell.fault_kind import Begin, End, FaultKind
from arctrack.simulation.cell.tracker_node import CameraBehaviour
from arctrack.simulation.cell.weld.welding_events import (
    ARC_FAULT,
    LONG_TACK_MM,
    SHORT_TACK_MM,
    SLIPPED,
    rearm,
    way,
)
from robot_io import Command, GateReason
from validation.fault_schedules.failures import FAULTS
from validation.fault_schedules.worlds import MIN_SPEED_MM_S


def _unseen(is_reset: bool) -> Begin:
    """Let the camera see no joint; a tracker that went into its fault over it is reset."""

    def begin(cell: Cell, _rng: np.random.Generator) -> End:
        cell.tracker.behaviour = CameraBehaviour.GARBAGE

        def end() -> None:
            cell.tracker.behaviour = CameraBehaviour.RIGHT
            if is_reset:
                rearm(cell, Command.RESET)

        return end

    return begin


KINDS: tuple[FaultKind, ...] = (
    *FAULTS,
    ARC_FAULT,
    FaultKind(
        f"a tack of {SHORT_TACK_MM:g} mm",
        _unseen(is_reset=False),
        lasts_s=way(SHORT_TACK_MM),
        note="the stretch before and behind it is followed",
    ),
    FaultKind(
        f"no joint for {LONG_TACK_MM:g} mm",
        _unseen(is_reset=True),
        frozenset({GateReason.PART_REFUSED}),
        BRIDGE_MM / MIN_SPEED_MM_S + 0.1,
        lasts_s=way(LONG_TACK_MM),
        note=f"a long tack, or a seam out of view: a fault after the job's {BRIDGE_MM:g} mm, until RESET",
    ),
    SLIPPED,
)
"""Faults, then what happens in welding."""
