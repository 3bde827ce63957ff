"""The robot's poses from a user's files, as T_base_tool in mm."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.limits import LIMITS
from arctrack.recording.csv_file import CsvTable, Parser, TimeParser, number, read_csv, rows_once
from arctrack.recording.files import blamed_on, open_file, read_bytes
from arctrack.recording.importing.columns import (
    FILE_NAMES,
    FRAME_NAMES,
    UNKNOWN_IMAGE,
    Column,
    CsvColumns,
    frame_number,
    image_parser,
    rows_of_images,
    times_s,
)
from arctrack.recording.importing.controller_listings import LISTED, LISTING_SUFFIXES, find_poses
from arctrack.recording.importing.image_files import ImageSeries
from arctrack.recording.importing.matrix_files import read_matrices
from arctrack.recording.importing.rotations import (
    BY_ITS_NAMES,
    CONVENTIONS,
    MATRIX,
    Convention,
    NoRotationError,
    convention,
)
from arctrack.recording.importing.units import ANGLE, LENGTH, TIME, UNITS, Units, factor
from arctrack.recording.poses import read_log
from arctrack.recording.time_sources import TimeSource
from noise_model.compiled.arrays import Float64, Int64

POSITION_NAMES = tuple(
    (axis, f"pos_{axis}", f"t{axis}", f"actual_tcp_pose_{n}") for n, axis in enumerate("xyz")
)

JOINT_NAMES = tuple(
    [f"{stem}{n - 1 if stem == 'actual_q_' else n}" for n in range(1, 8)]
    for stem in ("j", "q", "joint_", "joint", "axis_", "a", "rax_", "actual_q_")
)
"""Names of the columns of joint angles, set by set; --column takes the first."""


@dataclass(frozen=True)
class PoseFile:
    """The poses of a file.

    `T_base_tool` (n, 4, 4), mm; `times_s` (n,) if the file has times; `rows` (images,) the row of each image,
    if the file says it or has no times, -1 for none; `units` as read, for people; `warnings` where they look
    wrong; `rotation` (n, 3) or (n, 4) the numbers of the rotation as the file has them, None of matrices;
    `image_times` what rows say of the images' times where these are from elsewhere; `rotation_columns` the
    headers of the numbers of the rotation, none of a listing; `joint_rad` (n, joints) the robot's joint
    angles, None if the file has none or they were not asked for.
    """

    path: Path
    T_base_tool: Float64
    times_s: Float64 | None
    rows: Int64 | None
    units: str
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    rotation: Float64 | None = None
    image_times: TimeSource | None = None
    rotation_columns: tuple[str, ...] = ()
    joint_rad: Float64 | None = None


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
    T_base_tool, notes = read_matrices(rotations, translations, factor(LENGTH, stated.length))
    if len(T_base_tool) != len(series):
        raise in_file(
            rotations, f"holds {len(T_base_tool)} poses for {len(series)} images: one each is needed"
        )
    warnings = _doubts(T_base_tool[:, :3, 3], stated.length, translations or rotations)
    rows = np.arange(len(series))
    return PoseFile(rotations, T_base_tool, None, rows, stated.length, notes, tuple(warnings))


def read_pose_table(
    columns: CsvColumns,
    rotation: str | None,
    stated: Units,
    series: ImageSeries,
    is_timed: bool,
    *,
    may_lack: bool = False,
    with_joints: bool = False,
) -> PoseFile:
    """Return the poses of a CSV file.

    Rows with times are the images' own only if these have no times from elsewhere, `is_timed`. Joint angles
    are read `with_joints`.

    Raises ArctrackError for a column that is missing, a unit that nothing states, numbers that contradict it,
    a rotation that is none, times that do not rise, and as `rows_of_images`.
    """
    place = [columns.need(names) for names in POSITION_NAMES]
    written, turn = _rotation_columns(columns, rotation)
    joints = _joint_columns(columns, turn) if with_joints else []
    time = columns.find_time()
    frame, file = None, None
    if time is None or not is_timed:
        frame, file = columns.find(FRAME_NAMES), columns.find(FILE_NAMES)
    parsers: dict[str, Parser] = {column.header: number for column in (*place, *turn, *joints)}
    time_parser = TimeParser()
    if time is not None:
        parsers[time.header] = time_parser
    named = None
    if file is not None:
        parsers[file.header] = image_parser(series)
    elif frame is not None:
        parsers[frame.header] = frame_number
    elif time is not None:
        named = columns.find(FILE_NAMES) or columns.find(FRAME_NAMES)
    if named is not None:
        parsers[named.header] = _lenient_parser(series, columns.find(FILE_NAMES) is not None)
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
    numbers = _column_values(table, turn)
    T_base_tool, warnings = _matrices(
        columns.path, _column_values(table, place), numbers, table.lines, written, units
    )
    joint_rad, doubts = _joint_angles(columns, joints, table, stated, written)
    warnings += doubts
    times, rows = None, None
    if time is not None:
        times, more = times_s(columns, table, time, stated, time_parser)
        _check_size(times, columns.path)
        notes += more
    if time is None or file is not None or frame is not None:
        rows, more = rows_of_images(table, frame, file, series, may_lack=may_lack)
        notes += more
    image_times = None
    if named is not None and times is not None:
        image_times = _times_of_images(table.column(named.header), times, series, columns.path)
    spoken = ", ".join(dict.fromkeys(units))
    headers = tuple(column.header for column in turn)
    more_of_file = tuple(notes), tuple(warnings), numbers, image_times, headers, joint_rad
    return PoseFile(columns.path, T_base_tool, times, rows, spoken, *more_of_file)


def _lenient_parser(series: ImageSeries, are_files: bool) -> Parser:
    """Return the parser of file names or frame numbers: an image's position, -1 for anything else."""
    if are_files:
        return image_parser(series)
    positions = {index: n for n, index in enumerate(series.indices)}
    return lambda text: positions.get(int(text), UNKNOWN_IMAGE) if text.isdecimal() else UNKNOWN_IMAGE


def _times_of_images(positions: Float64, times: Float64, series: ImageSeries, path: Path) -> TimeSource:
    """Return the times of the rows that name images, NaN for an image of none or of several rows."""
    rows, counts = np.unique(positions[positions != UNKNOWN_IMAGE].astype(np.int64), return_counts=True)
    image_times = np.full(len(series), np.nan)
    for position in rows[counts == 1].tolist():
        image_times[position] = times[np.argmax(positions == position)]
    return TimeSource(f"the rows of {path.name}", image_times)


def read_listing(
    path: Path, rotation: str, stated: Units, series: ImageSeries, *, may_lack: bool = False
) -> PoseFile | None:
    """Return the poses of a file in which a controller keeps its points; None for a file that is none.

    A time, or an image's name, may stand before each pose on its line. Else each image needs a pose.

    Raises ArctrackError for a point without a pose, a rotation that is none, times that do not rise, another
    number of poses than images, and as `rows_of_images`.
    """
    if rotation not in LISTED:
        return None
    with blamed_on(path):
        listed = find_poses(read_bytes(path, LIMITS.csv_bytes).decode("latin-1"), rotation)
    if listed is None:
        return None
    written = _stated(rotation)
    kinds = (LENGTH, ANGLE) if written.are_angles else (LENGTH,)
    units = [stated.of_kind(kind) or written.units.of_kind(kind) or "" for kind in kinds]
    names = ("", *map(str, range(listed.numbers.shape[1])))
    table = CsvTable(path, names, np.column_stack([listed.lines, listed.numbers]), listed.lines, ())
    notes, times, rows = [f"as {rotation} lists them"], None, None
    parser = TimeParser()
    images = [image_parser(series)(text) for text in listed.before]
    try:
        times = np.array([parser(text) for text in listed.before])
    except ValueError:
        if any(image != UNKNOWN_IMAGE for image in images):
            table.values[:, 0] = images
            rows, more = rows_of_images(table, None, Column("", None), series, may_lack=may_lack)
            notes += more
        elif len(table.lines) == len(series):
            rows = np.arange(len(series))
        else:
            counts = f"{len(table.lines)} poses for {len(series)} images"
            cure = "one each is needed, or a time or an image's name before each pose"
            raise in_file(path, f"lists {counts}: {cure}") from None
    else:
        unit = "s" if parser.are_dates else stated.time
        if unit is None:
            choice = " or ".join(UNITS[TIME])
            raise in_file(path, f"the times before its poses state no unit: give --units {choice}")
        table.values[:, 0] = times * factor(TIME, unit)
        _check_size(table.values[:, 0], path)
        table, repeats = rows_once(table, "")
        times = table.column("")
        notes += [f"{repeats} rows repeat the row before and are left out"] if repeats else []
    values = table.values[:, 1:]
    T_base_tool, warnings = _matrices(
        path, values[:, :3], values[:, 3:], table.lines, written, [*units[:1] * 3, *units[1:]]
    )
    spoken = ", ".join(units)
    return PoseFile(
        path=path,
        T_base_tool=T_base_tool,
        times_s=times,
        rows=rows,
        units=spoken,
        notes=tuple(notes),
        warnings=tuple(warnings),
        rotation=values[:, 3:],
    )


def _stated(rotation: str | None) -> Convention:
    return BY_ITS_NAMES if rotation is None else convention(rotation)


def _rotation_columns(columns: CsvColumns, rotation: str | None) -> tuple[Convention, list[Column]]:
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


def _joint_columns(columns: CsvColumns, taken: list[Column]) -> list[Column]:
    """Return the columns of joint angles in their order, none if there are none; the rotation's are `taken`.

    Raises ArctrackError for a joint that lacks between others.
    """
    roles = JOINT_NAMES[0]
    for names in JOINT_NAMES:
        by_joint = [columns.find((name,), role) for name, role in zip(names, roles, strict=True)]
        held = [column for column in by_joint if column is not None and column not in taken]
        # Four of q1 to q4 are a quaternion; an arm has three joints at the least.
        if len(held) < (5 if names[0] == "q1" else 3):
            continue
        if by_joint[: len(held)] != held:
            raise columns.lacks(roles[by_joint.index(None)])
        return held
    return []


def _joint_angles(
    columns: CsvColumns, joints: list[Column], table: CsvTable, stated: Units, written: Convention
) -> tuple[Float64 | None, list[str]]:
    """Return the joint angles (n, joints), rad, None of no columns, and warnings."""
    if not joints:
        return None, []
    units = {columns.unit(column, ANGLE, stated, written.units) for column in joints}
    if len(units) > 1:
        headers = f"{joints[0].header} to {joints[-1].header}"
        raise in_file(columns.path, f"the columns {headers}: joint angles need one unit, deg or rad")
    (unit,) = units
    angles = _column_values(table, joints)
    return angles * factor(ANGLE, unit), _angle_doubts(angles, unit, columns.path)


def _column_values(table: CsvTable, columns: list[Column]) -> Float64:
    return np.stack([table.column(column.header) for column in columns], axis=1)


def _matrices(
    path: Path, places: Float64, numbers: Float64, lines: Int64, written: Convention, units: list[str]
) -> tuple[Float64, list[str]]:
    """Return T_base_tool (n, 4, 4), mm, of numbers in three units of length and those of angles; warnings."""
    T_base_tool = np.tile(np.eye(4), (len(places), 1, 1))
    try:
        T_base_tool[:, :3, :3] = written.matrices(numbers * (factor(ANGLE, units[3]) if units[3:] else 1.0))
    except NoRotationError as error:
        raise in_file(path, str(error), line=int(lines[error.row])) from None
    T_base_tool[:, :3, 3] = places * factor(LENGTH, units[0])
    warnings = _doubts(T_base_tool[:, :3, 3], units[0], path)
    if written.are_angles:
        warnings += _angle_doubts(numbers, units[3], path)
    return T_base_tool, warnings


def _doubts(positions_mm: Float64, unit: str, path: Path) -> list[str]:
    """Return warnings on positions that look to be of another unit; ArctrackError where they must be."""
    reach_mm = float(np.abs(positions_mm).max())
    # No robot's base is a hundred metres away.
    if unit == "m" and reach_mm > 1e5:
        raise in_file(path, f"coordinates reach {reach_mm / 1e3:.4g} m: they are mm; give --units mm")
    if reach_mm > LIMITS.length_mm:
        raise in_file(
            path, f"a coordinate of {reach_mm:g} mm is beyond {LIMITS.length_mm:g} mm; in which unit?"
        )
    # No robot works within 2 mm of its base's origin.
    if unit == "mm" and 0.0 < reach_mm <= 2.0:
        return [f"{path}: coordinates stay within {reach_mm:.4g} mm of base's origin; are they m?"]
    return []


def _angle_doubts(angles: Float64, unit: str, path: Path) -> list[str]:
    largest = float(np.abs(angles).max())
    # Controllers write less than two turns.
    if unit == "rad" and largest > 4.0 * math.pi:
        raise in_file(path, f"angles reach {largest:.4g} rad: they are degrees; give --units deg")
    if unit == "deg" and 0.0 < largest <= 2.0 * math.pi:
        return [f"{path}: angles stay within {largest:.4g} deg; are they rad?"]
    return []


def _check_size(times: Float64, path: Path) -> None:
    if np.abs(times).max() > LIMITS.time_s:
        raise in_file(
            path, f"{np.abs(times).max():g} s is beyond {LIMITS.time_s:g} s; give --units ms, us or ns"
        )


def _is_bus_log(path: Path) -> bool:
    """Return True if a file is a CAN log by its name; a `.log` of candump begins with a parenthesis."""
    suffix = path.suffix.lower()
    if suffix != ".log":
        return suffix in (".asc", ".blf", ".trc")
    with blamed_on(path), open_file(path, LIMITS.log_bytes) as file:
        return file.peek(1).lstrip()[:1] == b"("


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
    with_joints: bool = False,
    can_channel: str | None = None,
) -> tuple[PoseFile, list[CsvColumns]]:
    """Return the poses of a table, a listing, matrices or a CAN log, and the columns of a table.

    Where images `may_lack` a pose, their row is -1. Joint angles of a table are read `with_joints`.
    `can_channel` is the robot's in a log.

    Raises ArctrackError as `read_pose_table` and `read_matrix_poses`.
    """
    if translations is not None and rotation not in (None, MATRIX):
        raise ArctrackError(f"--translations: has no effect with --rotation {rotation}; leave one of them")
    if translations is not None or rotation == MATRIX:
        return read_matrix_poses(path, translations, stated, series), []
    if _is_bus_log(path):
        poses, warnings = read_log(path, can_channel)
        T_base_tool, times = poses.T_base_tool, poses.timestamps_s
        return PoseFile(path, T_base_tool, times, None, "mm", (), tuple(warnings)), []
    listed = None if rotation is None else read_listing(path, rotation, stated, series, may_lack=may_lack)
    if listed is not None:
        return listed, []
    if rotation in LISTED and path.suffix.lower() in LISTING_SUFFIXES:
        raise in_file(path, f"holds no pose as {rotation} lists them: give the file that holds the points")
    wanted = ",".join((*known_names(rotation), "and a time, frame or file if there is one"))
    columns = CsvColumns(path, named, wanted)
    read = read_pose_table(
        columns, rotation, stated, series, is_timed, may_lack=may_lack, with_joints=with_joints
    )
    return read, [columns]
