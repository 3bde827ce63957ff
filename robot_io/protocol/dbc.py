"""The bus layout, read once from `arctrack.dbc`: data ids, cycle times, unknown codes, a table of it all."""

from __future__ import annotations

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


SOURCE_STEP = 0x100
"""How far the E2E data ids of two sources are apart."""


@cache
def e2e_data_id(layout: Message, source: Source = Source.LIVE) -> int:
    """Return the E2E data id of a message (16 bit) from a source.

    The CRC covers it: a frame of another source fails the check of who listens to one.
    """
    return int(_attribute(layout, "E2EDataId")) + SOURCE_STEP * source


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
            f"{signal.scale:.9g} {signal.offset:.9g} {_range(signal)} {signal.unit or ''} "
            f"{invalid_raw(signal)} {_choices(signal)}"
            for signal in sorted(layout.signals, key=lambda s: s.start)
        ]
    return zlib.crc32("\n".join(lines).encode("utf-8")) & 0xFFFFFF


def dbc_version(source: Source = Source.LIVE) -> DbcVersion:
    """Return the version message of this layout."""
    major, minor, patch = (int(part) for part in (database().version or "").split("."))
    return DbcVersion(major=major, minor=minor, patch=patch, layout_checksum=layout_checksum(), source=source)


def messages_table() -> str:
    """Return the layout as Markdown: one table of the messages, one table of signals for each message."""
    layouts = sorted(database().messages, key=lambda m: m.frame_id)
    lines = ["| id | message | from | cycle, ms | E2E data id |", "| --- | --- | --- | --- | --- |"]
    lines += [
        f"| 0x{layout.frame_id:03X} | `{layout.name}` | {', '.join(layout.senders).lower()} "
        f"| {1000.0 * cycle_time_s(layout):g} | 0x{e2e_data_id(layout):04X} |"
        for layout in layouts
    ]
    for layout in layouts:
        lines += ["", f"### 0x{layout.frame_id:03X} `{layout.name}`", "", layout.comment or "", ""]
        lines += [
            "| bits | signal | scale | range | unknown | meaning |",
            "| --- | --- | --- | --- | --- | --- |",
        ]
        lines += [_signal_row(signal) for signal in payload_signals(layout)]
    return "\n".join(lines) + "\n"


def _signal_row(signal: Signal) -> str:
    unknown = invalid_raw(signal)
    meaning = signal.comment or ""
    # The code of a number that is unknown has a column of its own.
    if signal.choices and set(signal.choices) != {unknown}:
        meaning += f" {_choices(signal)}"
    bits = str(signal.start) if signal.length == 1 else f"{signal.start}–{signal.start + signal.length - 1}"
    # Of a state the meaning lists the values, of a bit there are two.
    is_number = signal.length > 1 and (not signal.choices or set(signal.choices) == {unknown})
    scale = f"{signal.scale:g}" if is_number else ""
    limits = f"{_range(signal)} {signal.unit or ''}".rstrip() if is_number else ""
    return (
        f"| {bits} {'s' if signal.is_signed else 'u'}{signal.length} | `{signal.name}` | {scale} | {limits} "
        f"| {'' if unknown is None else unknown} | {meaning} |"
    )


def _range(signal: Signal) -> str:
    return f"{signal.minimum:.9g} … {signal.maximum:.9g}"


def _choices(signal: Signal) -> str:
    choices: Mapping[int, str | NamedSignalValue] = signal.choices or {}
    return ", ".join(
        f"{raw} {value.name if isinstance(value, NamedSignalValue) else value}"
        for raw, value in sorted(choices.items())
    )


def _attribute(layout: Message, name: str) -> int:
    attributes = layout.dbc.attributes if layout.dbc is not None else {}
    return int(attributes[name].value)
