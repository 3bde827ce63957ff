"""Frames from one process to others, through memory that they share: the newest counts, nobody waits.

A ring of slots lies in a file in memory. Each slot has a sequence number, odd while it is written, so that a
reader sees a frame whole or looks again (a sequence lock: Lameter 2005, "Effective synchronization on Linux
/NUMA systems"). Processors may show another's writes in another order, so a checksum has the last word.

The writer holds a lock on the file as long as it lives, however it dies. A file whose lock is free is of a
writer that crashed: readers say so, and the next writer takes its place.
"""

from __future__ import annotations

import fcntl
import math
import mmap
import os
import struct
import tempfile
import time
import zlib
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from tracker.state import Frame

MAGIC = b"ARCFRM01"
HEADER = struct.Struct("<8sIIII8sQ")
"""Magic, slots, height, width, nothing, dtype, how many frames were published: that at a multiple of 8."""

SLOT = struct.Struct("<QQdddBBI")
"""Sequence, the frame's number, time of its mid-exposure, exposure, current, laser, arc, checksum."""

COUNT_AT = HEADER.size - 8
PAGE_BYTES = 4096
SLOTS = 4
LOOKS = 100
"""So often a reader looks again at a slot that is written meanwhile; then the frame counts as missed."""

MEMORY = Path("/dev/shm")


class SharedFramesError(RuntimeError):
    """Frames cannot be shared, or read."""


def memory_folder() -> Path:
    """Return the folder whose files are memory, where the machine has one."""
    return MEMORY if MEMORY.is_dir() else Path(tempfile.gettempdir())


def path_of(name: str) -> Path:
    """Return where frames of a name lie."""
    return memory_folder() / f"arctrack-frames-{name}"


@dataclass(frozen=True)
class _Layout:
    slots: int
    height: int
    width: int
    dtype: np.dtype[Any]

    @property
    def image_bytes(self) -> int:
        return self.height * self.width * self.dtype.itemsize

    @property
    def slot_bytes(self) -> int:
        return PAGE_BYTES * math.ceil((SLOT.size + self.image_bytes) / PAGE_BYTES)

    @property
    def bytes(self) -> int:
        return PAGE_BYTES + self.slots * self.slot_bytes

    def slot_at(self, count: int) -> int:
        """Return where the slot of the count-th frame begins."""
        return PAGE_BYTES + (count % self.slots) * self.slot_bytes


class SharedFramesWriter:
    """Publishes frames under a name; who reads them makes it wait for nothing.

    Parameters
    ----------
    name : str
        The frames' name: one writer at a time.
    height, width : int
        The images' size, px.
    dtype : dtype
        Their grey levels' type, uint8 or uint16.

    Raises
    ------
    SharedFramesError
        If a writer of this name is alive, or there is no room.
    """

    def __init__(self, name: str, height: int, width: int, dtype: npt.DTypeLike = np.uint8) -> None:
        self.path = path_of(name)
        self._layout = _Layout(SLOTS, height, width, np.dtype(dtype))
        self._count = 0
        _remove_dead(self.path)
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            raise SharedFramesError(f"frames {name!r}: another process publishes them") from None
        try:
            # At most a reader asks at this moment whether a writer lives.
            fcntl.flock(self._file, fcntl.LOCK_EX)
            os.posix_fallocate(self._file, 0, self._layout.bytes)
            self._memory = mmap.mmap(self._file, self._layout.bytes)
        except OSError as error:
            os.unlink(self.path)
            os.close(self._file)
            raise SharedFramesError(f"frames {name!r}: {error.strerror}") from error
        kind = self._layout.dtype.str.encode()
        # The magic last: a reader that finds it finds the rest.
        HEADER.pack_into(self._memory, 0, b"", SLOTS, height, width, 0, kind, 0)
        self._memory[: len(MAGIC)] = MAGIC

    def publish(self, frame: Frame) -> None:
        """Publish a frame; ValueError if its image is not of the size and type that were agreed."""
        layout, image = self._layout, np.ascontiguousarray(frame.image_dn)
        if image.shape != (layout.height, layout.width) or image.dtype != layout.dtype:
            raise ValueError(f"frame {frame.index}: is {image.shape} of {image.dtype}")
        at_byte, sequence = layout.slot_at(self._count), 2 * (self._count // layout.slots)
        pixels = image.tobytes()
        fields = (
            frame.index,
            frame.timestamp_s,
            frame.exposure_s,
            frame.current_a,
            frame.laser_on,
            frame.arc_on,
        )
        struct.pack_into("<Q", self._memory, at_byte, sequence + 1)
        SLOT.pack_into(self._memory, at_byte, sequence + 1, *fields, _checksum(fields, pixels))
        begin = at_byte + SLOT.size
        self._memory[begin : begin + len(pixels)] = pixels
        struct.pack_into("<Q", self._memory, at_byte, sequence + 2)
        self._count += 1
        struct.pack_into("<Q", self._memory, COUNT_AT, self._count)

    def close(self) -> None:
        """Take the frames away."""
        if self._memory.closed:
            return
        self.path.unlink(missing_ok=True)
        self._memory.close()
        os.close(self._file)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class SharedFramesReader:
    """Reads the newest frame of a name.

    Parameters
    ----------
    name : str
        The frames' name.

    Attributes
    ----------
    missed : int
        How many frames were published and not read.

    Raises
    ------
    SharedFramesError
        If nobody publishes such frames.
    """

    def __init__(self, name: str) -> None:
        self.missed = 0
        self._name, self._seen = name, 0
        try:
            self._file = os.open(path_of(name), os.O_RDONLY)
        except FileNotFoundError:
            raise SharedFramesError(f"frames {name!r}: nobody publishes them") from None
        try:
            if not self.is_writer_alive:
                _remove_dead(path_of(name))
                raise SharedFramesError(f"frames {name!r}: who published them is dead")
            self._memory = mmap.mmap(self._file, 0, prot=mmap.PROT_READ)
            magic, slots, height, width, _, kind, self._seen = HEADER.unpack_from(self._memory, 0)
            if magic != MAGIC:
                raise SharedFramesError(f"frames {name!r}: are not there yet, or of another version")
        except (OSError, ValueError, struct.error) as error:
            os.close(self._file)
            raise SharedFramesError(f"frames {name!r}: are not there yet") from error
        except SharedFramesError:
            os.close(self._file)
            raise
        self._layout = _Layout(slots, height, width, np.dtype(kind.rstrip(b"\0").decode()))

    @property
    def shape(self) -> tuple[int, int]:
        """The images' height and width, px."""
        return self._layout.height, self._layout.width

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of their grey levels."""
        return self._layout.dtype

    @property
    def is_writer_alive(self) -> bool:
        """Whether a process still publishes: what it leaves is the last that it wrote."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._file, fcntl.LOCK_UN)
        return False

    def newest(self) -> Frame | None:
        """Return the newest frame that was not read yet, None where there is none; its image is a copy."""
        for _ in range(LOOKS):
            (count,) = struct.unpack_from("<Q", self._memory, COUNT_AT)
            if count == self._seen:
                return None
            frame = self._look(count - 1)
            if frame is not None:
                self.missed += count - self._seen - 1
                self._seen = count
                return frame
        return None

    def close(self) -> None:
        """Read no more."""
        if not self._memory.closed:
            self._memory.close()
            os.close(self._file)

    def _look(self, count: int) -> Frame | None:
        """Return a frame if it is whole."""
        layout, at_byte = self._layout, self._layout.slot_at(count)
        sequence, *fields, checksum = SLOT.unpack_from(self._memory, at_byte)
        begin = at_byte + SLOT.size
        pixels = self._memory[begin : begin + layout.image_bytes]
        (after,) = struct.unpack_from("<Q", self._memory, at_byte)
        index, timestamp_s, exposure_s, current_a, laser_on, arc_on = fields
        if sequence != after or sequence != 2 * (count // layout.slots) + 2:
            return None
        if _checksum(tuple(fields), pixels) != checksum:
            return None
        image_dn = np.frombuffer(bytearray(pixels), layout.dtype).reshape(layout.height, layout.width)
        return Frame(index, timestamp_s, image_dn, exposure_s, current_a, bool(laser_on), bool(arc_on))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _checksum(fields: tuple[float, ...], pixels: bytes) -> int:
    return zlib.crc32(pixels, zlib.crc32(struct.pack("<QdddBB", *fields)))


def _remove_dead(path: Path) -> None:
    """Remove the file of a writer that is dead; a reader may ask just now whether it is."""
    for _ in range(LOOKS):
        try:
            file = os.open(path, os.O_RDWR)
        except FileNotFoundError:
            return
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)
            return
        except BlockingIOError:
            time.sleep(0.001)
        finally:
            os.close(file)
