"""Files opened so that nothing blocks and nothing takes more memory than it may.

A FIFO, a socket or a device in place of a file would keep a reader waiting for ever, or never end.
"""

import codecs
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from arctrack.errors import in_file, no_such_path
from arctrack.output import real

KINDS = (
    (stat.S_ISDIR, "folder"),
    (stat.S_ISFIFO, "FIFO"),
    (stat.S_ISSOCK, "socket"),
    (stat.S_ISCHR, "device"),
    (stat.S_ISBLK, "device"),
)


FRAMES_CSV, TRUTH_CSV = "frames.csv", "truth.csv"

UNFINISHED_SUFFIX = ".unfinished"
"""Ends the name of a recording's folder until all is written."""


class UnfitFileError(ValueError):
    """Error in a file, without its name; `line` is counted from 1, None if none is to blame."""

    def __init__(self, problem: str, line: int | None = None) -> None:
        super().__init__(problem)
        self.line = line


@contextmanager
def blamed_on(path: Path, missing: str = "there is no such file") -> Iterator[None]:
    """Turn what is wrong with a file that is read into an ArctrackError that names it."""
    try:
        yield
    except FileNotFoundError:
        raise no_such_path(path, missing) from None
    except UnfitFileError as error:
        raise in_file(path, str(error), line=error.line) from None
    except OSError as error:
        raise in_file(path, f"cannot be read: {error.strerror}") from None


def check_folder(folder: Path) -> None:
    """Raise ArctrackError if a recording's folder is missing, is none, or was not written to its end."""
    if not folder.is_dir():
        if folder.exists():
            raise in_file(folder, "is a file; give the folder that holds it")
        raise no_such_path(folder, "there is no such folder", Path.is_dir)
    if real(folder).name.endswith(UNFINISHED_SUFFIX):
        raise in_file(
            folder, f"was not written to its end; take {UNFINISHED_SUFFIX} off its name to read it so"
        )


def open_file(path: Path, max_bytes: int) -> io.BufferedReader:
    """Open a regular file to read; UnfitFileError if it is of another kind or larger, OSError as `open`."""
    try:
        # Opened without waiting: a FIFO that nobody writes to would hold up the open itself.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError:
        raise UnfitFileError("a NUL byte is in its name") from None
    except OSError:
        # A socket cannot be opened at all: its kind says more.
        check_file(path, max_bytes)
        raise
    try:
        _check(os.fstat(descriptor), max_bytes)
    except UnfitFileError:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def check_file(path: Path, max_bytes: int) -> None:
    """Check a file that another library opens; UnfitFileError and OSError as for `open_file`."""
    _check(os.stat(path), max_bytes)


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Return a file's content; UnfitFileError and OSError as for `open_file`."""
    with open_file(path, max_bytes) as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise UnfitFileError(_too_large(len(content), max_bytes))
    return content


def read_text(path: Path, max_bytes: int) -> str:
    """Return a UTF-8 text without its byte order mark, lines ended by a newline alone.

    UnfitFileError, with the line, for another encoding; else as for `open_file`.
    """
    content = read_bytes(path, max_bytes)
    if is_utf16(content):
        raise UnfitFileError("is UTF-16: save it as UTF-8")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise not_utf8(error, 1 + content.count(b"\n", 0, error.start)) from None
    if "\0" in text:
        raise UnfitFileError(
            "holds a NUL byte: save it as UTF-8 text", 1 + text[: text.index("\0")].count("\n")
        )
    return text.replace("\r\n", "\n").replace("\r", "\n")


def is_utf16(start: bytes) -> bool:
    """Return True if a file's first bytes are a byte-order mark of UTF-16."""
    return start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))


def not_utf8(error: UnicodeDecodeError, line: int) -> UnfitFileError:
    """Return the error that bytes other than UTF-8 make."""
    return UnfitFileError(f"byte 0x{error.object[error.start]:02x} is no UTF-8: save it as UTF-8", line)


def kind_of(mode: int) -> str | None:
    """Return the kind of what stands in a file's place, None for a regular file."""
    return next((name for is_kind, name in KINDS if is_kind(mode)), None)


def in_bytes(count: int) -> str:
    """Return a size as people say it."""
    for unit, name in ((10**9, "GB"), (10**6, "MB"), (10**3, "kB")):
        if count >= unit:
            return f"{count / unit:.1f} {name}"
    return f"{count} bytes"


def _check(status: os.stat_result, max_bytes: int) -> None:
    kind = kind_of(status.st_mode)
    if kind is not None:
        raise UnfitFileError(f"is a {kind}: a regular file is needed")
    if status.st_size > max_bytes:
        raise UnfitFileError(_too_large(status.st_size, max_bytes))


def _too_large(count: int, max_bytes: int) -> str:
    return f"has {in_bytes(count)}: {in_bytes(max_bytes)} is the most"
