"""frames.csv, poses.csv and truth.csv as typed tables, checked line by line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.recording.csv_file import CsvTable, read_csv
from noise_model.arrays import Float64, Int64
from noise_model.transforms import pose_matrix

FRAME_COLUMNS = ("frame", "timestamp_s", "laser_on", "arc_on", "current_a", "exposure_s")
POSE_COLUMNS = ("timestamp_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
TRUTH_COLUMNS = ("frame", "seam_x_mm", "seam_y_mm", "seam_z_mm")

HIGHEST_FRAME = 999_999_999
LATEST_S = 1e11
"""A frame's time in Unix seconds is 1.7e9; one beyond this is in other units, and no log can hold it."""

LONGEST_EXPOSURE_S = 3600.0
HIGHEST_CURRENT_A = 1e4


@dataclass(frozen=True)
class FrameRow:
    """One line of frames.csv: `timestamp_s` is mid-exposure; `current_a` is NaN where nobody knows it."""

    index: int
    timestamp_s: float
    laser_on: bool
    arc_on: bool
    current_a: float
    exposure_s: float

    @property
    def condition(self) -> tuple[bool, bool, float, float]:
        """Laser, arc, current (-1 if unknown) and exposure: what makes frames comparable."""
        current_a = -1.0 if math.isnan(self.current_a) else self.current_a
        return (self.laser_on, self.arc_on, current_a, self.exposure_s)


@dataclass(frozen=True)
class PoseTable:
    """T_base_tool (n, 4, 4), mm, at times (n,) that rise; `path` is the file they came from."""

    path: Path
    timestamps_s: Float64
    T_base_tool: Float64

    @property
    def period_s(self) -> float:
        """The median time between two poses; NaN if there is but one."""
        return float(np.median(np.diff(self.timestamps_s))) if len(self.timestamps_s) > 1 else math.nan


@dataclass(frozen=True)
class Truth:
    """The true seam points (n, 3), mm, tool frame, of frames (n,). For scoring alone."""

    frames: Int64
    seam_tool_mm: Float64


def read_frame_rows(path: Path) -> tuple[tuple[FrameRow, ...], tuple[str, ...]]:
    """Read frames.csv; return its rows and the columns that mean nothing here."""
    table = read_csv(path, FRAME_COLUMNS)
    rows: list[FrameRow] = []
    for n in range(len(table.rows)):
        current = table.rows[n][4].strip()
        row = FrameRow(
            index=table.whole(n, 0, HIGHEST_FRAME),
            timestamp_s=table.number(n, 1),
            laser_on=bool(table.whole(n, 2, 1)),
            arc_on=bool(table.whole(n, 3, 1)),
            current_a=table.number(n, 4) if current else math.nan,
            exposure_s=table.number(n, 5),
        )
        _check_frame(row, rows[-1] if rows else None, path, table.lines[n])
        rows.append(row)
    return tuple(rows), table.unknown_columns


def read_poses_csv(path: Path) -> tuple[PoseTable, tuple[str, ...]]:
    """Read poses.csv; return its poses and the columns that mean nothing here."""
    table = read_csv(path, POSE_COLUMNS)
    values = np.array([[table.number(n, c) for c in range(8)] for n in range(len(table.rows))])
    _check_rising(values[:, 0], table)
    T_base_tool = np.empty((len(values), 4, 4))
    for n, value in enumerate(values):
        try:
            T_base_tool[n] = pose_matrix(value[1:4], value[4:])
        except ValueError as error:
            raise in_file(path, str(error), line=table.lines[n]) from None
    return PoseTable(path, values[:, 0], T_base_tool), table.unknown_columns


def read_truth_csv(path: Path) -> Truth:
    """Read truth.csv."""
    table = read_csv(path, TRUTH_COLUMNS)
    frames = [table.whole(n, 0, HIGHEST_FRAME) for n in range(len(table.rows))]
    for n in range(1, len(frames)):
        if frames[n] <= frames[n - 1]:
            raise in_file(path, f"frame {frames[n]} does not come after {frames[n - 1]}", line=table.lines[n])
    points = [[table.number(n, c) for c in (1, 2, 3)] for n in range(len(table.rows))]
    return Truth(np.array(frames, dtype=np.int64), np.array(points))


def _check_frame(row: FrameRow, before: FrameRow | None, path: Path, line: int) -> None:
    if not abs(row.timestamp_s) <= LATEST_S:
        problem = f"timestamp_s = {row.timestamp_s:g}: is beyond {LATEST_S:g} s; give seconds, not ms or ns"
        raise in_file(path, problem, line=line)
    if not row.exposure_s > 0:
        raise in_file(path, f"exposure_s = {row.exposure_s:g}: must be > 0", line=line)
    if row.exposure_s > LONGEST_EXPOSURE_S:
        problem = f"exposure_s = {row.exposure_s:g}: must be <= {LONGEST_EXPOSURE_S:g}; give seconds"
        raise in_file(path, problem, line=line)
    if row.current_a < 0:
        raise in_file(path, f"current_a = {row.current_a:g}: must be >= 0", line=line)
    if row.current_a > HIGHEST_CURRENT_A:
        problem = f"current_a = {row.current_a:g}: must be <= {HIGHEST_CURRENT_A:g}; give amperes"
        raise in_file(path, problem, line=line)
    if before is None:
        return
    if row.index <= before.index:
        raise in_file(path, f"frame {row.index} does not come after {before.index}", line=line)
    if row.timestamp_s <= before.timestamp_s:
        raise in_file(path, _backwards(row.timestamp_s, before.timestamp_s), line=line)


def _check_rising(timestamps_s: Float64, table: CsvTable) -> None:
    falls = np.flatnonzero(np.diff(timestamps_s) <= 0)
    if falls.size:
        n = int(falls[0]) + 1
        problem = _backwards(timestamps_s[n], timestamps_s[n - 1])
        raise in_file(table.path, problem, line=table.lines[n])


def _backwards(later_s: float, earlier_s: float) -> str:
    return f"timestamp_s = {later_s:.6f} does not come after {earlier_s:.6f}: times must rise"
