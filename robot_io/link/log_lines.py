"""Lines of a text log of the bus, and those among them that cannot be read.

A log is cut off where its computer lost power: in the middle of a line, or in NUL bytes, with which file
systems fill what was not written.
"""

from collections.abc import Iterator
from typing import BinaryIO

LONGEST_LINE = 65_536
"""Bytes: a line of a text log holds one frame."""


class LogLines:
    """Iterable of the lines of a text log.

    They are decoded as Latin-1, which never fails: of what is read of a log, only the names of months are
    beyond ASCII. `number` is the line read last, from 1; `is_unfinished` says that it has no end;
    `unreadable` are the numbers of unreadable lines.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.number = 0
        self.is_unfinished = False
        self.unreadable: list[int] = []
        self.first_unreadable = ""

    def __iter__(self) -> Iterator[str]:
        while content := self._file.readline(LONGEST_LINE):
            self.number += 1
            is_whole = len(content) < LONGEST_LINE
            while not content.endswith(b"\n") and (rest := self._file.readline(LONGEST_LINE)):
                is_whole, content = False, rest
            self.is_unfinished = not content.endswith(b"\n")
            line = content.decode("latin-1").strip(" \t\r\n\ufeff").removeprefix("ï»¿")
            if not is_whole or "\0" in line:
                self.leave_out(line if is_whole else f"a line of more than {LONGEST_LINE} characters")
            elif line:
                yield line

    def leave_out(self, line: str) -> None:
        """Count the line that was read last as one that cannot be read."""
        if self.number not in self.unreadable[-1:]:
            self.unreadable.append(self.number)
            self.first_unreadable = self.first_unreadable or line

    @property
    def damage(self) -> str | None:
        """Description of what cannot be read; None if all can."""
        if not self.unreadable:
            return None
        first, count = self.unreadable[0], len(self.unreadable)
        if self.is_unfinished and first == self.number:
            return f"is cut off in line {first}: what stands before it is read"
        if count == 1:
            return f"line {first} cannot be read: it is left out"
        return f"{count} lines cannot be read, the first is line {first}: they are left out"
