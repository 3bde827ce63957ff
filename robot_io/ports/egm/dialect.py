r"""EgmRobot in, EgmSensorPathCorr out, by ABB's egm.proto (ros-industrial/abb_libegm, V1.1).

An EgmSensorPathCorr cannot say that it does not count. So where no offset counts nothing is sent, and EGM's
own \CommTimeout tells the program.

EGM has a handful of fixed messages of numbers. Their encoding (protobuf.dev/programming-guides/encoding) is
shorter than the generated classes and the runtime that would read them.
"""

import struct
from collections.abc import Iterator

from robot_io.ports.report import Dialect, PortCorrection, PortError, PortReport, ProgramWord

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


DATA, PATH_CORRECTION = 2, 4
"""EgmHeader.MessageType of the robot's messages and of ours."""

MOTORS_ON, MCI_RUNNING, RAPID_RUNNING = 1, 3, 2

HEADER, FEEDBACK, MOTORS, MCI, RAPID, FROM_RAPID = 1, 2, 4, 5, 8, 13
"""Fields of EgmRobot; RAPIDfromRobot is RobotWare 7's."""


class EgmDialect(Dialect):
    """ABB's side of EGM path correction.

    The program's word is the first number of RAPIDfromRobot. `running_word` stands for it where a controller
    has no such message (RobotWare 6), while RAPID runs.
    """

    def __init__(self, running_word: int | None = None) -> None:
        self._running_word = None if running_word is None else ProgramWord(running_word)
        self._seqno = 0

    def hear(self, data: bytes) -> tuple[list[PortReport], bytes]:
        """Return the report of a datagram."""
        robot = values(data)
        header = inner(robot, HEADER)
        if whole(header, 3) != DATA:
            raise PortError("a header of another type than MSGTYPE_DATA")
        pose = inner(inner(robot, FEEDBACK), 2)
        position, orientation = inner(pose, 1), inner(pose, 2)
        w, x, y, z = (real(orientation, n) for n in (1, 2, 3, 4))
        is_executing = inner(robot, RAPID).get(1) == RAPID_RUNNING
        is_running = is_executing and inner(robot, MCI).get(1) == MCI_RUNNING
        word = self._word(robot, is_executing)
        report = word.report(
            stamp=whole(header, 1),
            robot_time_s=whole(header, 2) / 1000.0,
            position_base_mm=(real(position, 1), real(position, 2), real(position, 3)),
            quaternion_xyzw=(x, y, z, w),
            is_running=is_running,
            is_stopped=inner(robot, MOTORS).get(1) != MOTORS_ON,
        )
        return [report], b""

    def answer(self, report: PortReport, correction: PortCorrection) -> bytes:
        """Return a path correction, or nothing where no offset counts."""
        if not correction.is_usable:
            return b""
        self._seqno = (self._seqno + 1) % 2**32
        header = (
            field(1, self._seqno) + field(2, round(1000.0 * report.robot_time_s)) + field(3, PATH_CORRECTION)
        )
        place = field(1, 0.0) + field(2, correction.y_mm) + field(3, correction.z_mm)
        return field(1, header) + field(2, field(1, place) + field(2, round(correction.age_ms)))

    def _word(self, robot: dict[int, Value], is_executing: bool) -> ProgramWord:
        held = robot.get(FROM_RAPID)
        if held is None:
            stated = self._running_word if is_executing else None
            return ProgramWord(0) if stated is None else stated
        if not isinstance(held, bytes):
            raise PortError("RAPIDfromRobot: must be a message")
        number = next((value for n, value in fields(held) if n == 2), None)
        if not (isinstance(number, float) and number.is_integer()):
            raise PortError("RAPIDfromRobot.dnum: the first must be the program's word, a whole number")
        return ProgramWord(int(number))
