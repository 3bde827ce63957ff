"""End-to-end protection of every frame: AUTOSAR E2E profile 11, data ID mode BOTH.

Byte 0 holds the CRC-8 over the data id and the rest of the frame, the low nibble of byte 1 a counter 0 … 14.
Each message has a data id for each source: what a replay or a simulation sends is wrong to who trusts live
frames alone.
"""

from enum import Enum

from cantools.database.can import Message
from e2e.p11 import e2e_p11_check, e2e_p11_protect

from robot_io.protocol.codec import encode
from robot_io.protocol.dbc import e2e_data_id, message_layout
from robot_io.protocol.messages import (
    BusMessage,
    FindResult,
    FoundPosition,
    FoundRotation,
    RobotPosePosition,
    RobotPoseRotation,
    SeamOffset,
    SeamPoint,
    Source,
)

SOURCES = (Source.LIVE, Source.REPLAY, Source.SIMULATION)
"""Sources that a frame can come from."""

_COUNTED_BY: dict[type[BusMessage], type[BusMessage]] = {
    RobotPoseRotation: RobotPosePosition,
    SeamPoint: SeamOffset,
    FoundPosition: FindResult,
    FoundRotation: FindResult,
}
"""Messages that carry the counter of another, the one sent before them: by it the two find each other."""

COUNTER_MODULUS = 15
"""The counter runs 0 … 14; 15 never appears on the bus."""

MAX_DELTA_COUNTER = 3
"""A message may be the third after the last one: two may be lost in a row before the sequence is broken."""


class CheckStatus(Enum):
    """Result of the check of a frame, as AUTOSAR names it."""

    OK = "ok"
    OK_SOME_LOST = "ok_some_lost"
    REPEATED = "repeated"
    WRONG_SEQUENCE = "wrong_sequence"
    ERROR = "error"

    @property
    def accepted(self) -> bool:
        """True if the frame may update state."""
        return self in (CheckStatus.OK, CheckStatus.OK_SOME_LOST)


class Protector:
    """Sender's protection: one counter per message, from 0.

    A RobotPoseRotation carries the counter of the last RobotPosePosition: by it the two halves of a pose find
    each other, and a half that failed to go out cannot put the later pairs out of step. A SeamPoint carries
    that of the last SeamOffset, FoundPosition and FoundRotation that of the last FindResult. Raises
    ValueError for an unknown source.
    """

    def __init__(self, source: Source = Source.LIVE) -> None:
        if source not in SOURCES:
            raise ValueError("source UNKNOWN: a frame is sent as LIVE, REPLAY or SIMULATION")
        self._source = source
        self._counters: dict[str, int] = {}

    def protect(self, message: BusMessage) -> tuple[int, bytes]:
        """Return the identifier and the 8 protected bytes of a message; CodecError as `encode`."""
        arbitration_id, frame = encode(message)
        name = type(message).__name__
        counted_by = _COUNTED_BY.get(type(message))
        if counted_by is not None:
            counter = self._counters.get(counted_by.__name__, 0)
        else:
            counter = (self._counters.get(name, -1) + 1) % COUNTER_MODULUS
            self._counters[name] = counter
        frame[1] = (frame[1] & 0xF0) | counter
        e2e_p11_protect(frame, e2e_data_id(message_layout(name), self._source), increment_counter=False)
        return arbitration_id, bytes(frame)


def source_of(layout: Message, frame: bytes | bytearray) -> Source | None:
    """Return the source whose data id fits a frame's CRC, or None: then the frame is damaged."""
    checked = bytearray(frame)
    return next((source for source in SOURCES if e2e_p11_check(checked, e2e_data_id(layout, source))), None)


class Checker:
    """The receiving side: CRC and counter of one stream of messages per data id.

    As in AUTOSAR, a fresh checker stands one before 0, so that it takes a fresh sender's first frame; one
    that joins a running sender takes the second frame at the latest. A wrong sequence is not accepted but
    becomes the new reference; a CRC error leaves the reference where it was.
    """

    def __init__(self, max_delta_counter: int = MAX_DELTA_COUNTER) -> None:
        if not 1 <= max_delta_counter < COUNTER_MODULUS:
            raise ValueError(f"max_delta_counter {max_delta_counter}: must be 1 to {COUNTER_MODULUS - 1}")
        self._max_delta_counter = max_delta_counter
        self._last_counters: dict[int, int] = {}

    def check(self, data_id: int, frame: bytes | bytearray) -> CheckStatus:
        """Return the status of a frame's CRC and counter, and store the counter unless the CRC is wrong."""
        if not e2e_p11_check(bytearray(frame), data_id):
            return CheckStatus.ERROR
        counter = counter_of(frame)
        delta = (counter - self._last_counters.get(data_id, COUNTER_MODULUS - 1)) % COUNTER_MODULUS
        self._last_counters[data_id] = counter
        if delta == 0:
            return CheckStatus.REPEATED
        if delta > self._max_delta_counter:
            return CheckStatus.WRONG_SEQUENCE
        return CheckStatus.OK if delta == 1 else CheckStatus.OK_SOME_LOST


def counter_of(frame: bytes | bytearray) -> int:
    """Return the E2E counter of a frame."""
    return frame[1] & 0x0F
