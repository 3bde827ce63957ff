from __future__ import annotations

import subprocess
import sys

import can
import pytest
from bus_messages import EXAMPLES

from robot_io.link.bus_log import BusLogError, BusLogWriter
from robot_io.link.bus_log_reader import BusLogReader
from robot_io.link.inbox import SkipReason
from robot_io.protocol.codec import decode, encode
from robot_io.protocol.protect import Protector

SUFFIXES = [".blf", ".asc", ".log"]
# What the format itself can tell apart, s.
RESOLUTION_S = {".blf": 2e-9, ".asc": 1e-6, ".log": 1e-6}


def frames(times_s):
    protector = Protector()
    for i, t_s in enumerate(times_s):
        arbitration_id, payload = protector.protect(EXAMPLES[i % len(EXAMPLES)])
        yield can.Message(
            timestamp=t_s,
            arbitration_id=arbitration_id,
            data=payload,
            is_extended_id=False,
            channel="lab99999",
            is_rx=i % 2 == 0,
        )


def write(path, times_s):
    with BusLogWriter(path) as log:
        for frame in frames(times_s):
            log.write(frame)


def on_the_bus(message):
    return decode(*encode(message))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    "first_s", [0.0, 0.1234567, 3.0e4, 1_790_000_000.987654], ids=["zero", "soon", "late", "wall clock"]
)
def test_round_trip_of_messages_and_times(tmp_path, suffix, first_s):
    times_s = [first_s + 0.0123457 * i for i in range(40)]
    path = tmp_path / f"bus{suffix}"
    write(path, times_s)
    log = BusLogReader(path)
    received = list(log)
    # Float seconds of the wall clock are themselves good to some 0.2 µs only.
    tolerance_s = RESOLUTION_S[suffix] + (5e-7 if first_s > 1e9 else 0.0)
    assert [r.timestamp_s for r in received] == pytest.approx(times_s, abs=tolerance_s, rel=0.0)
    expected = [on_the_bus(EXAMPLES[i % len(EXAMPLES)]) for i in range(40)]
    assert [encode(r.message) for r in received] == [encode(message) for message in expected]
    assert not log.skipped
    assert [r.timestamp_s for r in log] == [r.timestamp_s for r in received]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_not_ours_or_fails_is_skipped_and_counted(tmp_path, suffix):
    path = tmp_path / f"bus{suffix}"
    with BusLogWriter(path) as log:
        for frame in frames([0.1, 0.2, 0.3]):
            if frame.timestamp == 0.2:
                frame.data[3] ^= 0x04
            log.write(frame)
            log.write(can.Message(timestamp=frame.timestamp, arbitration_id=0x18FEF100, data=b"\x01\x02"))
        log.write(can.Message(timestamp=0.5, is_error_frame=True))
    reader = BusLogReader(path)
    assert [r.timestamp_s for r in reader] == pytest.approx([0.1, 0.3], rel=0.0, abs=1e-9)
    assert reader.skipped[SkipReason.E2E_ERROR] == 1
    assert reader.skipped[SkipReason.FOREIGN] >= 3


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_times_before_the_start_are_refused(tmp_path, suffix):
    with BusLogWriter(tmp_path / f"bus{suffix}") as log:
        log.require(0.0)
        with pytest.raises(BusLogError, match=r"time -0\.400000 s is before the log's start at 0 s"):
            log.require(-0.4)
        with pytest.raises(BusLogError, match="must be finite"):
            log.require(float("nan"))


def test_a_received_frame_from_before_the_start_gets_the_start(tmp_path):
    path = tmp_path / "bus.asc"
    write(path, [1_790_000_000.5, 1_789_999_000.0])
    assert [r.timestamp_s for r in BusLogReader(path)] == [1_790_000_000.5, 1_789_999_999.0]


@pytest.mark.parametrize("path", ["bus.mf4", "bus"])
def test_unknown_formats(tmp_path, path):
    with pytest.raises(BusLogError, match=r"unknown format .*; use one of \.asc, \.blf, \.log$"):
        BusLogWriter(tmp_path / path)
    with pytest.raises(BusLogError, match=r"unknown format .*; use one of .*\.csv, \.db, \.log, \.trc$"):
        BusLogReader(tmp_path / path)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(BusLogError, match="no such file"):
        BusLogReader(tmp_path / "bus.blf")
    with pytest.raises(BusLogError, match="No such file or directory"):
        BusLogWriter(tmp_path / "nowhere" / "bus.blf")


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("bus.blf", b"not a log at all", "is no BLF file"),
        ("bus.blf", b"\x00" * 400, "is no BLF file"),
        (
            "bus.asc",
            b"base hex\ndate Mi Okt 40 99:00:00 2026\n",
            "line 2: the date 'Mi Okt 40 99:00:00 2026'",
        ),
        ("bus.log", b"\n(x) can0 110#00\n", r"line 2 is none as candump -L write it: '\(x\) can0 110#00'"),
        (
            "bus.log",
            b" can0  110   [8]  00 00 00 00 00 00 00 00\n",
            "line 1: its frames have no times: record them by candump -L",
        ),
        ("bus.log", b"\xff\xfe\x00", "is UTF-16"),
        ("bus.db", b"not a database at all" * 100, "is no database of python-can"),
    ],
)
def test_a_file_that_is_no_log_is_one_clear_line(tmp_path, name, content, problem):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(BusLogError, match=rf"bus\.\w+: {problem}") as caught:
        list(BusLogReader(path))
    assert "\n" not in str(caught.value)


def test_a_killed_writer_loses_little(tmp_path):
    path = tmp_path / "bus.blf"
    with BusLogWriter(path) as log:
        for frame in frames([0.01 * i for i in range(1000)]):
            log.write(frame)
        on_disk = path.read_bytes()
    (tmp_path / "killed.blf").write_bytes(on_disk)
    assert len(list(BusLogReader(tmp_path / "killed.blf"))) > 850


@pytest.mark.slow
def test_of_a_log_that_is_cut_off_all_before_the_cut_is_read(tmp_path):
    whole = tmp_path / "bus.blf"
    write(whole, [0.01 * i for i in range(400)])
    everything, on_disk = [r.timestamp_s for r in BusLogReader(whole)], whole.read_bytes()
    cut = tmp_path / "cut.blf"
    n_before = 0
    for n_bytes in range(144, len(on_disk), 61):
        cut.write_bytes(on_disk[:n_bytes])
        times_s = [r.timestamp_s for r in BusLogReader(cut)]
        assert times_s == everything[: len(times_s)]
        assert len(times_s) >= n_before
        n_before = len(times_s)
    assert n_before > 300


def test_a_full_disk_is_one_line_that_names_the_log(tmp_path):
    path = tmp_path / "bus.blf"
    path.symlink_to("/dev/full")
    log = BusLogWriter(path)
    with pytest.raises(BusLogError, match=r"bus.blf: cannot be written: No space left on device"):
        log.write(can.Message(timestamp=1.0))
    with pytest.raises(BusLogError, match=r"bus.blf: cannot be written: No space left on device"):
        log.close()


BEGUN = """
import sys
import time
from pathlib import Path

import can

from robot_io.link.bus_log import BusLogWriter

log = BusLogWriter(Path(sys.argv[1]))
for n in range(200):
    data = n.to_bytes(8, "big")
    log.write(can.Message(timestamp=1_700_000_000.25 + 0.01 * n, data=data, is_extended_id=False))
print("written", flush=True)
time.sleep(600.0)
"""


QUIET = """
import sys
import time
from pathlib import Path

from robot_io import BusLogWriter, Link, SeamOffset, Validity

link = Link("virtual", "quiet", log_paths=[Path(sys.argv[1])])
link.send(SeamOffset(0.5, 0.25, 8.0, 0.9, Validity.VALID))
time.sleep(1.1)
list(link.receive(0.0))
print("kept", flush=True)
time.sleep(600.0)
"""


@pytest.mark.slow
def test_on_a_quiet_bus_a_killed_process_loses_no_more_than_the_last_second(tmp_path):
    path = tmp_path / "bus.blf"
    with subprocess.Popen([sys.executable, "-c", QUIET, str(path)], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"kept\n"
        process.kill()
    (received,) = BusLogReader(path)
    assert received.message.offset_y_mm == 0.5


@pytest.mark.slow
def test_a_killed_process_leaves_the_time_of_day(tmp_path):
    path = tmp_path / "bus.blf"
    with subprocess.Popen([sys.executable, "-c", BEGUN, str(path)], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"written\n"
        process.kill()
    with can.BLFReader(path) as log:
        times_s = [frame.timestamp for frame in log]
    # What had filled no container is lost.
    assert len(times_s) > 100
    assert times_s == pytest.approx([1_700_000_000.25 + 0.01 * n for n in range(len(times_s))], abs=1e-6)
