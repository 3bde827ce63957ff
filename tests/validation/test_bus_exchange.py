"""The exchange that the documentation shows, and what an independent reader of the DBC makes of its log."""

from __future__ import annotations

import math
from dataclasses import fields
from enum import IntEnum
from importlib import resources
from pathlib import Path

import can
import cantools
import pytest

from robot_io import MESSAGE_TYPES, BusLogWriter, GateReason, SeamOffset, Source, TrackerStatus, Validity
from robot_io.protocol.bus_load import frame_bits, frames_per_s
from validation.bus_exchange import exchange
from validation.bus_page import with_tables

CAN_PAGE = Path(__file__).parents[2] / "docs" / "reference" / "can.md"


def test_the_page_shows_the_tables() -> None:
    page = CAN_PAGE.read_text(encoding="utf-8")
    assert page == with_tables(page), "run: python -m validation.bus_page docs/reference/can.md"
    assert page != with_tables(page.replace("SeamOffset", "SeamOffer"))


def test_the_load_is_that_of_the_longest_frames() -> None:
    # Davis et al., table of the paper: 8 bytes of data, 135 bits.
    assert frame_bits(8) == 135
    assert frame_bits(0) == 55
    # Poses, status, command, sync, pulse of the robot; heartbeat, echo, version of the tracker; three frames
    # of a find, asked for each second; four a frame.
    assert frames_per_s(50.0) == pytest.approx(200 + 50 + 10 + 10 + 10 + 10 + 10 + 1 + 3 + 4 * 50)


def test_the_exchange_starts_softly() -> None:
    messages = [message for _, _, message, _, _ in exchange()]
    offsets = [m for m in messages if isinstance(m, SeamOffset)]
    assert [m.validity for m in offsets] == [Validity.REFUSED] + [Validity.VALID] * 3 + [Validity.REFUSED]
    assert [m.offset_y_mm for m in offsets[1:4]] == pytest.approx([0.0, 0.4, 0.6])
    reasons = [m.gate_reason for m in messages if isinstance(m, TrackerStatus)]
    assert reasons == [
        GateReason.NOT_ARMED,
        GateReason.SOFT_START,
        GateReason.SOFT_START,
        GateReason.NONE,
        GateReason.NOT_ARMED,
    ]


def test_cantools_reads_the_same_off_the_log(tmp_path: Path) -> None:
    said = list(exchange())
    with BusLogWriter(tmp_path / "bus.blf") as log:
        for at_s, _, _, identifier, payload in said:
            log.write(
                can.Message(timestamp=at_s, arbitration_id=identifier, data=payload, is_extended_id=False)
            )
    dbc = cantools.database.load_string(
        resources.files("robot_io.protocol").joinpath("arctrack.dbc").read_text(encoding="utf-8"), "dbc"
    )
    with can.BLFReader(tmp_path / "bus.blf") as frames:
        for frame, (_, _, message, _, _) in zip(frames, said, strict=True):
            layout = dbc.get_message_by_frame_id(frame.arbitration_id)
            assert layout.name == type(message).__name__
            decoded = layout.decode(frame.data)
            for field in fields(message):
                value, read = getattr(message, field.name), decoded[field.name]
                signal = layout.get_signal_by_name(field.name)
                if isinstance(value, IntEnum):
                    assert str(read) == value.name
                elif value is None or math.isnan(value):
                    assert str(read) == "UNKNOWN"
                else:
                    assert abs(float(read) - value) <= 0.5 * signal.scale + 1e-9
    assert {type(message) for _, _, message, _, _ in said} == set(MESSAGE_TYPES)
    assert Source.LIVE in {getattr(message, "source", None) for _, _, message, _, _ in said}
