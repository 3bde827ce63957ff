"""A log that stays: what cannot be written is counted and left out; it goes on where there is room again."""

import logging
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import can

from robot_io.link.bus_log import BusLogError, BusLogWriteError, BusLogWriter
from robot_io.link.reconnecting import LinkFault

RETRY_S = 1.0
"""Period of the retries of a failed log, s: a full disk stays full for many frames."""

_LOG = logging.getLogger(__name__)


class FrameLog(Protocol):
    """Interface of one file of a log, such as a `BusLogWriter`."""

    def require(self, timestamp_s: float) -> None:
        """Raise BusLogError if a frame of this time, s, cannot be logged."""

    def write(self, frame: can.Message) -> None:
        """Write a frame; BusLogWriteError if the disk does not take it."""

    def keep(self) -> None:
        """Put on disk what is not there yet; BusLogWriteError as in `write`."""

    def close(self) -> None:
        """Finish the file; BusLogWriteError as in `write`."""


class SteadyLog:
    """Log of frames that never fails for a disk once it is open.

    After a failure it continues in another file: after `bus.blf` comes `bus.1.blf`. `faults` counts frames
    that are not in it; `clock` times the retries; `say` is told once what failed. Raises BusLogError if the
    log cannot be opened, and what `open_log` raises the first time.
    """

    def __init__(
        self,
        path: Path,
        faults: Counter[LinkFault],
        open_log: Callable[[Path], FrameLog] = BusLogWriter,
        clock: Callable[[], float] = time.monotonic,
        say: Callable[[str], None] = _LOG.warning,
    ) -> None:
        self._path, self._faults = path, faults
        self._open_log, self._clock, self._warn = open_log, clock, say
        self._n_files, self._has_written = 0, False
        self._failed_at_s = 0.0
        self._log: FrameLog | None = open_log(path)

    def require(self, timestamp_s: float) -> None:
        """Raise BusLogError if no log can hold a frame of this time, s, with those before it."""
        if self._log is not None:
            try:
                self._log.require(timestamp_s)
            except BusLogWriteError as error:
                self._fail(error)

    def write(self, frame: can.Message) -> None:
        """Write a frame, or count it as one that is left out."""
        log = self._log or self._retry()
        if log is not None:
            try:
                log.write(frame)
            except BusLogWriteError as error:
                self._fail(error)
            else:
                self._has_written = True
                return
        self._faults[LinkFault.UNLOGGED] += 1

    def keep(self) -> None:
        """Put on disk what is not there yet, once a second."""
        if self._log is not None:
            try:
                self._log.keep()
            except BusLogWriteError as error:
                self._fail(error)

    def close(self) -> None:
        """Finish the log; what does not fit any more is counted."""
        if self._log is not None:
            try:
                self._log.close()
            except BusLogWriteError as error:
                self._faults[LinkFault.UNLOGGED] += 1
                self._say(error)
        self._log = None

    def _retry(self) -> FrameLog | None:
        if not self._clock() - self._failed_at_s >= RETRY_S:
            return None
        try:
            self._log = self._open_log(self._next_path())
        except BusLogWriteError as error:
            self._fail(error)
        return self._log

    def _next_path(self) -> Path:
        """Return the next file's path: the same as long as nothing was written into it."""
        if self._has_written:
            self._n_files, self._has_written = self._n_files + 1, False
        if not self._n_files:
            return self._path
        return self._path.with_name(f"{self._path.stem}.{self._n_files}{self._path.suffix}")

    def _fail(self, error: BusLogError) -> None:
        self._say(error)
        self._failed_at_s = self._clock()
        log, self._log = self._log, None
        if log is not None:
            with suppress(BusLogWriteError):
                log.close()

    def _say(self, error: BusLogError) -> None:
        # Once: a disk stays full for thousands of frames.
        if not self._faults[LinkFault.UNLOGGED]:
            self._warn(f"{error}; frames are left out")
