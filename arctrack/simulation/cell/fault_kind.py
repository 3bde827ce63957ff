"""What it is to go wrong in a cell: how it begins and ends, and what must be said of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from arctrack.simulation.cell.cell import Cell
from arctrack.simulation.cell.world import World
from robot_io import GateReason

End = Callable[[], None]
"""What ends a fault."""

Begin = Callable[[Cell, np.random.Generator], End]
"""Begins a fault in a cell, with what chance decides."""

POSES = frozenset({GateReason.POSE_IMPLAUSIBLE})


@dataclass(frozen=True)
class FaultKind:
    """One thing that goes wrong.

    Parameters
    ----------
    name : str
        What it is called in the table.
    begin : callable
        Makes it so in a cell, and returns what ends it.
    reasons : frozenset of GateReason
        What the tracker may say of it; empty where it need not say anything.
    told_s : float
        After how long nothing is VALID or HELD any more, s; NaN where offsets may go on.
    from_start : bool
        Whether it holds from the first frame on.
    is_slow_bus : bool
        Whether offsets get old on the bus itself, which the tracker cannot know.
    lasts_s : callable, optional
        How long it lasts in a world, s; by default a time is drawn.
    recovery_s : float
        How long after its end all is to be well again, s.
    follows_mm : float
        How far the torch follows what nothing can tell from a seam that runs off, mm, at most.
    note : str
        What the table says of it.
    """

    name: str
    begin: Begin
    reasons: frozenset[GateReason] = frozenset()
    told_s: float = math.nan
    from_start: bool = False
    is_slow_bus: bool = False
    lasts_s: Callable[[World], float] | None = None
    recovery_s: float = 1.6
    follows_mm: float = 0.0
    note: str = ""
