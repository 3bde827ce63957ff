"""A log on a disk that gets full, and has room again."""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path

import can
import pytest

from robot_io import Link, RobotSync
from robot_io.link.bus_log import BusLogError, BusLogWriteError, BusLogWriter
from robot_io.link.reconnecting import LinkFault
from robot_io.link.steady_log import RETRY_S, SteadyLog


class Disk:
    """A disk whose files take frames while it has room, and a clock."""

    def __init__(self) -> None:
        self.is_full, self.now_s = False, 10.0
        self.faults: Counter[LinkFault] = Counter()
        self.opened: list[str] = []

    def open(self, path: Path) -> BusLogWriter:
        disk = self

        class OnDisk(BusLogWriter):
            def write(self, frame: can.Message) -> None:
                if disk.is_full:
                    raise BusLogWriteError(f"log {self.path}: cannot be written: no room")
                super().write(frame)

            def close(self) -> None:
                super().close()
                if disk.is_full:
                    raise BusLogWriteError(f"log {self.path}: cannot be written: no room")

        self.opened.append(path.name)
        return OnDisk(path)

    def log(self, path: Path) -> SteadyLog:
        return SteadyLog(path, self.faults, self.open, lambda: self.now_s)

    def frame(self, timestamp_s: float) -> can.Message:
        return can.Message(timestamp=timestamp_s, arbitration_id=0x110, data=bytes(8), is_extended_id=False)


def times_s(path: Path) -> list[float]:
    with can.BLFReader(path) as frames:
        return [frame.timestamp for frame in frames]


def test_what_is_not_logged_is_counted_and_the_log_goes_on_in_another_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    disk = Disk()
    log = disk.log(tmp_path / "bus.blf")
    log.write(disk.frame(1.0))
    disk.is_full = True
    for timestamp_s in (2.0, 3.0):
        log.write(disk.frame(timestamp_s))
    # It is tried again, but not for each frame.
    disk.now_s += RETRY_S
    log.write(disk.frame(4.0))
    disk.is_full = False
    log.write(disk.frame(5.0))
    assert disk.faults == Counter({LinkFault.UNLOGGED: 4})
    disk.now_s += RETRY_S
    for timestamp_s in (6.0, 7.0):
        log.require(timestamp_s)
        log.write(disk.frame(timestamp_s))
    log.close()
    assert disk.faults == Counter({LinkFault.UNLOGGED: 4})
    assert disk.opened == ["bus.blf", "bus.1.blf", "bus.1.blf"]
    assert (times_s(tmp_path / "bus.blf"), times_s(tmp_path / "bus.1.blf")) == ([1.0], [6.0, 7.0])
    assert [record.getMessage() for record in caplog.records] == [
        f"log {tmp_path / 'bus.blf'}: cannot be written: no room; frames are left out"
    ]


def test_a_log_that_cannot_be_finished_is_a_fault(tmp_path: Path) -> None:
    disk = Disk()
    log = disk.log(tmp_path / "bus.blf")
    log.write(disk.frame(1.0))
    disk.is_full = True
    log.close()
    assert disk.faults == Counter({LinkFault.UNLOGGED: 1})


def test_a_time_that_no_log_can_hold_is_an_error_all_the_same(tmp_path: Path) -> None:
    disk = Disk()
    log = disk.log(tmp_path / "bus.blf")
    with pytest.raises(BusLogError, match="keep one clock in a log"):
        log.require(-1.0)
    log.close()
    with pytest.raises(BusLogError, match="No such file or directory"):
        SteadyLog(tmp_path / "nowhere" / "bus.blf", disk.faults)


def test_a_link_whose_disk_is_full_sends_on(tmp_path: Path) -> None:
    full = tmp_path / "bus.blf"
    full.symlink_to("/dev/full")
    with Link("virtual", "full disk", log_paths=[full]) as link, Link("virtual", "full disk") as robot:
        for n in range(3):
            assert link.send(RobotSync(n, 0, None), 1.0 + n)
        link.faults.pop(LinkFault.UNSENT, None)
        assert len(list(robot.receive(0.0))) == 3
        assert list(link.receive(0.0)) == []
    assert link.faults[LinkFault.UNLOGGED] == 3
