"""All that may go wrong in a cell with a cheap camera, in the table's order."""

from __future__ import annotations

import numpy as np

from arctrack.simulation.cell.cell import BRIDGE_MM
from arctrack.simulation.cell.weld.events import (
    LONG_TACK_MM,
    SHORT_TACK_MM,
    End,
    arc_fault,
    arc_fault_s,
    displace_part,
    rearm,
    way,
)
from robot_io import Command, GateReason
from validation.fault_schedules.failures import FAULTS
from validation.fault_schedules.fault_kind import POSES, Begin, FaultKind
from validation.fault_schedules.faulty_tracker import CameraBehaviour
from validation.fault_schedules.judged_cell import JudgedCell
from validation.fault_schedules.worlds import MIN_SPEED_MM_S


def _unseen(is_reset: bool) -> Begin:
    """Let the camera see no joint; a tracker that went into its fault over it is reset."""

    def begin(cell: JudgedCell, _rng: np.random.Generator) -> End:
        cell.tracker.behaviour = CameraBehaviour.GARBAGE

        def end() -> None:
            cell.tracker.behaviour = CameraBehaviour.RIGHT
            if is_reset:
                rearm(cell, Command.RESET)

        return end

    return begin


KINDS: tuple[FaultKind, ...] = (
    *FAULTS,
    FaultKind(
        "arc fault, 15 mm back, restart",
        arc_fault,
        frozenset({GateReason.WELDING_FAULT, GateReason.ARC_OFF, GateReason.ROBOT_NOT_MOVING}),
        0.05,
        lasts_s=arc_fault_s,
    ),
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
    FaultKind(
        "part slips aside",
        displace_part,
        POSES,
        0.6,
        note="until the robot disarms, and searches the seam anew",
    ),
)
"""Faults, then what happens in welding."""
