"""Logs of the bus, `.blf`, `.asc` or `.log`: written so that the times come back, read as accepted messages.

A log holds either wall-clock times (Unix seconds) or recording times (seconds from a recording's zero). The
formats store times relative to a start: here that start is 0 for recording times and a whole second for
wall-clock times, so that nothing is lost to the start's own resolution of a millisecond.
"""

from __future__ import annotations

import copy
import io
import math
import struct
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TextIO

import can
from can.io.blf import BLFParseError

from robot_io.link.blf_check import check_blf
from robot_io.link.inbox import ANY_SOURCE, Inbox, Received, SkipReason

LOG_SUFFIXES = (".asc", ".blf", ".log")
"""The formats that are written and read."""

UNIX_TIME_FROM_S = 631_152_000.0
"""Times from here on (1990-01-01) are taken for wall-clock times, as python-can's BLF writer does."""

_BLF_CONTAINER_BYTES = 4096
"""A BLF file is written in containers; a small one loses little if the process is killed."""

KEPT_EVERY_S = 1.0
"""A process that is killed loses no more than this of a log; a machine that stops may lose more."""


LONGEST_LINE = 65_536
"""Characters: a line of an `.asc` or `.log` holds one frame."""


class BusLogError(ValueError):
    """A log that cannot be written or read."""


class BusLogWriteError(BusLogError):
    """A log that the disk does not take."""


class BusLogWriter:
    """Writes frames to one log file; `close` it, or use it as a context manager."""

    def __init__(self, path: Path) -> None:
        _require_suffix(path)
        self.path = path
        self._start_s: float | None = None
        self._kept_at_s = time.monotonic()
        self._flushed_bytes = 0
        self._writer: can.BLFWriter | can.ASCWriter | can.CanutilsLogWriter
        try:
            if path.suffix == ".blf":
                self._writer = _blf_writer(path)
            elif path.suffix == ".asc":
                self._writer = can.ASCWriter(path)
            else:
                self._writer = can.CanutilsLogWriter(path)
        except OSError as error:
            raise self._cannot_be_written(error) from error

    def __enter__(self) -> BusLogWriter:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def require(self, timestamp_s: float) -> None:
        """Raise BusLogError if a frame of this time cannot be logged with its time."""
        if not math.isfinite(timestamp_s):
            raise BusLogError(f"log {self.path}: time {timestamp_s} s; a frame's time must be finite")
        start_s = self._start(timestamp_s)
        if timestamp_s < start_s:
            raise BusLogError(
                f"log {self.path}: time {timestamp_s:.6f} s is before the log's start at {start_s:g} s; "
                "keep one clock in a log, from 0 on"
            )

    def write(self, frame: can.Message) -> None:
        """Write a frame; one from before the log's start gets the start's time.

        Raises BusLogError if it cannot be written, as on a full disk.
        """
        start_s = self._start(frame.timestamp)
        entry = copy.copy(frame)
        entry.timestamp = max(frame.timestamp, start_s)
        # The writers make a channel number of a name's trailing digits, which need not fit.
        entry.channel = 0
        try:
            self._writer.on_message_received(entry)
            self._flush()
        except OSError as error:
            raise self._cannot_be_written(error) from error
        self.keep()

    def keep(self) -> None:
        """Put on disk what is not there yet, once a second; who logs calls it also where nothing comes.

        Raises BusLogError if it cannot be written, as on a full disk.
        """
        now_s = time.monotonic()
        if self._start_s is None or not now_s - self._kept_at_s >= KEPT_EVERY_S:
            return
        self._kept_at_s = now_s
        if isinstance(self._writer, can.BLFWriter):
            try:
                self._renew()
            except OSError as error:
                raise self._cannot_be_written(error) from error

    def close(self) -> None:
        """Finish the file; BusLogError if it cannot be written, as on a full disk."""
        try:
            self._writer.stop()
        except OSError as error:
            # The writer has not come to closing it.
            with suppress(OSError):
                self._writer.file.close()
            raise self._cannot_be_written(error) from error

    def _flush(self) -> None:
        """Hand what was written to the system; of a BLF file that is nothing before a container is full."""
        if isinstance(self._writer, can.BLFWriter):
            if self._writer.uncompressed_size == self._flushed_bytes:
                return
            self._flushed_bytes = self._writer.uncompressed_size
        self._writer.file.flush()

    def _cannot_be_written(self, error: OSError) -> BusLogWriteError:
        return BusLogWriteError(f"log {self.path}: cannot be written: {error.strerror}; choose another place")

    def _start(self, timestamp_s: float) -> float:
        if self._start_s is None:
            start_s = 0.0 if timestamp_s < UNIX_TIME_FROM_S else math.floor(timestamp_s) - 1.0
            try:
                self._write_start(start_s)
            except OSError as error:
                raise self._cannot_be_written(error) from error
            self._start_s = start_s
        return self._start_s

    def _write_start(self, start_s: float) -> None:
        if isinstance(self._writer, can.BLFWriter):
            # A BLF file's header is written at its end: without one, a killed process leaves times since 0.
            self._writer.start_timestamp = start_s
            self._renew()
        elif isinstance(self._writer, can.ASCWriter):
            self._writer.log_event("Start of measurement", start_s)

    def _renew(self) -> None:
        """Finish a BLF file and go on behind it: what is in no container yet is only in memory."""
        assert isinstance(self._writer, can.BLFWriter)
        self._writer.stop()
        self._writer = _blf_writer(self.path, append=True)


def _blf_writer(path: Path, append: bool = False) -> can.BLFWriter:
    return can.BLFWriter(path, append=append, max_container_size=_BLF_CONTAINER_BYTES)


class BusLogReader:
    """Iterates over the accepted messages of a log; `skipped` counts the frames left out, by reason.

    Live, replayed and simulated frames are accepted; `Received.source` tells them apart.

    Every pass over it reads the file anew, with fresh counters. Times are those that were logged: wall-clock
    seconds, or recording seconds where the log's start is not a wall-clock time. An `.asc` file states its
    start in local time: read it in the time zone in which it was written, or use `.blf`.
    """

    def __init__(self, path: Path) -> None:
        _require_suffix(path)
        if not path.is_file():
            problem = "is no file" if path.exists() else "no such file"
            raise BusLogError(f"log {path}: {problem}; check the path")
        self.path = path
        self.skipped: Counter[SkipReason] = Counter()

    def __iter__(self) -> Iterator[Received]:
        inbox = Inbox(ANY_SOURCE)
        self.skipped = inbox.skipped
        try:
            for frame in _frames(self.path):
                received = inbox.receive(frame)
                if received is not None:
                    yield received
        except (OSError, ValueError, LookupError, struct.error, zlib.error, BLFParseError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise BusLogError(f"log {self.path}: cannot be read ({reason}); is it a whole log?") from error


def _frames(path: Path) -> Iterator[can.Message]:
    if path.suffix == ".blf":
        # Opened here: the reader leaves the file open when its header is not a log's.
        with path.open("rb") as file:
            check_blf(file)
            file.seek(0)
            try:
                yield from can.BLFReader(file)
            except struct.error:
                # Whoever wrote it was killed: of the last object only a part is there.
                if file.read(1):
                    raise
    else:
        with _Lines(path.open("rb"), encoding="utf-8") as lines:
            yield from _asc_frames(lines) if path.suffix == ".asc" else can.CanutilsLogReader(lines)


class _Lines(io.TextIOWrapper):
    """A log's lines; ValueError for one that is longer than any."""

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]
        line = super().readline(LONGEST_LINE + 1)
        if len(line) > LONGEST_LINE:
            raise ValueError(f"a line of more than {LONGEST_LINE} characters")
        return line


def _asc_frames(lines: TextIO) -> Iterator[can.Message]:
    asc = can.ASCReader(lines, relative_timestamp=False)
    for frame in asc:
        if asc.start_time < UNIX_TIME_FROM_S:
            # To the nanosecond: the file holds microseconds, the sum with the start has rounded them.
            frame.timestamp = round(frame.timestamp - asc.start_time, 9)
        yield frame


def _require_suffix(path: Path) -> None:
    if path.suffix not in LOG_SUFFIXES:
        raise BusLogError(f"log {path}: unknown format '{path.suffix}'; use one of {', '.join(LOG_SUFFIXES)}")
