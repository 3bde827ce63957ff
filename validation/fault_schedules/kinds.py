"""All that may go wrong in a cell with a cheap camera, in the table's order."""

from __future__ import annotations

from arctrack.simulation.cell.fault_kind import FaultKind
from arctrack.simulation.cell.weld.welding_events import EVENTS
from validation.fault_schedules.failures import FAULTS

KINDS: tuple[FaultKind, ...] = (*FAULTS, *EVENTS)
"""Faults, then what happens in welding."""
