"""A laser's switch from one process to another, through memory that they share: it goes off by itself.

The line holds a time: the laser is on until then. Who drives it says so again and again. A driver that
dies, or stops, lets the time run out.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from contextlib import suppress
from pathlib import Path

from arctrack.journal.ring import memory_folder

HOLD_S = 0.3
"""So long the laser stays on after it was switched on last: as long as the longest look at a frame, twice."""

_UNTIL = struct.Struct("<d")


def line_path(name: str) -> Path:
    """Return where the line of a camera's name lies."""
    return memory_folder() / f"arctrack-laser-{name}"


class LaserLine:
    """Drives the laser of a camera; it is off at first.

    Parameters
    ----------
    name : str
        The name of the camera's frames.
    """

    def __init__(self, name: str) -> None:
        file = os.open(line_path(name), os.O_RDWR | os.O_CREAT, 0o600)
        try:
            os.ftruncate(file, _UNTIL.size)
            self._memory = mmap.mmap(file, _UNTIL.size)
        finally:
            os.close(file)
        self.switch(False)

    def switch(self, is_on: bool) -> None:
        """Switch the laser; on lasts for HOLD_S."""
        _UNTIL.pack_into(self._memory, 0, time.monotonic() + HOLD_S if is_on else 0.0)

    def close(self) -> None:
        """Switch the laser off for good."""
        if not self._memory.closed:
            self.switch(False)
            self._memory.close()


def is_laser_on(name: str) -> bool:
    """Return whether a laser is on; one that nobody ever drove is on for good."""
    try:
        held = line_path(name).read_bytes()
    except FileNotFoundError:
        return True
    return len(held) == _UNTIL.size and time.monotonic() < _UNTIL.unpack(held)[0]


def remove_line(name: str) -> None:
    """Remove a line, as the camera does that begins or ends."""
    with suppress(FileNotFoundError):
        line_path(name).unlink()
