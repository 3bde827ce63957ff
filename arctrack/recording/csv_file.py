"""Tables of numbers as text, read strictly and line by line: every complaint names the file and the line.

Columns are parted by semicolons, tabs, bars, commas or blanks: by the first of these that makes as many cells
of the head as of the first row. Numbers have decimal points, or decimal commas throughout. Lines that begin
with # or % are remarks; the last before rows of numbers is their head if it has as many cells.
"""

import csv
import io
import math
import re
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import numpy as np

from arctrack.errors import in_file
from arctrack.limits import LIMITS
from arctrack.printable import cut, first_of, shown
from arctrack.recording.files import UnfitFileError, blamed_on, is_utf16, not_utf8, open_file
from noise_model.compiled.arrays import Float64, Int64
from noise_model.spelling import nearest

Parser = Callable[[str], float]
"""Makes a number of a cell; ValueError says what it must be."""

_REMARKS = ("#", "%")
_EXCELS_SEPARATOR = re.compile(r"sep=.", re.IGNORECASE)
_QUOTED = re.compile(r'"[^"]*"')
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+(?:e[+-]?\d+)?\s*", re.IGNORECASE)
_DECIMAL_POINT = re.compile(r"\s*[+-]?\d*\.\d+(?:e[+-]?\d+)?\s*", re.IGNORECASE)
_INTEGER = re.compile(r"\s*[+-]?\d+\s*")


@dataclass(frozen=True, eq=False)
class CsvTable:
    """The wanted columns of a CSV file.

    `values` (n, columns) are its numbers, `lines` (n,) the line, from 1, of each row; `unknown_columns` are
    those that the file has besides.
    """

    path: Path
    columns: tuple[str, ...]
    values: Float64
    lines: Int64
    unknown_columns: tuple[str, ...]

    def column(self, name: str) -> Float64:
        """Return a column (n,)."""
        return self.values[:, self.columns.index(name)]

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user, one line each."""
        problems = [f"the column {cut(name)} is not known" for name in self.unknown_columns]
        return [f"{self.path}: {problem}" for problem in first_of(problems, "columns are not known")]


def number(text: str) -> float:
    """Return a finite number."""
    try:
        # Python alone takes 1_000 and digits of other scripts for numbers.
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


class TimeParser:
    """Parser of times, all numbers or all dates as ISO 8601 writes them; dates become Unix seconds.

    A date without a time zone (`lacks_zone`) is taken as UTC.
    """

    def __init__(self) -> None:
        self.are_dates = False
        self.lacks_zone = False
        self._is_begun = False

    def __call__(self, text: str) -> float:
        """Return a time, s or as the file has it."""
        try:
            value, is_date = number(text), False
        except ValueError:
            value, is_date = self._of_date(text), True
        if self._is_begun and is_date != self.are_dates:
            raise ValueError("is another kind of time than those before: dates and numbers do not mix")
        self._is_begun, self.are_dates = True, is_date
        return value

    def _of_date(self, text: str) -> float:
        try:
            date = datetime.fromisoformat(text.strip())
            if date.tzinfo is None:
                self.lacks_zone, date = True, date.replace(tzinfo=UTC)
            return date.timestamp()
        except (ValueError, OverflowError):
            example = "2024-05-01T10:00:00.125+02:00"
            raise ValueError(f"must be a finite number, or a date such as {example}") from None


def number_or_unknown(text: str) -> float:
    """Return a finite number, NaN for an empty cell."""
    return number(text) if text.strip() else math.nan


def whole(highest: int) -> Parser:
    """Return the parser of whole numbers from 0 to a highest one."""

    def parse(text: str) -> float:
        digits = text.strip()
        if not (digits.isascii() and digits.isdecimal() and len(digits) <= 18 and int(digits) <= highest):
            raise ValueError(f"must be a whole number from 0 to {highest}")
        return float(digits)

    return parse


def read_csv(
    path: Path, columns: Mapping[str, Parser], optional: Mapping[str, Parser] | None = None
) -> CsvTable:
    """Read the wanted columns of a CSV file with a header, and the optional ones that it has.

    Raises ArctrackError for a missing column, a value that its parser refuses, a file beyond the limits or
    of another kind.
    """
    with _opened(path) as records:
        return _parse(records, path, columns, optional or {})


def read_header(path: Path, wanted: str) -> tuple[str, ...]:
    """Return the names of a CSV file's columns; ArctrackError, which names `wanted`, if it has none."""
    with _opened(path) as records:
        line, header = next(records, (1, []))
        _check_is_header(header, wanted, line)
        row_line, row = next(records, (line, header))
        if len(row) not in (len(header), len(header) + 1):
            cure = f"if line {line} is no head, put # before it"
            raise UnfitFileError(f"{_wrong_count(row, len(header))} in line {line}; {cure}", row_line)
        return tuple(name.strip() for name in header)


def rows_once(table: CsvTable, time: str) -> tuple[CsvTable, int]:
    """Return a table without rows that repeat the row before, time and all, and how many they were.

    Raises ArctrackError, with both lines, for other rows whose time does not rise.
    """
    times = table.column(time)
    repeats = np.zeros(len(times), dtype=bool)
    repeats[1:] = (table.values[1:] == table.values[:-1]).all(axis=1)
    for n in np.flatnonzero((np.diff(times) <= 0.0) & ~repeats[1:]) + 1:
        earlier = f"{times[n - 1]:.6f} of line {table.lines[n - 1]}"
        stated = f"{time} = " if time else ""
        problem = f"{stated}{times[n]:.6f} does not come after {earlier}"
        cure = "one time has two poses" if times[n] == times[n - 1] else "times must rise"
        raise in_file(table.path, f"{problem}: {cure}", line=int(table.lines[n]))
    if not repeats.any():
        return table, 0
    once = replace(table, values=table.values[~repeats], lines=table.lines[~repeats])
    return once, int(repeats.sum())


@contextmanager
def _opened(path: Path) -> Iterator[Iterator[tuple[int, list[str]]]]:
    """Open a CSV file for its records; what is wrong becomes an ArctrackError that names the file."""
    with blamed_on(path), open_file(path, LIMITS.csv_bytes) as file:
        if is_utf16(file.peek(2)[:2]):
            raise UnfitFileError("is UTF-16: save it as UTF-8")
        with io.TextIOWrapper(file, encoding="utf-8-sig", newline="") as text:
            yield _records(text)


def _parse(
    records: Iterator[tuple[int, list[str]]],
    path: Path,
    needed: Mapping[str, Parser],
    optional: Mapping[str, Parser],
) -> CsvTable:
    line, header = next(records, (1, []))
    header = [name.strip() for name in header]
    _check_header(header, tuple(needed), tuple(optional), line)
    parsers = {name: parse for name, parse in {**needed, **optional}.items() if name in header}
    places = [(header.index(name), name, parse) for name, parse in parsers.items()]
    values, lines = array("d"), array("q")
    decimals = _DecimalSign()
    for line, cells in records:
        if len(cells) == len(header) + 1 and not cells[-1].strip():
            # A separator at the line's end.
            cells.pop()
        if len(cells) != len(header):
            is_last = next(records, None) is None
            cut_off = "; the file is cut off: leave its last line out" if is_last and lines else ""
            raise UnfitFileError(_wrong_count(cells, len(header)) + cut_off, line)
        if not lines and not any(map(str.isdigit, "".join(cells))):
            cure = "put # before it, and state units by --units or in names such as x_mm"
            raise UnfitFileError(f"holds no number: if it is a row of units, {cure}", line)
        if len(lines) == LIMITS.csv_rows:
            raise UnfitFileError(f"holds more than {LIMITS.csv_rows} rows: that is the most", line)
        for place, name, parse in places:
            try:
                values.append(parse(decimals.with_point(cells[place])))
            except ValueError as error:
                raise UnfitFileError(f"{name} = {shown(cells[place])}: {error}", line) from None
        lines.append(line)
    if not lines:
        raise UnfitFileError("holds no rows")
    return CsvTable(
        path,
        tuple(parsers),
        np.frombuffer(values, dtype=np.float64).reshape(len(lines), len(parsers)).copy(),
        np.frombuffer(lines, dtype=np.int64).copy(),
        tuple(name for name in header if name not in parsers),
    )


def _check_header(header: Sequence[str], needed: Sequence[str], optional: Sequence[str], line: int) -> None:
    """Raise UnfitFileError unless each needed column is named once, an optional one once at most."""
    for name in optional:
        if header.count(name) > 1:
            raise UnfitFileError(f"the column {name} occurs twice", line)
    wrong = [name for name in needed if header.count(name) != 1]
    if not wrong:
        return
    wanted = ",".join(needed)
    _check_is_header(header, wanted, line)
    problem = "occurs twice" if wrong[0] in header else "is missing"
    near = nearest(wrong[0], (name for name in header if name not in needed))
    hint = "" if near is None else f" (there is {cut(near)})"
    raise UnfitFileError(f"the column {wrong[0]} {problem}{hint}; needed are {wanted}", line)


def _check_is_header(header: Sequence[str], wanted: str, line: int) -> None:
    """Raise UnfitFileError for a first line that names no columns of a CSV file."""
    if not header:
        raise UnfitFileError(f"is empty; needed are {wanted}", line)
    if "\0" in "".join(header):
        raise UnfitFileError("holds NUL bytes: save it as UTF-8 text", line)
    if all(map(_is_number, header)):
        raise UnfitFileError(f"holds numbers where the header should be: begin the file with {wanted}", line)


def _is_number(text: str) -> bool:
    try:
        number(text)
    except ValueError:
        return False
    return True


def _wrong_count(cells: Sequence[str], expected: int) -> str:
    problem = f"has {len(cells)} values where the header names {expected}"
    # 0,5,100 for 0.5,100: no cell has a point, and there are more than there should be.
    if len(cells) > expected and all(map(_INTEGER.fullmatch, cells)):
        problem += "; is the comma a decimal sign? write points"
    return problem


class _DecimalSign:
    """The decimal sign of a table: a point or a comma, one throughout."""

    def __init__(self) -> None:
        self._with_comma = ""
        self._with_point = ""

    def with_point(self, cell: str) -> str:
        """Return a cell, its decimal comma made a point; ValueError where both signs occur."""
        if "," in cell and _DECIMAL_COMMA.fullmatch(cell):
            self._with_comma, number_text = cell.strip(), cell.replace(",", ".")
        elif not self._with_point and "." in cell and _DECIMAL_POINT.fullmatch(cell):
            self._with_point = number_text = cell.strip()
        else:
            return cell
        if self._with_comma and self._with_point:
            both = f"{self._with_point} and {self._with_comma}"
            raise ValueError(f"the file writes {both}: write all numbers with points")
        return number_text


def _records(file: Iterator[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the head, each line that holds something, and its number; UnfitFileError where it is no table."""
    begin: list[str] = []
    line = 0
    try:
        separator = _begin(file, begin)
        lines: Iterator[str] = chain(begin, ("\n" if text.startswith(_REMARKS) else text for text in file))
        if separator == " ":
            lines = (text.replace("\t", " ").strip() + "\n" for text in lines)
        reader = csv.reader(lines, strict=True, delimiter=separator, skipinitialspace=separator == " ")
        for cells in reader:
            line = reader.line_num
            if cells:
                yield line, cells
    except csv.Error as error:
        raise UnfitFileError(f"is no valid CSV: {error}", reader.line_num) from None
    except UnicodeDecodeError as error:
        raise not_utf8(error, max(line, len(begin)) + 1) from None


def _begin(file: Iterator[str], begin: list[str]) -> str:
    """Read a table to its second line that is no remark, and return what parts its columns.

    `begin` takes the lines that were read. Remarks among them are made empty, but for one that is the head.
    """
    remarks: list[tuple[int, str]] = []
    contents: list[str] = []
    for text in file:
        stripped = text.strip(" \r\n")
        begin.append(text)
        if stripped.startswith(_REMARKS) or _EXCELS_SEPARATOR.fullmatch(stripped):
            begin[-1] = "\n"
            remarks.append((len(begin) - 1, stripped.lstrip("#% ")))
        elif stripped:
            contents.append(stripped)
            if len(contents) == 2:
                break
    if not contents:
        return ","
    row = contents[0]
    separator = _separator(row, contents[-1])
    if all(map(_is_time_or_number, _cells(row, separator))):
        for place, remark in reversed(remarks):
            separator_of_both = _separator(remark, row)
            names = _cells(remark, separator_of_both)
            # Units below the names repeat.
            if len(set(names)) == len(_cells(row, separator_of_both)) == len(names) > 1:
                begin[place] = remark + "\n"
                return separator_of_both
    return separator


def _separator(head: str, row: str) -> str:
    """Return the separator of columns by which a head and a row agree."""
    possible = [separator for separator in (";", "\t", "|", ",", " ") if len(_cells(head, separator)) > 1]
    for separator in possible:
        if len(_cells(head, separator)) == len(_cells(row, separator)):
            return separator
    return possible[0] if possible else ","


def _cells(text: str, separator: str) -> list[str]:
    bare = _QUOTED.sub("q", text).rstrip(separator)
    return bare.split() if separator == " " else bare.split(separator)


def _is_time_or_number(text: str) -> bool:
    try:
        TimeParser()(text.replace(",", "."))
    except ValueError:
        return False
    return True
