"""The one error that a user meets: a single line with the file, the key or line in it, and the cure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from arctrack.printable import printable


class ArctrackError(Exception):
    """Bad input, or a request that cannot be met; its text is one line that a terminal can be given.

    Parameters
    ----------
    message : str
        What is wrong, where, and the cure. Line breaks become spaces.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(" ".join(message.split())))


def in_file(path: Path, problem: str, *, line: int | None = None) -> ArctrackError:
    """Return the error that a file, at a line (counted from 1) if one is to blame, makes."""
    place = str(path) if line is None else f"{path}, line {line}"
    return ArctrackError(f"{place}: {problem}")


def no_such_path(
    path: Path, problem: str = "there is no such file", is_kind: Callable[[Path], bool] = Path.exists
) -> ArctrackError:
    """Return the error for a path that does not exist; it names the nearest one that does, of a kind."""
    near = _nearest_path(path, is_kind)
    return in_file(path, problem if near is None else f"{problem}; did you mean {near}?")


def _nearest_path(path: Path, is_kind: Callable[[Path], bool]) -> Path | None:
    """Return the path that differs in its first part that does not exist, None if none is near."""
    from noise_model.spelling import nearest

    wrong = path
    while wrong.parent != wrong and not wrong.parent.is_dir():
        wrong = wrong.parent
    rest = path.relative_to(wrong)
    try:
        # A common ending alone makes names not near, such as poses.csv and frames.csv.
        there = [each / rest for each in wrong.parent.iterdir() if nearest(wrong.stem, [each.stem])]
        names = {str(each): each for each in there if is_kind(each)}
    except OSError:
        return None
    near = nearest(str(path), names)
    return None if near is None else names[near]


def without_extra(name: str, error: ModuleNotFoundError, extra: str) -> ArctrackError:
    """Return the error that a file or an option makes whose package, of an extra, is not installed."""
    return ArctrackError(
        f"{name}: needs the package {error.name}, which is not installed; pip install 'arctrack[{extra}]'"
    )


def as_line(error: ArctrackError | OSError, source: Path) -> str:
    """Return one line on what failed while something was made of a file or folder.

    A disk that is full, a folder that went away: an OSError need not name its file.
    """
    if isinstance(error, ArctrackError):
        return str(error)
    return printable(" ".join(f"{error.filename or source}: {error.strerror or error}".split()))
