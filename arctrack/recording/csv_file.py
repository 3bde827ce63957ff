"""CSV files of numbers, read strictly and line by line: every complaint names the file and the line."""

from __future__ import annotations

import csv
import io
import math
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arctrack.limits import LIMITS
from arctrack.printable import cut, first_of, shown
from arctrack.recording.files import UnfitFileError, blamed_on, is_utf16, not_utf8, open_file
from noise_model.arrays import Float64, Int64
from noise_model.spelling import nearest

Parser = Callable[[str], float]
"""Makes a number of a cell; ValueError says what it must be."""

SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}

_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+\s*")
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
        """What to tell a user of it, one line each."""
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
        cure = "; write a point, not a comma" if _DECIMAL_COMMA.fullmatch(text) else ""
        raise ValueError(f"must be a finite number{cure}")
    return value


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
        return tuple(name.strip() for name in header)


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
    for line, cells in records:
        if len(cells) != len(header):
            raise UnfitFileError(_wrong_count(cells, len(header)), line)
        if len(lines) == LIMITS.csv_rows:
            raise UnfitFileError(f"holds more than {LIMITS.csv_rows} rows: that is the most", line)
        for place, name, parse in places:
            try:
                values.append(parse(cells[place]))
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
    for separator, name in SEPARATORS.items():
        if len(header) == 1 and separator in header[0]:
            raise UnfitFileError(
                f"its columns are parted by {name}: save it with commas between and points in numbers", line
            )
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


def _records(file: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield each line that holds something and its number; UnfitFileError where it is no CSV."""
    reader = csv.reader(file, strict=True)
    try:
        for cells in reader:
            if cells:
                yield reader.line_num, cells
    except csv.Error as error:
        raise UnfitFileError(f"is no valid CSV: {error}", reader.line_num) from None
    except UnicodeDecodeError as error:
        raise not_utf8(error, reader.line_num + 1) from None
