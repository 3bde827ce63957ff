"""Columns of a user's CSV file, recognised by their names in any order, or named by the user."""

import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.limits import LIMITS
from arctrack.printable import cut
from arctrack.recording.csv_file import CsvTable, TimeParser, read_header, whole
from arctrack.recording.importing.image_files import ImageSeries
from arctrack.recording.importing.units import TIME, UNITS, UNSTATED, Units, factor, split_unit, unit_of
from noise_model.compiled.arrays import Float64, Int64
from noise_model.spelling import nearest

TIME_NAMES = ("time", "timestamp", "t", "stamp")
FRAME_NAMES = ("frame",)
FILE_NAMES = ("file", "filename", "file_name")
"""Names of a column: the first is the user's name of it in --column."""

UNKNOWN_IMAGE = -1


@dataclass(frozen=True)
class Column:
    """A column of a file: its header as it stands, and the unit that this states, None if none."""

    header: str
    unit: str | None


class CsvColumns:
    """Columns of a CSV file; raises ArctrackError if it has no header.

    `named` maps the user's names of columns to their headers; messages list the `wanted` columns.
    """

    def __init__(self, path: Path, named: Mapping[str, str], wanted: str) -> None:
        self.path = path
        self.headers = read_header(path, wanted)
        self._named = named

    def find(self, names: Sequence[str], role: str | None = None) -> Column | None:
        """Return the column that the user calls a role, or a header by one of some names; None if none is.

        The role is the first of the names unless stated. Raises ArctrackError if several columns fit.
        """
        role = names[0] if role is None else role
        header = self._named.get(role)
        if header in self.headers:
            return Column(header, split_unit(header)[1])
        fitting = [
            Column(header, unit)
            for header in self.headers
            for name, unit in [split_unit(header)]
            if name in names or header.lower() in names
        ]
        if len(fitting) > 1:
            if fitting[0].header == fitting[1].header:
                raise in_file(self.path, f"the column {cut(fitting[0].header)} occurs twice: rename one")
            both = " and ".join(cut(column.header) for column in fitting[:2])
            raise in_file(
                self.path, f"{both} may both be {role}; say which, as by --column {role}={fitting[0].header}"
            )
        return fitting[0] if fitting else None

    def find_time(self) -> Column | None:
        """Return the column of times, None if there is none.

        A bare T is none unless the user says so: KUKA's controllers call a pose's turn by that.
        """
        column = self.find(TIME_NAMES)
        is_bare = column is not None and column.header.lower() == "t"
        return None if is_bare and TIME_NAMES[0] not in self._named else column

    def need(self, names: Sequence[str]) -> Column:
        """Return the column of one of some names; ArctrackError if there is none."""
        column = self.find(names)
        if column is None:
            raise self.lacks(names[0])
        return column

    def lacks(self, name: str) -> ArctrackError:
        """Return the error that a missing column makes."""
        near = nearest(name, self.headers) or "NAME"
        held = ", ".join(map(cut, self.headers[:12])) + (", …" if len(self.headers) > 12 else "")
        return in_file(
            self.path, f"no column is called {name}; name it, as by --column {name}={near}; there are {held}"
        )

    def unit(self, column: Column, kind: str, stated: Units, assumed: Units) -> str:
        """Return the unit of a column, as its header, the user or a convention states it.

        Raises ArctrackError if nothing states it, or if header and user disagree.
        """
        try:
            unit = unit_of(kind, column.unit, stated, assumed)
        except ValueError as error:
            raise in_file(self.path, f"the column {cut(column.header)}: {error}") from None
        if unit is None:
            choice = " or ".join(UNITS[kind])
            raise in_file(self.path, f"the column {cut(column.header)} states no unit: give --units {choice}")
        return unit


def check_all_named(named: Mapping[str, str], known: Iterable[str], files: Sequence[CsvColumns]) -> None:
    """Raise ArctrackError for a name of --column that means nothing, and for a header that no file has."""
    names = list(known)
    for name, header in named.items():
        if name not in names:
            raise ArctrackError(
                f"--column {name}={header}: {name} is not known; there are {', '.join(names)}"
            )
        if not any(header in file.headers for file in files):
            near = nearest(header, (other for file in files for other in file.headers))
            hint = "" if near is None else f"; did you mean {cut(near)}?"
            raise ArctrackError(f"--column {name}={header}: no file has a column of this name{hint}")


def image_parser(series: ImageSeries) -> Callable[[str], float]:
    """Return the parser of file names: an image's position in a series, -1 for another name."""
    # macOS writes an umlaut as two characters, other systems as one.
    positions = {unicodedata.normalize("NFC", path.name): n for n, path in enumerate(series.paths)}

    def parse(text: str) -> float:
        name = unicodedata.normalize("NFC", text).strip().replace("\\", "/").rsplit("/", 1)[-1]
        return float(positions.get(name, UNKNOWN_IMAGE))

    return parse


frame_number = whole(LIMITS.frame_number)


def rows_of_images(
    table: CsvTable, frame: Column | None, file: Column | None, series: ImageSeries, *, may_lack: bool = False
) -> tuple[Int64, list[str]]:
    """Return the row (n,) of a table that belongs to each image, and notes.

    A column of file names or of frame numbers says it; else the n-th row belongs to the n-th image. An image
    without a row has -1 if it `may_lack` one.

    Raises ArctrackError for another image without a row, for two rows of one, and without such a column if
    there are more or fewer rows than images.
    """
    rows = len(table.lines)
    if file is not None:
        positions = table.column(file.header).astype(np.int64)
    elif frame is not None:
        places = {index: n for n, index in enumerate(series.indices)}
        numbers = table.column(frame.header).astype(np.int64).tolist()
        positions = np.array([places.get(number, UNKNOWN_IMAGE) for number in numbers])
    elif rows == len(series):
        return np.arange(rows), []
    else:
        counts = f"{rows} rows for {len(series)} images"
        raise in_file(table.path, f"has {counts}: add a column time, file or frame that says which is whose")
    row_of: dict[int, int] = {}
    for n, position in enumerate(positions.tolist()):
        if position != UNKNOWN_IMAGE and row_of.setdefault(position, n) != n:
            name = series.paths[position].name
            raise in_file(table.path, f"has a second row for {name}", line=int(table.lines[n]))
    missing = next((n for n in range(len(series)) if n not in row_of), None)
    if missing is not None and not may_lack:
        key = "file" if file is not None else f"frame {series.indices[missing]}"
        raise in_file(
            table.path, f"has no row for {series.paths[missing].name} ({key}); add it, or leave the image out"
        )
    spare = rows - len(row_of)
    notes = [f"{spare} rows of {table.path.name} are of no image"] if spare else []
    return np.array([row_of.get(n, UNKNOWN_IMAGE) for n in range(len(series))]), notes


def times_s(
    columns: CsvColumns, table: CsvTable, column: Column, stated: Units, parser: TimeParser
) -> tuple[Float64, list[str]]:
    """Return a column of times in s, and notes; ArctrackError if nothing states the unit of numbers."""
    times = table.column(column.header)
    if parser.are_dates:
        return times, ["dates without a time zone are taken as UTC"] if parser.lacks_zone else []
    return np.asarray(times * factor(TIME, columns.unit(column, TIME, stated, UNSTATED))), []
