"""A disk for a tracker's log that may be full; what is written is counted alone."""

from __future__ import annotations

from pathlib import Path

import can

from robot_io.link.bus_log import BusLogWriteError


class Disk:
    """Simulated disk that takes frames while it has room; `frames` counts them by file."""

    def __init__(self) -> None:
        self.is_full = False
        self.frames: dict[str, int] = {}

    def open(self, path: Path) -> File:
        """Return a file to write frames to."""
        return File(self, path)


class File:
    """A log on a disk, as `robot_io.link.bus_log.BusLogWriter` is one; no frame's time is wrong here."""

    def __init__(self, disk: Disk, path: Path) -> None:
        self._disk, self._path = disk, path

    def require(self, timestamp_s: float) -> None:
        """Ignore the required time, s."""

    def write(self, _frame: can.Message) -> None:
        """Take a frame; BusLogWriteError on a full disk."""
        if self._disk.is_full:
            raise BusLogWriteError(f"log {self._path}: cannot be written: No space left on device")
        name = self._path.name
        self._disk.frames[name] = self._disk.frames.get(name, 0) + 1

    def keep(self) -> None:
        """Do nothing: nothing waits."""

    def close(self) -> None:
        """Do nothing: nothing waits."""
