"""Capture time and light of each image: from a table, from names, from a rate, from one value for all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.limits import LIMITS
from arctrack.recording.csv_file import Parser, TimeParser, number, number_or_unknown, read_csv, whole
from arctrack.recording.importing.columns import (
    FILE_NAMES,
    FRAME_NAMES,
    TIME_NAMES,
    CsvColumns,
    frame_number,
    image_parser,
    rows_of_images,
    times_s,
)
from arctrack.recording.importing.image_files import ImageSeries, recognized_times
from arctrack.recording.importing.pose_files import PoseFile
from arctrack.recording.importing.units import TIME, UNSTATED, Units, factor
from arctrack.recording.tables import FrameRow, check_frame
from arctrack.recording.time_sources import TimeSource, contradictions
from noise_model.compiled.arrays import Float64, Int64

CONDITION_NAMES = (
    ("laser_on", "laser"),
    ("arc_on", "arc"),
    ("current_a", "current"),
    ("exposure", "exposure_time"),
)
KNOWN_NAMES = tuple(names[0] for names in (TIME_NAMES, FRAME_NAMES, FILE_NAMES, *CONDITION_NAMES))
"""The names that columns of a table of frames have in --column."""

_PARSERS = (whole(1), whole(1), number_or_unknown, number)


@dataclass(frozen=True)
class FrameConditions:
    """Stated conditions of the frames: a table, or values for all.

    `columns` are those of the table; `current_a` is None where no arc burns; `exposure_s` is None where the
    setup's holds.
    """

    columns: CsvColumns | None = None
    current_a: float | None = None
    exposure_s: float | None = None


@dataclass(frozen=True)
class FrameTable:
    """The columns of a table of frames, an entry an image; None where the table has no such column."""

    times_s: Float64 | None
    laser_on: Float64 | None
    arc_on: Float64 | None
    current_a: Float64 | None
    exposure_s: Float64 | None
    lines: Int64
    notes: tuple[str, ...]


NO_TABLE = FrameTable(None, None, None, None, None, np.zeros(0, dtype=np.int64), ())


def read_frame_table(columns: CsvColumns, stated: Units, series: ImageSeries) -> FrameTable:
    """Return the conditions of images that a CSV file states.

    Raises ArctrackError if it says nothing, for a value that is none, a unit that nothing states, and as
    `rows_of_images`.
    """
    time = columns.find_time()
    frame, file = columns.find(FRAME_NAMES), columns.find(FILE_NAMES)
    conditions = [columns.find(names) for names in CONDITION_NAMES]
    if time is None and not any(conditions):
        raise in_file(
            columns.path, f"has none of the columns {', '.join(KNOWN_NAMES)}; name them by --column"
        )
    parsers: dict[str, Parser] = {
        column.header: parse for column, parse in zip(conditions, _PARSERS, strict=True) if column is not None
    }
    time_parser = TimeParser()
    if time is not None:
        parsers[time.header] = time_parser
    if file is not None:
        parsers[file.header] = image_parser(series)
    elif frame is not None:
        parsers[frame.header] = frame_number
    table = read_csv(columns.path, parsers)
    rows, notes = rows_of_images(table, frame, file, series)
    laser_on, arc_on, current_a, exposure = (
        None if column is None else table.column(column.header)[rows] for column in conditions
    )
    exposure_column = conditions[-1]
    if exposure is not None and exposure_column is not None:
        exposure = exposure * factor(TIME, columns.unit(exposure_column, TIME, stated, UNSTATED))
    times = None
    if time is not None:
        times, more = times_s(columns, table, time, stated, time_parser)
        times, notes = times[rows], [*notes, *more]
    return FrameTable(times, laser_on, arc_on, current_a, exposure, table.lines[rows], tuple(notes))


def frame_times(
    series: ImageSeries,
    table: TimeSource | None,
    names: TimeSource | None,
    rate_hz: float | None,
    poses: PoseFile,
) -> TimeSource:
    """Return the images' times, s.

    One source may state them: a table, names or a rate; else the rows of the poses' file that name images, or
    the video itself.

    Raises ArctrackError if none does, or several, and for times that do not rise.
    """
    sources = [source for source in (table, names) if source is not None]
    if rate_hz is not None:
        counts = (np.array(series.indices) - series.indices[0]) / series.step
        sources.append(TimeSource(f"--rate-hz {rate_hz:g}", counts / rate_hz))
    if not sources and poses.times_s is not None and poses.rows is not None:
        sources.append(TimeSource(f"the rows of {poses.path.name}", poses.times_s[poses.rows]))
    if not sources and series.times is not None and np.isfinite(series.times.values).all():
        sources.append(series.times)
    if not sources:
        raise ArctrackError(
            f"{series.paths[0]}: nothing states the images' times; give --rate-hz, --times-in-names, or "
            "--frames with a column time_s"
        )
    if len(sources) > 1:
        both = f"{sources[0].name} and {sources[1].name} both state the images' times; leave one of them"
        problems = contradictions(sources[0], sources[1:], series.indices)
        raise ArctrackError("; ".join((both, *problems)))
    (source,) = sources
    times = source.values
    for n in np.flatnonzero(np.abs(times) > LIMITS.time_s):
        beyond = f"{times[n]:g} s, by {source.name}, is beyond {LIMITS.time_s:g} s"
        raise in_file(series.paths[n], f"{beyond}; give --units ms, us or ns")
    for n in np.flatnonzero(np.diff(times) <= 0.0) + 1:
        earlier = f"{times[n - 1]:.6f} s of {series.paths[n - 1].name}"
        raise in_file(series.paths[n], f"{times[n]:.6f} s does not come after {earlier}, by {source.name}")
    return source


def doubts(series: ImageSeries, used: TimeSource, poses: PoseFile, taken_s: Sequence[float]) -> list[str]:
    """Return warnings on times whose rate no camera has, and on what contradicts them.

    Held against them are a video's own times, times and numbers in the names of images, rows of the `poses`
    that name images, and `taken_s`, the times that the tags of images state.
    """
    times, frames = used.values, series.indices
    if len(times) < 2:
        return []
    others = [series.times] if series.times is not None else recognized_times(series.paths)
    # Rounding of DateTime of EXIF and TIFF.
    others.append(TimeSource("the times in the images' tags", np.array(taken_s), 1.0))
    others += [poses.image_times] if poses.image_times is not None else []
    if not any(source.is_count for source in others):
        others.append(TimeSource("the frames' numbers", np.array(frames, float), is_count=True))
    rate_hz = 1.0 / float(np.median(np.diff(times)))
    lines = []
    # Frame rates beyond these mean another unit of time.
    if not 0.01 <= rate_hz <= 5000.0:
        lines.append(f"{used.name}: {rate_hz:.3g} frames a second; in which unit are the times?")
    where = series.video or series.paths[0].parent
    return lines + [f"{where}: {line}" for line in contradictions(used, others, frames)]


def frame_rows(
    series: ImageSeries,
    times: Float64,
    table: FrameTable,
    conditions: FrameConditions,
    nominal_exposure_s: float,
) -> tuple[list[FrameRow], list[str]]:
    """Return the rows of frames.csv, and a note on each value that no table states.

    Raises ArctrackError for a value of the table that is beyond the limits, and for one that is stated twice.
    """
    count = len(series)
    for option, value, column in (
        ("--current-a", conditions.current_a, table.current_a),
        ("--exposure-s", conditions.exposure_s, table.exposure_s),
    ):
        if value is not None and column is not None:
            raise ArctrackError(f"{option} {value:g}: --frames states it image by image; leave one of them")
    burns = conditions.current_a is not None
    current = conditions.current_a if conditions.current_a is not None else 0.0
    exposure_s = nominal_exposure_s if conditions.exposure_s is None else conditions.exposure_s
    notes = []
    if table.laser_on is None:
        notes.append("laser_on 1")
    if table.arc_on is None and table.current_a is None:
        notes += [f"arc_on {int(burns)}", f"current_a {current:g}" + ("" if burns else " (no --current-a)")]
    if table.exposure_s is None:
        where = "" if conditions.exposure_s is not None else " (that of [camera])"
        notes.append(f"exposure_s {exposure_s:g}{where}")
    laser_on = np.ones(count) if table.laser_on is None else table.laser_on
    arc_on, current_a = _arc(table, count, burns, current)
    exposures_s = np.full(count, exposure_s) if table.exposure_s is None else table.exposure_s
    rows = [
        FrameRow(index, float(t), bool(laser), bool(arc), float(amperes), float(exposure))
        for index, t, laser, arc, amperes, exposure in zip(
            series.indices, times, laser_on, arc_on, current_a, exposures_s, strict=True
        )
    ]
    if conditions.columns is not None:
        for row, line in zip(rows, table.lines.tolist(), strict=True):
            check_frame(row, None, conditions.columns.path, line)
    return rows, notes


def _arc(table: FrameTable, count: int, burns: bool, current_a: float) -> tuple[Float64, Float64]:
    """Return the arc's state (n,) and current (n,), A: each follows from the other if need be."""
    if table.arc_on is None and table.current_a is None:
        return np.full(count, float(burns)), np.full(count, current_a)
    if table.arc_on is None and table.current_a is not None:
        return (np.nan_to_num(table.current_a) > 0.0).astype(np.float64), table.current_a
    arc_on = np.asarray(table.arc_on)
    if table.current_a is not None:
        return arc_on, table.current_a
    return arc_on, np.where(arc_on > 0.0, current_a if burns else math.nan, 0.0)
