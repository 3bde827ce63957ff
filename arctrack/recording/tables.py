"""frames.csv, poses.csv and truth.csv as typed tables, checked line by line."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.printable import printable
from arctrack.recording.csv_file import CsvTable, number, number_or_unknown, read_csv, rows_once, whole
from noise_model.compiled.arrays import Float64, Int64
from noise_model.transforms import pose_matrix

_FRAME, _SWITCH = whole(LIMITS.frame_number), whole(1)

FRAME_COLUMNS = {
    "frame": _FRAME,
    "timestamp_s": number,
    "laser_on": _SWITCH,
    "arc_on": _SWITCH,
    "current_a": number_or_unknown,
    "exposure_s": number,
}
POSE_COLUMNS = dict.fromkeys(("timestamp_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"), number)
TRUTH_COLUMNS = {"frame": _FRAME, **dict.fromkeys(("seam_x_mm", "seam_y_mm", "seam_z_mm"), number)}
"""The columns of each file and what makes numbers of their cells."""


@dataclass(frozen=True)
class FrameRow:
    """One line of frames.csv: `timestamp_s` is mid-exposure; `current_a` is NaN where it is unknown."""

    index: int
    timestamp_s: float
    laser_on: bool
    arc_on: bool
    current_a: float
    exposure_s: float

    @property
    def exposed_s(self) -> float:
        """End of the exposure, s."""
        return self.timestamp_s + self.exposure_s / 2.0

    @property
    def condition(self) -> tuple[bool, bool, float, float]:
        """Laser, arc, current (-1 if unknown) and exposure: what makes frames comparable."""
        current_a = -1.0 if math.isnan(self.current_a) else self.current_a
        return (self.laser_on, self.arc_on, current_a, self.exposure_s)


@dataclass(frozen=True)
class PoseTable:
    """T_base_tool (n, 4, 4), mm, at times (n,) that rise.

    `path` is the file they came from, `damage` what of it could not be read.
    """

    path: Path
    timestamps_s: Float64
    T_base_tool: Float64
    damage: str | None = None

    def __repr__(self) -> str:
        first_s, last_s = self.timestamps_s[[0, -1]]
        name = printable(self.path.name)
        return f"PoseTable({len(self.timestamps_s)} poses from {first_s:.3f} to {last_s:.3f} s, of {name})"

    @property
    def period_s(self) -> float:
        """The median time between two poses; NaN if there is but one."""
        return float(np.median(np.diff(self.timestamps_s))) if len(self.timestamps_s) > 1 else math.nan


@dataclass(frozen=True)
class Truth:
    """The true seam points (n, 3), mm, tool frame, of frames (n,). For scoring alone."""

    frames: Int64
    seam_tool_mm: Float64

    def __repr__(self) -> str:
        low_mm, high_mm = self.seam_tool_mm.min(axis=0), self.seam_tool_mm.max(axis=0)
        return (
            f"Truth({len(self.frames)} seam points, y {low_mm[1]:+.3f} to {high_mm[1]:+.3f}, "
            f"z {low_mm[2]:+.3f} to {high_mm[2]:+.3f} mm in tool)"
        )


def read_frame_rows(path: Path) -> tuple[tuple[FrameRow, ...], list[str]]:
    """Read frames.csv; return its rows and warnings."""
    table = read_csv(path, FRAME_COLUMNS)
    rows: list[FrameRow] = []
    for values, line in zip(table.values.tolist(), table.lines.tolist(), strict=True):
        index, timestamp_s, laser_on, arc_on, current_a, exposure_s = values
        row = FrameRow(int(index), timestamp_s, bool(laser_on), bool(arc_on), current_a, exposure_s)
        check_frame(row, rows[-1] if rows else None, path, line)
        rows.append(row)
    return tuple(rows), table.warnings


def read_poses_csv(path: Path) -> tuple[PoseTable, list[str]]:
    """Read poses.csv; return its poses and warnings."""
    table = read_csv(path, POSE_COLUMNS)
    _check_size(table, ("timestamp_s",), LIMITS.time_s, "s; give seconds, not ms or ns")
    table, repeats = rows_once(table, "timestamp_s")
    timestamps_s = table.column("timestamp_s")
    _check_size(table, ("x_mm", "y_mm", "z_mm"), LIMITS.length_mm, "mm")
    T_base_tool = np.empty((len(timestamps_s), 4, 4))
    for n, value in enumerate(table.values):
        try:
            T_base_tool[n] = pose_matrix(value[1:4], value[4:])
        except ValueError as error:
            raise in_file(path, str(error), line=int(table.lines[n])) from None
    repeated = [f"{path}: {repeats} rows repeat the row before: they are left out"] if repeats else []
    return PoseTable(path, timestamps_s, T_base_tool), [*table.warnings, *repeated]


def read_truth_csv(path: Path) -> Truth:
    """Read truth.csv."""
    table = read_csv(path, TRUTH_COLUMNS)
    frames = table.column("frame").astype(np.int64)
    _check_size(table, ("seam_x_mm", "seam_y_mm", "seam_z_mm"), LIMITS.length_mm, "mm")
    for n in np.flatnonzero(np.diff(frames) <= 0) + 1:
        problem = f"frame {frames[n]} does not come after {frames[n - 1]}"
        raise in_file(path, problem, line=int(table.lines[n]))
    return Truth(frames, table.values[:, 1:])


def check_frame(row: FrameRow, before: FrameRow | None, path: Path, line: int) -> None:
    """Raise ArctrackError, naming a file and a line, for values of a frame that are beyond the limits."""
    if not abs(row.timestamp_s) <= LIMITS.time_s:
        problem = f"is beyond {LIMITS.time_s:g} s; give seconds, not ms or ns"
        raise in_file(path, f"timestamp_s = {row.timestamp_s:g}: {problem}", line=line)
    if not row.exposure_s > 0:
        raise in_file(path, f"exposure_s = {row.exposure_s:g}: must be > 0", line=line)
    if row.exposure_s > LIMITS.exposure_s:
        problem = f"exposure_s = {row.exposure_s:g}: must be <= {LIMITS.exposure_s:g}; give seconds"
        raise in_file(path, problem, line=line)
    if row.current_a < 0:
        raise in_file(path, f"current_a = {row.current_a:g}: must be >= 0", line=line)
    if row.current_a > LIMITS.current_a:
        problem = f"current_a = {row.current_a:g}: must be <= {LIMITS.current_a:g}; give amperes"
        raise in_file(path, problem, line=line)
    if before is None:
        return
    if row.index <= before.index:
        raise in_file(path, f"frame {row.index} does not come after {before.index}", line=line)
    if row.timestamp_s <= before.timestamp_s:
        order = f"timestamp_s = {row.timestamp_s:.6f} does not come after {before.timestamp_s:.6f}"
        raise in_file(path, f"{order}: times must rise", line=line)


def _check_size(table: CsvTable, names: tuple[str, ...], most: float, unit: str) -> None:
    """Raise ArctrackError for the first value of columns that is beyond a size."""
    for name in names:
        for n in np.flatnonzero(np.abs(table.column(name)) > most):
            problem = f"{name} = {table.column(name)[n]:g}: is beyond {most:g} {unit}"
            raise in_file(table.path, problem, line=int(table.lines[n]))
