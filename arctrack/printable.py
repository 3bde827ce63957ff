"""Text that came from a file, a folder's name or a bus, made fit to print.

What a terminal would obey (escape codes), what would break a line, what turns the direction of reading and
what no encoding takes is shown as Python's `repr` shows it.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path

LONGEST_SHOWN = 60
"""Characters of a value that a message quotes."""

MAX_REPORTED = 20
"""Unknown names that are reported one by one."""


def printable(text: str) -> str:
    """Return a text in which what cannot be printed is escaped: ESC becomes backslash x1b."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def quoted(path: Path) -> str:
    """Return a path as a shell takes it; one that cannot be printed is shown, and would not be found."""
    return shlex.quote(printable(str(path)))


def shown(value: object) -> str:
    """Return a value's `repr`, cut where it is longer than a message bears."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        # Python writes no more than 4300 digits, and no tables nested a thousand deep.
        return (
            f"an integer of {value.bit_length()} bits" if isinstance(value, int) else "tables within tables"
        )
    return cut(text)


def cut(text: str) -> str:
    """Return a text, its end replaced by dots where it is longer than a message bears."""
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 2]} …"


def first_of(names: Iterable[str], what: str) -> list[str]:
    """Return the first names, and after them how many more of `what` there are."""
    names = list(names)
    more = len(names) - MAX_REPORTED
    return [*names[:MAX_REPORTED], *([f"{more} more {what}"] if more > 0 else [])]
