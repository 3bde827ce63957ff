"""Goniometer readings as CSV: a row a grey level, rows of equal settings averaged."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from arctrack.errors import in_file
from arctrack.recording.csv_file import CsvTable, number, read_csv
from calibration.goniometer import GreyResponse, Readings, Settings, average
from noise_model.compiled.arrays import Float64

NEEDED = ("theta_i_deg", "theta_r_deg", "phi_r_deg", "gray_level")
SOURCE = ("distance_mm", "intensity")
"""The source's distance a and intensity I, each in one unit for all files that are compared; 1 if absent."""

TIME, REPEAT = "time_s", "repeat"


@dataclass(frozen=True, eq=False)
class GoniometerFile:
    """The averaged readings of a file.

    `lines` (m,) is where each setting first occurs, `zero_lines` where settings have their first reading of
    0, `source_columns` those of `SOURCE` that the file has, `interval_s` the median time between successive
    readings of one setting, NaN if unknown.
    """

    path: Path
    readings: Readings
    lines: tuple[int, ...]
    zero_lines: tuple[int, ...]
    source_columns: tuple[str, ...]
    interval_s: float
    unknown_columns: tuple[str, ...]


def read_goniometer(path: Path, response: GreyResponse) -> GoniometerFile:
    """Read and average a file; ArctrackError names the file and the line that is wrong.

    A saturated reading is refused: it says no more than 'at least this bright', and without it the mean of
    its setting would be too low.
    """
    table = read_csv(path, dict.fromkeys(NEEDED, number), dict.fromkeys((*SOURCE, TIME), number))
    column = {name: table.column(name) for name in table.columns}
    _check(table, column, response)
    ones = np.ones(len(table.lines))
    source = column.get("intensity", ones) / column.get("distance_mm", ones) ** 2
    settings = Settings(column["theta_i_deg"], column["theta_r_deg"], column["phi_r_deg"], source)
    readings = average(settings, column["gray_level"])
    return GoniometerFile(
        path,
        readings,
        lines=tuple(table.lines[np.unique(readings.group, return_index=True)[1]].tolist()),
        zero_lines=_zero_lines(table, column["gray_level"], readings.group),
        source_columns=tuple(name for name in SOURCE if name in column),
        interval_s=_interval_s(column[TIME], readings.group) if TIME in column else math.nan,
        unknown_columns=tuple(name for name in table.unknown_columns if name != REPEAT),
    )


def _check(table: CsvTable, column: dict[str, Float64], response: GreyResponse) -> None:
    gray_level = column["gray_level"]
    # Range of distance and intensity in any unit: the intensity over the distance squared is finite.
    low, high = 1e-9, 1e9
    limits = [
        (
            "theta_i_deg",
            (column["theta_i_deg"] < 0) | (column["theta_i_deg"] >= 90),
            "lies from 0 to below 90",
        ),
        ("theta_r_deg", np.abs(column["theta_r_deg"]) >= 90, "lies between -90 and 90"),
        ("gray_level", gray_level < 0, "must be >= 0"),
        (
            "gray_level",
            gray_level >= response.saturation_dn,
            f"is saturated (at {response.saturation_dn:g}): lower the exposure or state --saturation",
        ),
        *((name, column[name] <= 0, "must be > 0") for name in SOURCE if name in column),
        *(
            (name, (column[name] < low) | (column[name] > high), f"must be {low:g} to {high:g}")
            for name in SOURCE
            if name in column
        ),
    ]
    for name, wrong, problem in limits:
        if wrong.any():
            row = int(np.argmax(wrong))
            raise in_file(table.path, f"{name} = {column[name][row]:g} {problem}", line=int(table.lines[row]))


def _zero_lines(table: CsvTable, gray_level: Float64, group: npt.NDArray[np.intp]) -> tuple[int, ...]:
    rows = np.flatnonzero(gray_level == 0.0)
    first = np.sort(np.unique(group[rows], return_index=True)[1])
    return tuple(table.lines[rows[first]].tolist())


def _interval_s(time_s: Float64, group: npt.NDArray[np.intp]) -> float:
    order = np.lexsort((time_s, group))
    steps = np.diff(time_s[order])[np.diff(group[order]) == 0]
    return float(np.median(steps)) if len(steps) else math.nan
