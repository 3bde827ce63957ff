"""The tables of the page on the bus: python -m validation.bus_page docs/reference/can.md makes them anew."""

from __future__ import annotations

import math
import sys
from dataclasses import fields
from enum import IntEnum
from pathlib import Path

from cantools.database.can import Signal

from robot_io import BusMessage, cycle_time_s, database
from robot_io.protocol.bus_load import frame_bits, frames_per_s, load_share
from robot_io.protocol.dbc import e2e_data_id, invalid_raw, payload_signals, signal_choices, signal_range
from validation.bus_exchange import exchange

BIT_RATES_BIT_S = (125_000, 250_000, 500_000)
FRAME_RATES_HZ = (25, 50, 100, 200)


def with_tables(page: str) -> str:
    """Return the page with its tables as the code says them: each stands between two marks."""
    for name, table in (("load", load_table), ("exchange", exchange_table), ("messages", messages_table)):
        begin, end = f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"
        before, _, rest = page.partition(begin)
        _, _, behind = rest.partition(end)
        page = before + begin + table() + end + behind
    return page


def load_table() -> str:
    """Return the load as Markdown: frames a second and the share of each bit rate, by camera."""
    rates = " | ".join(f"{bit_rate // 1000} kbit/s" for bit_rate in BIT_RATES_BIT_S)
    lines = [
        f"| camera, frames a second | frames on the bus a second | kbit/s | of {rates} |",
        "| ---: " * (3 + len(BIT_RATES_BIT_S)) + "|",
    ]
    for frame_rate_hz in FRAME_RATES_HZ:
        per_s = frames_per_s(frame_rate_hz)
        shares = " | ".join(
            f"{100.0 * load_share(frame_rate_hz, bit_rate):.0f} %" for bit_rate in BIT_RATES_BIT_S
        )
        lines.append(f"| {frame_rate_hz} | {per_s:.0f} | {frame_bits() * per_s / 1000.0:.1f} | {shares} |")
    return "\n".join(lines) + "\n"


def exchange_table() -> str:
    """Return the exchange as Markdown: what is new in each message, and no message without news."""
    lines = ["| ms | from | id | bytes | message | says |", "| ---: | --- | --- | --- | --- | --- |"]
    before: dict[int, dict[str, str]] = {}
    for at_s, sender, message, identifier, payload in exchange():
        values = _values(message)
        changed = dict(values.items() - before.get(identifier, {}).items())
        says = ", ".join(f"{name} {value}" for name, value in values.items() if name in changed)
        before[identifier] = values
        if says:
            lines.append(
                f"| {1000.0 * at_s:.0f} | {sender} | 0x{identifier:03X} | `{payload.hex(' ').upper()}` "
                f"| `{type(message).__name__}` | {says} |"
            )
    return "\n".join(lines) + "\n"


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
            "| bits | signal | values | meaning |",
            "| --- | --- | --- | --- |",
        ]
        lines += [_signal_row(signal) for signal in payload_signals(layout)]
    return "\n".join(lines) + "\n"


def _signal_row(signal: Signal) -> str:
    bits = str(signal.start) if signal.length == 1 else f"{signal.start}–{signal.start + signal.length - 1}"
    return (
        f"| {bits} {'s' if signal.is_signed else 'u'}{signal.length} | `{signal.name}` "
        f"| {_signal_values(signal)} | {signal.comment or ''} |"
    )


def _signal_values(signal: Signal) -> str:
    """Return a number's range, step and unknown code, a state's values, and nothing for a bit."""
    unknown = invalid_raw(signal)
    if signal.choices and set(signal.choices) != {unknown}:
        return signal_choices(signal)
    if signal.length == 1:
        return ""
    step = "" if signal.scale == 1 else f", step {signal.scale:g}"
    code = "" if unknown is None else f"; unknown {unknown}"
    return f"{signal_range(signal)} {signal.unit or ''}".rstrip() + step + code


def _values(message: BusMessage) -> dict[str, str]:
    """Return what a message says by its signals' names, its flags only where they are set."""
    return {
        field.name: _value(getattr(message, field.name))
        for field in fields(message)
        if getattr(message, field.name) is not False
    }


def _value(value: float | int | IntEnum | None) -> str:
    if isinstance(value, IntEnum):
        return value.name
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "unknown"
    return f"{value:g}" if isinstance(value, float) else str(int(value))


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_tables(path.read_text(encoding="utf-8")), encoding="utf-8")
