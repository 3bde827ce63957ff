"""The CRC as `docs/reference/can.md` gives it to an integrator: its C, its parameters, its known answers."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from e2e.p11 import e2e_p11_protect
from hypothesis import given
from hypothesis import strategies as st

from robot_io.protocol.dbc import e2e_data_id, message_layout
from robot_io.protocol.messages import Source

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "can.md").read_text(encoding="utf-8")
KNOWN = [
    (int(data_id, 16), bytes.fromhex(frame))
    for data_id, frame in re.findall(
        r"\| (0x\w+) \| `([0-9A-F ]+)` \|", PAGE.split("<!-- crc: begin -->")[1].split("<!-- crc: end")[0]
    )
]


def protected(data_id: int, frame: bytes) -> bytes:
    buffer = bytearray(frame)
    e2e_p11_protect(buffer, data_id, increment_counter=False)
    return bytes(buffer)


def crc8(data: bytes, polynomial: int, init: int, xorout: int) -> int:
    crc = init
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1) ^ (polynomial if crc & 0x80 else 0)
            crc &= 0xFF
    return crc ^ xorout


def test_the_known_answers_are_what_the_bus_carries() -> None:
    live, replay = (e2e_data_id(message_layout("SeamOffset"), s) for s in (Source.LIVE, Source.REPLAY))
    assert [data_id for data_id, _ in KNOWN] == [0x123, live, live, replay]
    for data_id, frame in KNOWN:
        assert protected(data_id, frame) == frame


def test_the_parameters_are_those_of_the_page_and_not_those_of_sae_j1850() -> None:
    row = re.search(r"\| (0x\w+) \| (0x\w+) \| no \| (0x\w+) \| (0x\w+) \|", PAGE)
    assert row is not None
    polynomial, init, xorout, check = (int(value, 16) for value in row.groups())
    assert crc8(b"123456789", polynomial, init, xorout) == check
    for data_id, frame in KNOWN:
        covered = data_id.to_bytes(2, "little") + frame[1:]
        assert crc8(covered, polynomial, init, xorout) == frame[0]
        assert crc8(covered, polynomial, 0xFF, 0xFF) != frame[0]
    assert "0xB0 for the first known answer" in PAGE
    assert crc8(bytes([0x23, 0x01, *bytes(7)]), 0x1D, 0xFF, 0xFF) == 0xB0


@pytest.fixture(scope="module")
def e2e_crc(tmp_path_factory):
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    folder = tmp_path_factory.mktemp("crc")
    source, library = folder / "crc.c", folder / "crc.so"
    source.write_text(PAGE.split("```c\n")[1].split("```")[0])
    subprocess.run(
        [compiler, "-Wall", "-Werror", "-shared", "-fPIC", "-o", library, source],
        check=True,
        stdin=subprocess.DEVNULL,
    )
    return ctypes.CDLL(str(library)).e2e_crc


@given(st.integers(0, 0xFFFF), st.binary(min_size=8, max_size=8))
def test_the_c_of_the_page_computes_it(e2e_crc, data_id, frame) -> None:
    for each_id, each in (*KNOWN, (data_id, protected(data_id, frame))):
        assert e2e_crc(each_id, each) & 0xFF == each[0]
