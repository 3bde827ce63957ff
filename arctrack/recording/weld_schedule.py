"""Weld schedule, a CSV table: speed, weave and wire by the joint's gap or the area of its opening."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, cast

import numpy as np

from arctrack.errors import in_file
from arctrack.recording.csv_file import number, read_csv
from noise_model.compiled.arrays import Float64

MEASURED = ("gap_mm", "area_mm2")
WELDED = ("speed_mm_s", "weave_mm", "wire_m_min")


class WeldValues(NamedTuple):
    """Inputs of the weld at a place: NaN for what the schedule leaves out, all where it refuses.

    `refusal` is empty, or says why: `gap_mm_unknown`, `gap_mm_below` or `gap_mm_above` the table's range, and
    the same of `area_mm2`.
    """

    speed_mm_s: float = math.nan
    weave_mm: float = math.nan
    wire_m_min: float = math.nan
    refusal: str = ""


NO_WELD = WeldValues()
"""Values where there is no schedule."""


@dataclass(frozen=True, eq=False)
class WeldSchedule:
    """Table of a weld's inputs: `values` (n,) by name, over the rising `measured` (n,) of gap or area."""

    by: Literal["gap_mm", "area_mm2"]
    measured: Float64
    values: Mapping[str, Float64]

    def at(self, gap_mm: float, area_mm2: float) -> WeldValues:
        """Return the weld's inputs for a gap, mm, or an area, mm^2, linear between the table's rows."""
        measured = gap_mm if self.by == "gap_mm" else area_mm2
        if math.isnan(measured):
            return WeldValues(refusal=f"{self.by}_unknown")
        if not self.measured[0] <= measured <= self.measured[-1]:
            return WeldValues(refusal=f"{self.by}_{'below' if measured < self.measured[0] else 'above'}")
        speed_mm_s, weave_mm, wire_m_min = (
            float(np.interp(measured, self.measured, self.values[name])) if name in self.values else math.nan
            for name in WELDED
        )
        return WeldValues(speed_mm_s, weave_mm, wire_m_min)


def read_schedule(path: Path) -> WeldSchedule:
    """Read a weld schedule; ArctrackError names the file, the column or line, and the cure.

    It needs gap_mm or area_mm2, rising from row to row, and one at least of speed_mm_s, weave_mm, wire_m_min.
    """
    table = read_csv(path, {}, dict.fromkeys((*MEASURED, *WELDED), number))
    if table.unknown_columns:
        raise in_file(
            path,
            f"the column {table.unknown_columns[0]} is not known; known are {', '.join(MEASURED + WELDED)}",
        )
    by = [name for name in MEASURED if name in table.columns]
    if len(by) != 1:
        raise in_file(path, f"needs one of the columns {' and '.join(MEASURED)}, not {len(by)} of them")
    welded = [name for name in WELDED if name in table.columns]
    if not welded:
        raise in_file(path, f"needs one at least of the columns {', '.join(WELDED)}")
    measured = table.column(by[0])
    for n in np.flatnonzero(~(np.diff(measured) > 0.0)) + 1:
        raise in_file(path, f"{by[0]} = {measured[n]:g}: must rise from row to row", line=int(table.lines[n]))
    for name in welded:
        for n in np.flatnonzero(table.column(name) < 0.0):
            raise in_file(
                path, f"{name} = {table.column(name)[n]:g}: must be at least 0", line=int(table.lines[n])
            )
    if len(measured) < 2:
        raise in_file(path, f"needs two rows at least: between them {by[0]} is interpolated")
    return WeldSchedule(
        cast("Literal['gap_mm', 'area_mm2']", by[0]), measured, {name: table.column(name) for name in welded}
    )
