"""The bus layout, read once from `arctrack.dbc`: data ids, cycle times, unknown codes."""

import zlib
from collections.abc import Mapping
from functools import cache
from importlib import resources

from cantools.database.can import Database, Message, Signal
from cantools.database.namedsignalvalue import NamedSignalValue

from robot_io.protocol.messages import DbcVersion, Source

HEADER_SIGNALS = ("e2e_crc", "e2e_counter")
"""The signals of the E2E header, which every message has and no dataclass shows."""


@cache
def database() -> Database:
    """Return the layout of the bus."""
    layout = Database()
    layout.add_dbc_string(
        resources.files("robot_io.protocol").joinpath("arctrack.dbc").read_text(encoding="utf-8")
    )
    return layout


def message_layout(name: str) -> Message:
    """Return the layout of one message by its name; KeyError for a name that the bus does not know."""
    return database().get_message_by_name(name)


@cache
def e2e_data_id(layout: Message, source: Source = Source.LIVE) -> int:
    """Return the E2E data id of a message (16 bit) from a source.

    The CRC covers it: a frame of another source fails the check of who listens to one.
    """
    # The ids of two sources are 0x100 apart.
    return int(_attribute(layout, "E2EDataId")) + 0x100 * source


@cache
def cycle_time_s(layout: Message) -> float:
    """Return the cycle time of a message, s."""
    return int(_attribute(layout, "GenMsgCycleTime")) / 1000.0


def invalid_raw(signal: Signal) -> int | None:
    """Return the raw code by which a signal says that it is unknown, or None where it cannot be unknown."""
    attributes = signal.dbc.attributes if signal.dbc is not None else {}
    return int(attributes["InvalidRaw"].value) if "InvalidRaw" in attributes else None


def payload_signals(layout: Message) -> list[Signal]:
    """Return the signals of a message without its E2E header, in order of their bits."""
    return sorted((s for s in layout.signals if s.name not in HEADER_SIGNALS), key=lambda s: s.start)


@cache
def layout_checksum() -> int:
    """Return the low 24 bits of a CRC-32 over what a receiver must agree with; comments do not count."""
    lines = []
    for layout in sorted(database().messages, key=lambda m: m.frame_id):
        lines.append(
            f"{layout.frame_id:03X} {layout.name} {layout.length} {','.join(layout.senders)} "
            f"{cycle_time_s(layout):g} {e2e_data_id(layout):04X}"
        )
        lines += [
            f"{signal.name} {signal.start} {signal.length} {signal.byte_order} {signal.is_signed} "
            f"{signal.scale:.9g} {signal.offset:.9g} {signal_range(signal)} {signal.unit or ''} "
            f"{invalid_raw(signal)} {signal_choices(signal)}"
            for signal in sorted(layout.signals, key=lambda s: s.start)
        ]
    return zlib.crc32("\n".join(lines).encode("utf-8")) & 0xFFFFFF


def dbc_version(source: Source = Source.LIVE) -> DbcVersion:
    """Return the version message of this layout."""
    major, minor, patch = (int(part) for part in (database().version or "").split("."))
    return DbcVersion(major=major, minor=minor, patch=patch, layout_checksum=layout_checksum(), source=source)


def signal_range(signal: Signal) -> str:
    """Return the range of a signal as text."""
    return f"{signal.minimum:.9g} … {signal.maximum:.9g}"


def signal_choices(signal: Signal) -> str:
    """Return the raw values that have a name, and these, as text."""
    choices: Mapping[int, str | NamedSignalValue] = signal.choices or {}
    return ", ".join(
        f"{raw} {value.name if isinstance(value, NamedSignalValue) else value}"
        for raw, value in sorted(choices.items())
    )


def _attribute(layout: Message, name: str) -> int:
    attributes = layout.dbc.attributes if layout.dbc is not None else {}
    return int(attributes[name].value)
