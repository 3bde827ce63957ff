"""Messages to frame bytes and back, by the layout in `arctrack.dbc`; `protect` fills in the E2E header.

No signal of the layout has an offset: a raw code is the value over the scale.
"""

import dataclasses
import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Any, TypeVar, cast, get_args, get_type_hints

from cantools.database.can import Signal

from robot_io.protocol.dbc import HEADER_SIGNALS, database, invalid_raw, message_layout, payload_signals
from robot_io.protocol.messages import MESSAGE_TYPES, BusMessage

M = TypeVar("M", bound=BusMessage)

FRAME_LENGTH = 8
"""Bytes in every frame of the bus."""


class CodecError(ValueError):
    """A value that the bus cannot carry, or bytes that are no message of ours."""


@dataclass(frozen=True)
class _Field:
    """One signal with the Python type of its dataclass field."""

    name: str
    kind: type[float | int | bool | IntEnum]
    scale: float
    raw_minimum: int
    raw_maximum: int
    raw_unknown: int | None
    unit: str

    def to_raw(self, value: float | None, owner: str) -> int:
        """Return the raw code of a value; CodecError if the signal cannot carry it."""
        if value is None or math.isnan(value):
            if self.raw_unknown is None:
                raise CodecError(
                    f"{owner}.{self.name}: is {value}, but this signal cannot say 'unknown'; set it"
                )
            return self.raw_unknown
        if issubclass(self.kind, IntEnum):
            return int(self._member(int(value), owner))
        if not math.isfinite(value):
            raise CodecError(f"{owner}.{self.name}: is {value}; send nan for a value that is not known")
        raw = round(value / self.scale)
        if not self.raw_minimum <= raw <= self.raw_maximum:
            raise CodecError(
                f"{owner}.{self.name}: {value:g} is outside {self._range()}; send what fits or 'unknown'"
            )
        return raw

    def from_raw(self, raw: int, owner: str) -> Any:
        """Return the value of a raw code; CodecError if the layout gives that code no meaning."""
        if issubclass(self.kind, IntEnum):
            return self._member(raw, owner)
        if raw == self.raw_unknown:
            return math.nan if self.kind is float else None
        if not self.raw_minimum <= raw <= self.raw_maximum:
            raise CodecError(
                f"{owner}.{self.name}: raw code {raw} is outside {self._range()}; check the sender's DBC"
            )
        return raw * self.scale if self.kind is float else self.kind(raw)

    def _member(self, raw: int, owner: str) -> IntEnum:
        assert issubclass(self.kind, IntEnum)
        try:
            return self.kind(raw)
        except ValueError:
            names = ", ".join(f"{m.value} {m.name}" for m in self.kind)
            raise CodecError(f"{owner}.{self.name}: {raw} has no meaning; use one of {names}") from None

    def _range(self) -> str:
        low, high = (raw * self.scale for raw in (self.raw_minimum, self.raw_maximum))
        return f"{low:g} to {high:g} {self.unit}".rstrip()


def encode(message: BusMessage) -> tuple[int, bytearray]:
    """Return the identifier of a message and its 8 bytes, the E2E header still zero.

    Values are rounded to the signal's scale, never clipped: CodecError names a signal that cannot carry its
    value.
    """
    name = type(message).__name__
    layout = message_layout(name)
    raw = {f.name: f.to_raw(getattr(message, f.name), name) for f in _fields(name)}
    raw |= dict.fromkeys(HEADER_SIGNALS, 0)
    # The ranges are checked above, in raw codes: the library's own check would refuse the unknown codes.
    return layout.frame_id, bytearray(layout.encode(raw, scaling=False, strict=False))


def decode(arbitration_id: int, frame: bytes | bytearray) -> BusMessage:
    """Return the message in the bytes of a frame, without a look at its E2E header.

    Raises CodecError if the identifier is not ours, the length is not 8, or a raw code has no meaning.
    """
    message_type = message_type_of(arbitration_id)
    if message_type is None:
        raise CodecError(f"identifier 0x{arbitration_id:03X}: no message of arctrack.dbc; skip the frame")
    name = message_type.__name__
    if len(frame) != FRAME_LENGTH:
        raise CodecError(f"{name}: {len(frame)} bytes instead of {FRAME_LENGTH}; check the sender's DBC")
    raw = message_layout(name).decode(bytes(frame), decode_choices=False, scaling=False)
    assert isinstance(raw, dict)
    fields = _fields(name)
    return message_type(**{f.name: f.from_raw(cast(int, raw[f.name]), name) for f in fields})


def out_of_range_as_unknown(message: M) -> M:
    """Return the message with NaN for every number that its signal cannot carry, where NaN can be sent.

    For status values, where a lost number must not cost the message; encode refuses what this cannot help.
    """
    name = type(message).__name__
    lost = {}
    for field in _fields(name):
        if field.kind is float and field.raw_unknown is not None:
            try:
                field.to_raw(getattr(message, field.name), name)
            except CodecError:
                lost[field.name] = math.nan
    return dataclasses.replace(message, **lost) if lost else message


def message_type_of(arbitration_id: int) -> type[BusMessage] | None:
    """Return the message type of an identifier, or None for a foreign one."""
    return _types_by_id().get(arbitration_id)


@cache
def _types_by_id() -> dict[int, type[BusMessage]]:
    by_name = {message_type.__name__: message_type for message_type in MESSAGE_TYPES}
    return {layout.frame_id: by_name[layout.name] for layout in database().messages}


@cache
def _fields(name: str) -> tuple[_Field, ...]:
    layout = message_layout(name)
    hints = get_type_hints(_types_by_id()[layout.frame_id])
    return tuple(_field(signal, hints[signal.name]) for signal in payload_signals(layout))


def _field(signal: Signal, hint: Any) -> _Field:
    scale = float(signal.scale)
    assert signal.minimum is not None
    assert signal.maximum is not None
    return _Field(
        name=signal.name,
        kind=next((arm for arm in get_args(hint) if arm is not type(None)), hint),
        scale=scale,
        raw_minimum=round(signal.minimum / scale),
        raw_maximum=round(signal.maximum / scale),
        raw_unknown=invalid_raw(signal),
        unit=signal.unit or "",
    )
