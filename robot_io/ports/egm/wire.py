"""Fields of protobuf messages, as far as EGM needs them.

EGM has a handful of fixed messages of numbers. Their encoding (protobuf.dev/programming-guides/encoding) is
shorter than the generated classes and the runtime that would read them.
"""

import struct
from collections.abc import Iterator

from robot_io.ports.report import PortError

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
Value = int | float | bytes


def fields(message: bytes) -> Iterator[tuple[int, Value]]:
    """Yield number and value of each field: int, float (of 64 bits) or bytes; PortError for damage."""
    place = 0
    while place < len(message):
        tag, place = _varint(message, place)
        number, wire_type = tag >> 3, tag & 7
        if wire_type == VARINT:
            value, place = _varint(message, place)
            yield number, value
            continue
        length = {FIXED64: 8, FIXED32: 4}.get(wire_type)
        if wire_type == BYTES:
            length, place = _varint(message, place)
        if length is None or number == 0 or place + length > len(message):
            raise PortError("damaged protobuf")
        held = message[place : place + length]
        place += length
        # EGM has no number of 32 bits: its bytes are handed on, and nobody asks for them.
        yield number, struct.unpack("<d", held)[0] if wire_type == FIXED64 else held


def values(message: bytes) -> dict[int, Value]:
    """Return the last value of each field, as protobuf has it for a field that is no list."""
    return dict(fields(message))


def inner(message: dict[int, Value], number: int) -> dict[int, Value]:
    """Return the fields of a message within another; none where it is missing."""
    held = message.get(number, b"")
    if not isinstance(held, bytes):
        raise PortError(f"field {number}: must be a message")
    return values(held)


def whole(message: dict[int, Value], number: int) -> int:
    """Return a whole number; PortError where it is missing or of another type."""
    value = message.get(number)
    if not isinstance(value, int):
        raise PortError(f"field {number}: a whole number is missing")
    return value


def real(message: dict[int, Value], number: int) -> float:
    """Return a double; PortError where it is missing or of another type."""
    value = message.get(number)
    if not isinstance(value, float):
        raise PortError(f"field {number}: a double is missing")
    return value


def field(number: int, value: Value) -> bytes:
    """Return an encoded field: an int as varint, a float as double, bytes as they are."""
    if isinstance(value, float):
        return _encoded(number << 3 | FIXED64) + struct.pack("<d", value)
    if isinstance(value, int):
        return _encoded(number << 3 | VARINT) + _encoded(value)
    return _encoded(number << 3 | BYTES) + _encoded(len(value)) + value


def _varint(message: bytes, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(message):
            break
        byte = message[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise PortError("damaged protobuf: a number without end")


def _encoded(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*encoded, value])
