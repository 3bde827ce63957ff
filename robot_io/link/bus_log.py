"""Logs of the bus, `.blf`, `.asc` or `.log`, written so that the times come back.

A log holds either wall-clock times (Unix seconds) or recording times (seconds from a recording's zero). The
formats store times relative to a start: here that start is 0 for recording times and a whole second for
wall-clock times, so that nothing is lost to the start's own resolution of a millisecond.
"""

import copy
import math
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

import can

UNIX_TIME_FROM_S = 631_152_000.0
"""Times from here on (1990-01-01) are taken for wall-clock times, as python-can's BLF writer does."""


class BusLogError(ValueError):
    """A log that cannot be written or read."""


class BusLogWriteError(BusLogError):
    """A log that the disk does not take."""


class BusLogWriter:
    """Writer of frames to one log file; `close` it, or use it as a context manager."""

    def __init__(self, path: Path) -> None:
        require_suffix(path, (".asc", ".blf", ".log"))
        self.path = path
        self._start_s: float | None = None
        self._kept_at_s = time.monotonic()
        self._flushed_bytes = 0
        self._writer: can.BLFWriter | can.ASCWriter | can.CanutilsLogWriter
        try:
            if path.suffix.lower() == ".blf":
                self._writer = _blf_writer(path)
            elif path.suffix.lower() == ".asc":
                self._writer = can.ASCWriter(path)
            else:
                self._writer = can.CanutilsLogWriter(path)
        except OSError as error:
            raise self._cannot_be_written(error) from error

    def __enter__(self) -> "BusLogWriter":
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
        # A process that is killed loses a second of its log; a machine that stops may lose more.
        if self._start_s is None or not now_s - self._kept_at_s >= 1.0:
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
    # Small containers: little is lost if the process is killed.
    return can.BLFWriter(path, append=append, max_container_size=4096)


def require_suffix(path: Path, suffixes: Collection[str]) -> None:
    """Raise BusLogError for a file of another format than those."""
    if path.suffix.lower() == ".gz":
        raise BusLogError(f"log {path}: is packed by gzip: unpack it, as by gunzip")
    if path.suffix.lower() not in suffixes:
        raise BusLogError(f"log {path}: unknown format '{path.suffix}'; use one of {', '.join(suffixes)}")
