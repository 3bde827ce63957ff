"""Records from one process to others, through memory that they share: the newest counts, nobody waits.

A ring of slots lies in a file of `private_memory`. Each slot has a sequence number, odd while it is written,
so that a reader sees a record whole or looks again (a sequence lock: Lameter 2005, "Effective synchronization
on Linux/NUMA systems"). Processors may show another's writes in another order: a checksum has the last word.

The writer holds a lock on the file as long as it lives, however it dies. A file whose lock is free is of a
writer that crashed: readers say so, and the next writer takes its place.
"""

import math
import mmap
import os
import struct
import time
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from arctrack.closing import Closing
from arctrack.errors import ArctrackError
from arctrack.live.journal.private_memory import memory_folder, open_private, private_path
from arctrack.system import is_locked, lock, lock_if_free, reserve
from noise_model.compiled.arrays import UInt8

MAGIC = b"ARCRNG01"
HEADER = struct.Struct("<8sII48sQ")
"""Magic, slots, bytes of a record at most, what the records are, how many were written: that at 8 n bytes."""

SLOT = struct.Struct("<QII")
"""Sequence, how many bytes the record has, its checksum."""

COUNT_AT = HEADER.size - 8
PAGE_BYTES = 4096
LOOKS = 100
"""Number of tries to read a slot that is written meanwhile."""

Part = bytes | npt.NDArray[np.generic]


class RingError(ArctrackError):
    """Records cannot be shared, or read."""


def ring_bytes(slots: int, record_bytes: int) -> int:
    """Return the memory that a ring takes, bytes."""
    return PAGE_BYTES + slots * _slot_bytes(record_bytes)


class RingWriter(Closing):
    """Writer of a ring of records in shared memory; readers never block it.

    It keeps the latest `slots` records of up to `record_bytes`. `kind` (at most 48 bytes) tells readers what
    they are. Raises RingError if a writer of this name is alive or there is no room, PermissionError if the
    name's memory belongs to another user.
    """

    def __init__(self, name: str, slots: int, record_bytes: int, kind: bytes = b"") -> None:
        self._slots, self._record_bytes = slots, record_bytes
        self._slot_bytes = _slot_bytes(record_bytes)
        self.count = 0
        try:
            self.path = private_path(name)
            remove_if_dead(self.path)
            self._file = open_private(self.path, os.O_RDWR | os.O_CREAT)
        except FileExistsError:
            raise RingError(f"{name!r}: another process publishes them") from None
        size = ring_bytes(slots, record_bytes)
        try:
            # At most a reader asks at this moment whether a writer lives.
            lock(self._file)
            reserve(self._file, size)
            # All of it is mapped now: no record waits for a page.
            flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
            self._memory = mmap.mmap(self._file, size, flags=flags)
        except OSError as error:
            os.unlink(self.path)
            os.close(self._file)
            raise RingError(
                f"{name!r}: {self.path}, {size / 1e6:.1f} MB: {error.strerror}; "
                f"mount -o remount,size=… {memory_folder()}, or docker run --shm-size=…, gives more memory"
            ) from error
        # The magic last: a reader that finds it finds the rest.
        HEADER.pack_into(self._memory, 0, b"", slots, record_bytes, kind, 0)
        self._memory[: len(MAGIC)] = MAGIC

    def write(self, *parts: Part) -> None:
        """Write a record; its parts lie one after the other. ValueError if it is too long."""
        views = [memoryview(part if isinstance(part, bytes) else part.data).cast("B") for part in parts]
        length = sum(len(view) for view in views)
        if length > self._record_bytes:
            raise ValueError(f"{self.path.name}: a record of {length} bytes, {self._record_bytes} at most")
        begin = PAGE_BYTES + (self.count % self._slots) * self._slot_bytes
        sequence = 2 * (self.count // self._slots)
        struct.pack_into("<Q", self._memory, begin, sequence + 1)
        SLOT.pack_into(self._memory, begin, sequence + 1, length, _checksum(views))
        place = begin + SLOT.size
        for view in views:
            self._memory[place : place + len(view)] = view
            place += len(view)
        struct.pack_into("<Q", self._memory, begin, sequence + 2)
        self.count += 1
        struct.pack_into("<Q", self._memory, COUNT_AT, self.count)

    def close(self) -> None:
        """Take the records away."""
        if self._memory.closed:
            return
        self.path.unlink(missing_ok=True)
        self._memory.close()
        os.close(self._file)


class RingReader(Closing):
    """Reader of a ring of records in shared memory.

    `slots` and `kind` are as the writer stated them. Raises RingError if nobody writes such records,
    PermissionError if the name's memory belongs to another user.
    """

    def __init__(self, name: str) -> None:
        try:
            path = private_path(name)
            self._file = open_private(path, os.O_RDONLY)
        except FileNotFoundError:
            raise RingError(f"{name!r}: nobody publishes them") from None
        try:
            if not self.is_writer_alive:
                remove_if_dead(path)
                raise RingError(f"{name!r}: who published them is dead")
            self._memory = mmap.mmap(self._file, 0, prot=mmap.PROT_READ)
            magic, slots, record_bytes, kind, _ = HEADER.unpack_from(self._memory, 0)
            if magic != MAGIC:
                raise RingError(f"{name!r}: are not there yet, or of another version")
        except (OSError, ValueError, struct.error) as error:
            os.close(self._file)
            raise RingError(f"{name!r}: are not there yet") from error
        except RingError:
            os.close(self._file)
            raise
        self.slots, self.kind = int(slots), kind.rstrip(b"\0")
        self._slot_bytes = _slot_bytes(record_bytes)

    @property
    def count(self) -> int:
        """Number of records written so far."""
        (count,) = struct.unpack_from("<Q", self._memory, COUNT_AT)
        return int(count)

    @property
    def is_writer_alive(self) -> bool:
        """True while a process writes: what it leaves is the last that it wrote."""
        return is_locked(self._file)

    def read(self, position: int) -> UInt8 | None:
        """Return a copy of a record by its position from the first, None where it is gone or not whole."""
        begin = PAGE_BYTES + (position % self.slots) * self._slot_bytes
        sequence, length, checksum = SLOT.unpack_from(self._memory, begin)
        if sequence != 2 * (position // self.slots) + 2 or length > self._slot_bytes - SLOT.size:
            return None
        record = np.frombuffer(self._memory, np.uint8, length, begin + SLOT.size).copy()
        (after,) = struct.unpack_from("<Q", self._memory, begin)
        return record if sequence == after and _checksum([record.data]) == checksum else None

    def newest(self, after: int) -> tuple[int, UInt8] | None:
        """Return the newest record and its position, None where none was written since `after` ones."""
        for _ in range(LOOKS):
            count = self.count
            if count <= after:
                return None
            record = self.read(count - 1)
            if record is not None:
                return count - 1, record
        return None

    def close(self) -> None:
        """Read no more."""
        if not self._memory.closed:
            self._memory.close()
            os.close(self._file)


def remove_dead_rings() -> None:
    """Remove all that crashed writers left behind."""
    for path in private_path("").iterdir():
        with suppress(OSError), path.open("rb") as file:
            is_dead = file.read(len(MAGIC)) == MAGIC and not is_locked(file.fileno())
            if is_dead:
                remove_if_dead(path)


def remove_if_dead(path: Path) -> None:
    """Remove the file of a dead writer; a reader may be testing just now whether it is."""
    for _ in range(LOOKS):
        try:
            file = open_private(path, os.O_RDWR)
        except FileNotFoundError:
            return
        try:
            if lock_if_free(file):
                path.unlink(missing_ok=True)
                return
            time.sleep(0.001)
        finally:
            os.close(file)


def _slot_bytes(record_bytes: int) -> int:
    return PAGE_BYTES * math.ceil((SLOT.size + record_bytes) / PAGE_BYTES)


def _checksum(views: Sequence[memoryview]) -> int:
    checksum = 0
    for view in views:
        checksum = zlib.crc32(view, checksum)
    return checksum
