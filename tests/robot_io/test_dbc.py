from __future__ import annotations

import dataclasses
import itertools
import math
from enum import IntEnum
from typing import get_type_hints

import pytest
from e2e.p11 import e2e_p11_protect

from robot_io.protocol.codec import encode
from robot_io.protocol.dbc import (
    HEADER_SIGNALS,
    cycle_time_s,
    database,
    dbc_version,
    e2e_data_id,
    invalid_raw,
    layout_checksum,
    payload_signals,
)
from robot_io.protocol.messages import MESSAGE_TYPES, SeamOffset, Validity
from robot_io.protocol.protect import SOURCES

LAYOUTS = database().messages


def test_layout_and_dataclasses_name_the_same_signals():
    assert {layout.name for layout in LAYOUTS} == {t.__name__ for t in MESSAGE_TYPES}
    for message_type in MESSAGE_TYPES:
        layout = database().get_message_by_name(message_type.__name__)
        assert [s.name for s in payload_signals(layout)] == [f.name for f in dataclasses.fields(message_type)]


def test_value_tables_are_the_enumerations():
    for message_type in MESSAGE_TYPES:
        hints = get_type_hints(message_type)
        for signal in payload_signals(database().get_message_by_name(message_type.__name__)):
            hint = hints[signal.name]
            choices = {k: str(v) for k, v in signal.choices.items()} if signal.choices else {}
            if isinstance(hint, type) and issubclass(hint, IntEnum):
                assert choices == {m.value: m.name for m in hint}
                if "UNKNOWN" in choices.values():
                    assert invalid_raw(signal) == hint.UNKNOWN
            else:
                unknown = invalid_raw(signal)
                assert choices == ({} if unknown is None else {unknown: "UNKNOWN"})


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_every_message_is_classic_intel_with_the_e2e_header(layout):
    assert layout.length == 8
    assert not layout.is_extended_frame
    assert not layout.is_fd
    assert 0x110 <= layout.frame_id <= 0x11F
    assert {s.byte_order for s in layout.signals} == {"little_endian"}
    header = [layout.get_signal_by_name(name) for name in HEADER_SIGNALS]
    assert [(s.start, s.length) for s in header] == [(0, 8), (8, 4)]
    assert layout.comment
    assert cycle_time_s(layout) > 0.0
    assert all(s.comment and len(s.name) <= 32 for s in payload_signals(layout))
    # The codec knows of no offset.
    assert {s.offset for s in payload_signals(layout)} == {0}


def test_a_tool_that_reads_the_dbc_shows_a_refused_offset_as_unknown():
    layout = database().get_message_by_name("SeamOffset")
    refused = SeamOffset(math.nan, math.nan, math.nan, math.nan, Validity.REFUSED)
    shown = layout.decode(bytes(encode(refused)[1]))
    names = ("offset_y_mm", "offset_z_mm", "capture_age_ms", "confidence")
    assert [str(shown[name]) for name in names] == ["UNKNOWN"] * 4


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_unknown_codes_are_the_extreme_ones_and_outside_the_range(layout):
    for signal in payload_signals(layout):
        unknown = invalid_raw(signal)
        if unknown is None:
            continue
        min_code, all_ones = -(1 << (signal.length - 1)), (1 << signal.length) - 1
        assert unknown == (min_code if signal.is_signed else all_ones)
        if set(signal.choices) == {unknown}:
            assert not signal.minimum <= unknown * signal.scale + signal.offset <= signal.maximum


def test_no_message_can_pass_for_another():
    # Two data ids with the same CRC contribution would let one message be taken for the other.
    crcs = set()
    for layout, source in itertools.product(LAYOUTS, SOURCES):
        frame = bytearray(8)
        e2e_p11_protect(frame, e2e_data_id(layout, source), increment_counter=False)
        crcs.add(frame[0])
    assert len(crcs) == len(LAYOUTS) * len(SOURCES)


def test_layout_changes_only_together_with_the_version():
    # A new layout needs a new version in arctrack.dbc and a new line here; the old lines stay.
    checksums = {
        (1, 0, 0): LAYOUT_1_0_0,
        (1, 1, 0): LAYOUT_1_1_0,
        (1, 1, 1): LAYOUT_1_1_0,
        (1, 2, 0): LAYOUT_1_2_0,
        (1, 3, 0): LAYOUT_1_3_0,
        (1, 3, 1): LAYOUT_1_3_0,
        (1, 4, 0): LAYOUT_1_4_0,
        (1, 5, 0): LAYOUT_1_5_0,
        (1, 6, 0): LAYOUT_1_6_0,
        (1, 7, 0): LAYOUT_1_7_0,
        (1, 8, 0): LAYOUT_1_8_0,
    }
    version = dbc_version()
    assert checksums[version.major, version.minor, version.patch] == layout_checksum()


LAYOUT_1_0_0 = 0xF5A298
LAYOUT_1_1_0 = 0xFF894D
LAYOUT_1_2_0 = 0xAD60DA
LAYOUT_1_3_0 = 0x976BA9
LAYOUT_1_4_0 = 0xD7EEE7
LAYOUT_1_5_0 = 0x80D38E
LAYOUT_1_6_0 = 0xCC8EA3
LAYOUT_1_7_0 = 0x08FA53
LAYOUT_1_8_0 = 0x2AAE9B
