"""The robot's poses from a user's files, as T_base_tool in mm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.importing.columns import (
    FILE_NAMES,
    FRAME_NAMES,
    Column,
    Columns,
    frame_number,
    image_parser,
    rows_of_images,
    times_s,
)
from arctrack.importing.image_files import ImageSeries
from arctrack.importing.matrix_files import read_matrices
from arctrack.importing.rotations import (
    BY_ITS_NAMES,
    CONVENTIONS,
    MATRIX,
    Convention,
    NoRotationError,
    convention,
)
from arctrack.importing.units import ANGLE, LENGTH, UNITS, Units, factor
from arctrack.limits import LIMITS
from arctrack.recording.csv_file import CsvTable, Parser, TimeParser, number, read_csv, rows_once
from noise_model.arrays import Float64, Int64

POSITION_NAMES = tuple(
    (axis, f"pos_{axis}", f"t{axis}", f"actual_tcp_pose_{n}") for n, axis in enumerate("xyz")
)

SMALL_REACH = 2.0
"""Positions that reach no further from base's origin than so many of their unit, mm as stated, are m."""

MAX_REACH_M = 100.0
"""Positions said to be in m that reach further are mm: no robot's base is a hundred metres away."""

MAX_TURN_RAD = 4.0 * math.pi
"""Angles said to be rad that are larger are degrees: controllers write less than two turns."""


@dataclass(frozen=True)
class PoseFile:
    """The poses of a file.

    `T_base_tool` (n, 4, 4), mm; `times_s` (n,) if the file has times; `rows` (images,) the row of each image,
    if the file says it or has no times, -1 for none; `units` as read, for people; `warnings` where they look
    wrong; `rotation` (n, 3) or (n, 4) the numbers of the rotation as the file has them, None of matrices.
    """

    path: Path
    T_base_tool: Float64
    times_s: Float64 | None
    rows: Int64 | None
    units: str
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    rotation: Float64 | None = None


def known_names(rotation: str | None) -> tuple[str, ...]:
    """Return the names that columns of a pose file have in --column."""
    if rotation == MATRIX:
        return ()
    return (*(names[0] for names in POSITION_NAMES), *_stated(rotation).columns[0])


def read_matrix_poses(
    rotations: Path, translations: Path | None, stated: Units, series: ImageSeries
) -> PoseFile:
    """Return the poses of matrices, one an image; ArctrackError as `read_matrices`, and for another count."""
    if stated.length is None:
        raise in_file(translations or rotations, f"states no unit: give --units {' or '.join(UNITS[LENGTH])}")
    T_base_tool = read_matrices(rotations, translations, factor(LENGTH, stated.length))
    if len(T_base_tool) != len(series):
        raise in_file(
            rotations, f"holds {len(T_base_tool)} poses for {len(series)} images: one each is needed"
        )
    warnings = _doubts(T_base_tool[:, :3, 3], stated.length, translations or rotations)
    rows = np.arange(len(series))
    return PoseFile(rotations, T_base_tool, None, rows, stated.length, (), tuple(warnings))


def read_pose_table(
    columns: Columns,
    rotation: str | None,
    stated: Units,
    series: ImageSeries,
    is_timed: bool,
    *,
    may_lack: bool = False,
) -> PoseFile:
    """Return the poses of a CSV file.

    Rows with times are the images' own only if these have no times from elsewhere, `is_timed`.

    Raises ArctrackError for a column that is missing, a unit that nothing states, numbers that contradict it,
    a rotation that is none, times that do not rise, and as `rows_of_images`.
    """
    place = [columns.need(names) for names in POSITION_NAMES]
    written, turn = _rotation_columns(columns, rotation)
    time = columns.find_time()
    frame, file = None, None
    if time is None or not is_timed:
        frame, file = columns.find(FRAME_NAMES), columns.find(FILE_NAMES)
    parsers: dict[str, Parser] = {column.header: number for column in (*place, *turn)}
    time_parser = TimeParser()
    if time is not None:
        parsers[time.header] = time_parser
    if file is not None:
        parsers[file.header] = image_parser(series)
    elif frame is not None:
        parsers[frame.header] = frame_number
    table = read_csv(columns.path, parsers)
    notes = list[str]()
    if time is not None:
        table, repeats = rows_once(table, time.header)
        notes += [f"{repeats} rows repeat the row before and are left out"] if repeats else []
    units = [
        *(columns.unit(column, LENGTH, stated, written.units) for column in place),
        *(columns.unit(column, ANGLE, stated, written.units) for column in turn if written.are_angles),
    ]
    if len(set(units[:3])) > 1 or len(set(units[3:])) > 1:
        raise in_file(columns.path, f"{', '.join(units)}: coordinates need one unit, angles another")
    T_base_tool = np.tile(np.eye(4), (len(table.lines), 1, 1))
    T_base_tool[:, :3, :3] = _matrices(table, turn, written, units[3:4])
    T_base_tool[:, :3, 3] = _column_values(table, place) * factor(LENGTH, units[0])
    warnings = _doubts(T_base_tool[:, :3, 3], units[0], columns.path)
    if written.are_angles:
        warnings += _angle_doubts(_column_values(table, turn), units[3], columns.path)
    times, rows = None, None
    if time is not None:
        times, more = times_s(columns, table, time, stated, time_parser)
        _check_size(times, columns.path)
        notes += more
    if time is None or file is not None or frame is not None:
        rows, more = rows_of_images(table, frame, file, series, may_lack=may_lack)
        notes += more
    spoken = ", ".join(dict.fromkeys(units))
    numbers = _column_values(table, turn)
    return PoseFile(columns.path, T_base_tool, times, rows, spoken, tuple(notes), tuple(warnings), numbers)


def _stated(rotation: str | None) -> Convention:
    return BY_ITS_NAMES if rotation is None else convention(rotation)


def _rotation_columns(columns: Columns, rotation: str | None) -> tuple[Convention, list[Column]]:
    written = _stated(rotation)
    named = written.columns[0]
    for names in written.columns:
        candidates = [columns.find((name,), role) for role, name in zip(named, names, strict=True)]
        held = [column for column in candidates if column is not None]
        if len(held) == len(names):
            return written, held
    if rotation is None:
        choice = ", ".join((*CONVENTIONS, "ZYX", MATRIX))
        raise in_file(
            columns.path,
            f"no columns are called {', '.join(named)}: say by --rotation how it is written ({choice})",
        )
    lost = next(name for name in named if columns.find((name,)) is None)
    raise columns.lacks(lost)


def _column_values(table: CsvTable, columns: list[Column]) -> Float64:
    return np.stack([table.column(column.header) for column in columns], axis=1)


def _matrices(table: CsvTable, turn: list[Column], written: Convention, unit: list[str]) -> Float64:
    numbers = _column_values(table, turn) * (factor(ANGLE, unit[0]) if unit else 1.0)
    try:
        return written.matrices(numbers)
    except NoRotationError as error:
        raise in_file(table.path, str(error), line=int(table.lines[error.row])) from None


def _doubts(positions_mm: Float64, unit: str, path: Path) -> list[str]:
    """Return warnings on positions that look to be of another unit; ArctrackError where they must be."""
    reach_mm = float(np.abs(positions_mm).max())
    if unit == "m" and reach_mm > 1e3 * MAX_REACH_M:
        raise in_file(path, f"coordinates reach {reach_mm / 1e3:.4g} m: they are mm; give --units mm")
    if reach_mm > LIMITS.length_mm:
        raise in_file(
            path, f"a coordinate of {reach_mm:g} mm is beyond {LIMITS.length_mm:g} mm; in which unit?"
        )
    if unit == "mm" and 0.0 < reach_mm <= SMALL_REACH:
        return [f"{path}: coordinates stay within {reach_mm:.4g} mm of base's origin; are they m?"]
    return []


def _angle_doubts(angles: Float64, unit: str, path: Path) -> list[str]:
    largest = float(np.abs(angles).max())
    if unit == "rad" and largest > MAX_TURN_RAD:
        raise in_file(path, f"angles reach {largest:.4g} rad: they are degrees; give --units deg")
    if unit == "deg" and 0.0 < largest <= 2.0 * math.pi:
        return [f"{path}: angles stay within {largest:.4g} deg; are they rad?"]
    return []


def _check_size(times: Float64, path: Path) -> None:
    if np.abs(times).max() > LIMITS.time_s:
        raise in_file(
            path, f"{np.abs(times).max():g} s is beyond {LIMITS.time_s:g} s; give --units ms, us or ns"
        )


def read_poses(
    path: Path,
    translations: Path | None,
    rotation: str | None,
    stated: Units,
    named: Mapping[str, str],
    series: ImageSeries,
    is_timed: bool,
    *,
    may_lack: bool = False,
) -> tuple[PoseFile, list[Columns]]:
    """Return the poses of a CSV file or of matrices, and the columns of the file if it has any.

    Where images `may_lack` a pose, their row is -1.

    Raises ArctrackError as `read_pose_table` and `read_matrix_poses`.
    """
    if translations is not None and rotation not in (None, MATRIX):
        raise ArctrackError(f"--translations: has no effect with --rotation {rotation}; leave one of them")
    if translations is not None or rotation == MATRIX:
        return read_matrix_poses(path, translations, stated, series), []
    wanted = ",".join((*known_names(rotation), "and a time, frame or file if there is one"))
    columns = Columns(path, named, wanted)
    return read_pose_table(columns, rotation, stated, series, is_timed, may_lack=may_lack), [columns]
