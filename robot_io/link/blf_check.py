"""A BLF file walked before python-can reads it: a few bytes may unpack to gigabytes, or turn it in circles.

A file is a header and objects; those of type 10 are containers, packed by zlib, of the objects proper, which
may run on from one container into the next (Vector's `binlog_objects.h`, as python-can reads it).
"""

import struct
import zlib
from typing import BinaryIO

LARGEST_CONTAINER_BYTES = 2**24
"""Packed or unpacked; Vector's tools write containers of 128 KiB."""

_FILE_HEADER = struct.Struct("<4sL")
_OBJECT_HEADER = struct.Struct("<4sHHLL")
_CONTAINER_HEADER = struct.Struct("<H6xL4x")
_CONTAINER, _ZLIB = 10, 2


def check_blf(file: BinaryIO) -> int | None:
    """Return the byte from which on a BLF file is damaged, None if all of its objects are whole.

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
