"""Kinds of fault in a cell: begin, end, and the report they require."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from arctrack.simulation.cell.weld.events import End
from arctrack.simulation.cell.world import World
from robot_io import GateReason
from validation.fault_schedules.judged_cell import JudgedCell

Begin = Callable[[JudgedCell, np.random.Generator], End]
"""Begins a fault in a cell, with what chance decides."""

POSES = frozenset({GateReason.POSE_IMPLAUSIBLE})


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    `begin` starts it in a cell and returns what ends it. `reasons` are those that the tracker may state,
    empty where it need not state any. After `stop_s` nothing is VALID or HELD any more, NaN where offsets may
    go on. With `is_slow_bus` offsets age on the bus itself, which the tracker cannot know. `lasts_s` gives
    its duration in a world, by default a drawn time; `recovery_s` after its end all is to be well again.
    `follows_mm` is how far at most the torch follows what cannot be distinguished from a seam that runs off.
    """

    name: str
    begin: Begin
    reasons: frozenset[GateReason] = frozenset()
    stop_s: float = math.nan
    from_start: bool = False
    is_slow_bus: bool = False
    lasts_s: Callable[[World], float] | None = None
    recovery_s: float = 1.6
    follows_mm: float = 0.0
    note: str = ""
