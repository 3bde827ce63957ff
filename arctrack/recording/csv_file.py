"""The CSV files of a recording, read strictly: every complaint names the file and the line."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from arctrack.errors import in_file


@dataclass(frozen=True)
class CsvTable:
    """The wanted columns of a CSV file as text.

    `rows` holds one tuple per data line in the wanted columns' order, `lines` the line (from 1) of each;
    `unknown_columns` are those that the file has besides.
    """

    path: Path
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    unknown_columns: tuple[str, ...]

    def number(self, row: int, column: int) -> float:
        """Return a value as a finite float."""
        text = self.rows[row][column]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            name = self.columns[column]
            raise in_file(self.path, f"{name} = {text!r}: must be a finite number", line=self.lines[row])
        return value

    def whole(self, row: int, column: int, highest: int) -> int:
        """Return a value as an integer of 0 to `highest`."""
        text = self.rows[row][column].strip()
        if not (text.isascii() and text.isdecimal() and len(text) <= 18 and int(text) <= highest):
            name = self.columns[column]
            raise in_file(
                self.path,
                f"{name} = {text!r}: must be a whole number from 0 to {highest}",
                line=self.lines[row],
            )
        return int(text)


def check_is_file(path: Path) -> None:
    """Raise ArctrackError if a file of measurements is not there, or a folder."""
    if path.is_dir():
        raise in_file(path, "is a folder; give the CSV file itself")
    if not path.is_file():
        raise in_file(path, "there is no such file")


def read_csv(path: Path, columns: Sequence[str]) -> CsvTable:
    """Read the wanted columns of a CSV file with a header; ArctrackError if a column is missing."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return _parse(file, path, tuple(columns))
    except FileNotFoundError:
        raise in_file(path, "there is no such file; a recording needs one") from None
    except (OSError, UnicodeDecodeError) as error:
        raise in_file(path, f"cannot be read: {error}") from None


def _parse(file: Iterable[str], path: Path, columns: tuple[str, ...]) -> CsvTable:
    records = _records(file, path)
    _, header = next(records, (1, []))
    header = [name.strip() for name in header]
    for name in columns:
        if header.count(name) != 1:
            problem = "occurs twice" if name in header else "is missing"
            raise in_file(path, f"the column {name} {problem}; needed are {','.join(columns)}", line=1)
    places = [header.index(name) for name in columns]
    rows: list[tuple[str, ...]] = []
    lines: list[int] = []
    for line, cells in records:
        if len(cells) != len(header):
            problem = f"has {len(cells)} values where the header names {len(header)}"
            raise in_file(path, problem, line=line)
        rows.append(tuple(cells[place] for place in places))
        lines.append(line)
    if not rows:
        raise in_file(path, "holds no rows")
    unknown = tuple(name for name in header if name not in columns)
    return CsvTable(path, columns, tuple(rows), tuple(lines), unknown)


def _records(file: Iterable[str], path: Path) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(file, strict=True)
    try:
        for cells in reader:
            if cells:
                yield reader.line_num, cells
    except csv.Error as error:
        raise in_file(path, f"is no valid CSV: {error}", line=reader.line_num) from None
