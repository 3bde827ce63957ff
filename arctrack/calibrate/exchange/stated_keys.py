"""Keys of another program's file: numbers and texts, or the line of error that names the key."""

import math
from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any, NoReturn

from arctrack.recording.files import UnfitFileError
from arctrack.recording.key_errors import held

MAX_SIDE = 10**6
"""Largest width and height, px, of an image that a file can state."""


class StatedKeys:
    """Keys of a table; `place` stands before a key in messages. A key may go by several names."""

    def __init__(self, table: Mapping[str, Any], place: str = "") -> None:
        self._table = table
        self._place = place

    def __contains__(self, name: str) -> bool:
        return name in self._table

    def refuse(self, name: str, problem: str) -> NoReturn:
        """Raise UnfitFileError with a key, what it holds, and the problem."""
        raise UnfitFileError(f"{held(self._place + name, self._table.get(name, ''))}: {problem}")

    def table(self, name: str) -> Mapping[str, Any]:
        """Return a table, empty if there is none."""
        value = self._table.get(name) or {}
        return value if isinstance(value, Mapping) else self.refuse(name, "must be a table")

    def text(self, *names: str, default: str | None = None) -> str:
        """Return a text, without blanks around it."""
        name, value = self._find(names, default)
        return value.strip() if isinstance(value, str) else self.refuse(name, "must be a text")

    def number(self, *names: str, default: float | None = None) -> float:
        """Return a finite number."""
        name, value = self._find(names, default)
        return _number(self._place + name, value)

    def whole(self, *names: str, default: int | None = None) -> int:
        """Return a whole number of px, 0 or more."""
        name, value = self._find(names, default)
        number = _number(self._place + name, value)
        if not (number.is_integer() and 0 <= number <= MAX_SIDE):
            self.refuse(name, f"must be a whole number, 0 to {MAX_SIDE}")
        return int(number)

    def size(self, *names: str) -> tuple[int, int]:
        """Return width and height, px, of a list of both."""
        width, height = self.numbers(*names, counts=(2,))
        if not all(side.is_integer() and 1 <= side <= MAX_SIDE for side in (width, height)):
            self.refuse(names[0], f"must be whole numbers of px, {MAX_SIDE} at most")
        return int(width), int(height)

    def numbers(self, *names: str, counts: Collection[int]) -> tuple[float, ...]:
        """Return finite numbers of a list, rows, or a matrix with `data`; `counts` are allowed."""
        name, value = self._find(names, None)
        where = self._place + name
        if isinstance(value, Mapping):
            value = value.get("data")
        if not isinstance(value, list | tuple):
            raise UnfitFileError(f"{held(where, value)}: must be a list of numbers")
        flat = [each for row in value for each in (row if isinstance(row, list | tuple) else [row])]
        if len(flat) not in counts:
            wanted = " or ".join(str(count) for count in counts)
            raise UnfitFileError(f"{where}: has {len(flat)} numbers, must have {wanted}")
        return tuple(_number(f"{where}[{n}]", each) for n, each in enumerate(flat))

    def _find(self, names: Collection[str], default: object) -> tuple[str, Any]:
        for name in names:
            if self._table.get(name) is not None:
                return name, self._table[name]
        first = next(iter(names))
        if default is None:
            raise UnfitFileError(f"{self._place}{first}: missing")
        return first, default


def _number(where: str, value: object) -> float:
    # YAML takes 1e-05 for a text.
    number = math.nan
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):
            number = float(value)
    if not math.isfinite(number):
        raise UnfitFileError(f"{held(where, value)}: must be a finite number")
    return number
