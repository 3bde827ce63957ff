"""Logs of the bus by arctrack, python-can, candump, Vector's and PEAK's tools, read as accepted messages."""

import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import can
from can.io.blf import BLFParseError

from robot_io.link.asc_log import asc_frames
from robot_io.link.bus_log import BusLogError, require_suffix
from robot_io.link.inbox import ANY_SOURCE, Inbox, Received, SkipReason
from robot_io.link.text_logs import LogLines, line_reader, text_frames
from robot_io.protocol.dbc import message_layout

_WRITERS = {
    ".asc": "Vector's tools",
    ".blf": "Vector's tools",
    ".csv": "python-can",
    ".db": "python-can",
    ".log": "candump -L",
    ".trc": "PEAK's tools",
}

LOG_SUFFIXES = tuple(_WRITERS)
"""The formats that are read."""


class AmbiguousChannelError(BusLogError):
    """A log in which several channels carry the same messages of a robot, and none was chosen."""


class BusLogReader:
    """Iterable of the accepted messages of a log.

    Live, replayed and simulated frames are accepted; `Received.source` tells them apart. A log that is cut
    off is read up to the cut, and unreadable lines are left out.

    Every pass reads the file again, with fresh counters. Times are those that were logged: wall-clock
    seconds, or recording seconds where the log's start is not a wall-clock time. An `.asc` file states its
    start in local time: read it in the time zone in which it was written, or use `.blf`.

    The suffix of `path` says the format. `channel` is as the log names it: `can0` in a `.log`, 1 in an `.asc`
    or `.blf`; by default all are read, unless two carry the same messages of a robot. `skipped` counts frames
    left out by reason; `damage` describes what cannot be read.
    """

    def __init__(self, path: Path, channel: str | None = None) -> None:
        require_suffix(path, LOG_SUFFIXES)
        self._suffix = path.suffix.lower()
        if not path.is_file():
            problem = "is no file" if path.exists() else "no such file"
            raise BusLogError(f"log {path}: {problem}; check the path")
        self.path = path
        self.skipped: Counter[SkipReason] = Counter()
        self.damage: str | None = None
        self._channel = channel

    def __iter__(self) -> Iterator[Received]:
        self.skipped, self.damage = Counter(), None
        try:
            yield from self._received()
        except OSError as error:
            raise BusLogError(f"log {self.path}: cannot be read: {error.strerror}") from error
        except AmbiguousChannelError:
            raise
        except ValueError as error:
            raise BusLogError(f"log {self.path}: {' '.join(str(error).split())}") from error

    def _received(self) -> Iterator[Received]:
        with self.path.open("rb") as file:
            _require_bare(file.peek(2))
            lines = LogLines(file)
            inboxes: dict[str, Inbox] = {}
            carriers: dict[type, str] = {}
            accepted_line = 0
            for frame in self._frames(lines):
                channel = _channel_name(frame, self._suffix)
                inbox = inboxes.setdefault(channel, Inbox(ANY_SOURCE))
                if self._channel not in (None, channel):
                    continue
                inbox.skipped = self.skipped
                received = inbox.receive(frame)
                if received is None:
                    continue
                accepted_line = lines.number
                self._require_one(carriers, received, channel)
                yield received
            if lines.is_unfinished and accepted_line != lines.number:
                lines.leave_out("a part of a line")
            self._check_content(lines, inboxes)
            self.damage = self.damage or lines.damage

    def _frames(self, lines: LogLines) -> Iterator[can.Message]:
        suffix = self._suffix
        if suffix == ".blf":
            return self._blf_frames()
        if suffix == ".db":
            return self._db_frames()
        return asc_frames(lines) if suffix == ".asc" else text_frames(lines, line_reader(suffix))

    def _blf_frames(self) -> Iterator[can.Message]:
        # Opened here: the reader leaves the file open when its header is not a log's.
        with self.path.open("rb") as file:
            damaged_from = check_blf(file)
            if damaged_from is not None:
                self.damage = f"is cut off or damaged at byte {damaged_from}: what stands before it is read"
            file.seek(0)
            try:
                yield from can.BLFReader(file)
            except (struct.error, zlib.error, BLFParseError):
                self.damage = (
                    self.damage or f"is damaged before byte {file.tell()}: what stands before is read"
                )

    def _db_frames(self) -> Iterator[can.Message]:
        reader = can.SqliteReader(self.path)
        is_begun = False
        try:
            for frame in reader:
                is_begun = True
                yield frame
        except sqlite3.DatabaseError as error:
            if not is_begun:
                raise BusLogError(f"is no database of python-can: {error}") from None
            self.damage = f"is cut off or damaged ({error}): what stands before it is read"
        finally:
            reader.stop()

    def _require_one(self, carriers: dict[type, str], received: Received, channel: str) -> None:
        """Raise AmbiguousChannelError where a second channel brings a message of a robot."""
        kind = type(received.message)
        if (
            message_layout(kind.__name__).senders == ["ROBOT"]
            and carriers.setdefault(kind, channel) != channel
        ):
            raise AmbiguousChannelError(
                f"log {self.path}: the channels {carriers[kind]} and {channel} both carry {kind.__name__}"
            )

    def _check_content(self, lines: LogLines, inboxes: dict[str, Inbox]) -> None:
        """Raise BusLogError for a log without frames, or without any of the channel that was chosen."""
        if self._channel is not None and inboxes and self._channel not in inboxes:
            raise BusLogError(
                f"has no frame of the channel {self._channel}; there are {', '.join(sorted(inboxes))}"
            )
        is_cut_after_head = lines.is_unfinished and lines.unreadable == [lines.number] and lines.number > 1
        if not inboxes and lines.unreadable and not is_cut_after_head:
            raise BusLogError(
                f"line {lines.unreadable[0]} is none as {_WRITERS[self._suffix]} write it: "
                f"{lines.first_unreadable[:60]!r}; name the log by its format, one of {', '.join(_WRITERS)}"
            )


def _require_bare(start: bytes) -> None:
    """Raise BusLogError for a file whose first bytes are those of a packed one, or of UTF-16."""
    if start.startswith(b"\x1f\x8b"):
        raise BusLogError("is packed by gzip: unpack it, as by gunzip")
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise BusLogError("is UTF-16: save it as UTF-8")


def _channel_name(frame: can.Message, suffix: str) -> str:
    """Return a frame's channel as its log and its user name it."""
    if isinstance(frame.channel, int) and suffix == ".blf":
        # python-can counts from 0.
        return str(frame.channel + 1)
    return "1" if frame.channel is None else str(frame.channel)


LARGEST_CONTAINER_BYTES = 2**24
"""Packed or unpacked; Vector's tools write containers of 128 KiB."""

_FILE_HEADER = struct.Struct("<4sL")
_OBJECT_HEADER = struct.Struct("<4sHHLL")
_CONTAINER_HEADER = struct.Struct("<H6xL4x")
_CONTAINER, _ZLIB = 10, 2


def check_blf(file: BinaryIO) -> int | None:
    """Return the byte from which on a BLF file is damaged, None if all of its objects are whole.

    It is walked before python-can reads it: a few bytes may unpack to gigabytes, or turn it in circles. A
    file is a header and objects; those of type 10 are containers, packed by zlib, of the objects proper,
    which may run on from one container into the next (Vector's `binlog_objects.h`, as python-can reads it).
    What the file's end cuts off, or what is no object, ends it: whoever wrote it was killed, or lost power.
    ValueError for an object that is too large, or too small to be one, and for a file that is no BLF.
    """
    header = file.read(_FILE_HEADER.size)
    if not header.startswith(b"LOGG"[: len(header)]) or not header:
        raise ValueError("is no BLF file, as Vector's tools write it; name the log by its format")
    if len(header) < _FILE_HEADER.size:
        return 0
    file.seek(_FILE_HEADER.unpack(header)[1])
    rest = b""
    while True:
        start = file.tell()
        header = file.read(_OBJECT_HEADER.size)
        if not header:
            return None
        if len(header) < _OBJECT_HEADER.size:
            return start
        signature, _, _, size, kind = _OBJECT_HEADER.unpack(header)
        if signature != b"LOBJ":
            return start
        _check_size(size, LARGEST_CONTAINER_BYTES, "an object")
        content = file.read(size - _OBJECT_HEADER.size)
        if len(content) < size - _OBJECT_HEADER.size:
            return start
        file.read(size % 4)
        if kind == _CONTAINER:
            try:
                rest = _walk(rest + _unpack(content))
            except (zlib.error, struct.error):
                return start


def _unpack(content: bytes) -> bytes:
    method, _ = _CONTAINER_HEADER.unpack_from(content)
    packed = content[_CONTAINER_HEADER.size :]
    if method != _ZLIB:
        return packed
    unpacking = zlib.decompressobj()
    unpacked = unpacking.decompress(packed, LARGEST_CONTAINER_BYTES)
    if unpacking.unconsumed_tail:
        raise ValueError(f"a container unpacks to more than {LARGEST_CONTAINER_BYTES} bytes")
    return unpacked


def _walk(objects: bytes) -> bytes:
    """Check the objects that lie one after another; return what continues in the next container."""
    position = 0
    while True:
        start = objects.find(b"LOBJ", position, position + 8)
        if start < 0 or start + _OBJECT_HEADER.size > len(objects):
            return objects[position:]
        size = _OBJECT_HEADER.unpack_from(objects, start)[3]
        # An object holds some kilobytes at most: a text, or 9000 bytes of Ethernet.
        _check_size(size, 2**20, "an object in a container")
        if start + size > len(objects):
            return objects[position:]
        position = start + size


def _check_size(size: int, max_size: int, what: str) -> None:
    if not _OBJECT_HEADER.size <= size <= max_size:
        raise ValueError(f"{what} of {size} bytes: {_OBJECT_HEADER.size} to {max_size} are possible")
