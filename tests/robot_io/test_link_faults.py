"""A link on a bus that fails: counted, dropped, opened again; nothing wrong or old goes through."""

from __future__ import annotations

import importlib.util
import itertools
import logging
import os
import socket
import sys
import threading
import time
from dataclasses import asdict, replace

import can
import pytest
from bus_messages import EXAMPLES
from faulty_bus import OPENED, Faults
from slcan_adapters import SlcanAdapters

from robot_io.link import reconnecting
from robot_io.link.inbox import SkipReason
from robot_io.link.link import Link
from robot_io.link.reconnecting import LinkFault
from robot_io.protocol.codec import encode
from robot_io.protocol.messages import RobotStatus, SeamOffset, Validity
from robot_io.protocol.protect import Protector

CHANNELS = (f"test_link_faults_{n}" for n in itertools.count())
OFFSET = EXAMPLES[2]
STATUS = next(m for m in EXAMPLES if isinstance(m, RobotStatus))
needs_serial = pytest.mark.skipif(
    importlib.util.find_spec("serial") is None or sys.platform == "win32",
    reason="pyserial is not installed, or Windows has no pseudo terminals",
)
SLCAN = {"bitrate_bit_s": 500_000, "sleep_after_open": 0.0}


@pytest.fixture(autouse=True)
def _faulty(monkeypatch):
    monkeypatch.setitem(can.interfaces.BACKENDS, "faulty", ("faulty_bus", "FaultyBus"))
    monkeypatch.setattr(reconnecting, "BACK_OFF_S", (0.001,))
    OPENED.clear()


def numbered(n):
    return replace(STATUS, path_section=n % 1000, current_a=0.5 * (n % 100))


@pytest.mark.parametrize("seed", range(12))
def test_whatever_the_bus_does_only_what_was_sent_is_accepted(seed):
    channel = next(CHANNELS)
    faults = Faults(0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
    accepted = []
    with (
        Link("virtual", channel) as robot,
        Link("faulty", channel, faults=faults, seed=seed) as tracker,
    ):
        for n in range(300):
            robot.send(numbered(n))
            accepted += [(n, r.message) for r in tracker.receive(0.0)]
        assert tracker.faults[LinkFault.UNREADABLE] > 0
        assert {SkipReason.E2E_ERROR, SkipReason.REPEATED} <= set(tracker.inbox.skipped)
        # The faults end: within two messages all is well.
        vars(faults).update(vars(Faults()))
        list(tracker.receive(0.0))
        for n in range(300, 310):
            robot.send(numbered(n))
        assert [r.message for r in tracker.receive(0.0)][-8:] == [numbered(n) for n in range(302, 310)]
    assert len(accepted) > 100
    for n, message in accepted:
        # What was sent, and no older than a few messages.
        assert message in [numbered(k) for k in range(max(0, n - 14), n + 1)]


def test_a_queue_that_is_full_once_costs_one_message():
    channel, faults = next(CHANNELS), Faults(full=1.0)
    with Link("faulty", channel, faults=faults) as tracker, Link("virtual", channel) as robot:
        assert not tracker.send(OFFSET)
        faults.full = 0.0
        assert tracker.send(replace(OFFSET, offset_y_mm=1.0))
        assert [r.message.offset_y_mm for r in robot.receive(0.0)] == [1.0]
        assert tracker.faults == {LinkFault.UNSENT: 1}


def test_nothing_that_was_blocked_comes_later():
    channel, faults = next(CHANNELS), Faults(block=1.0)
    with Link("faulty", channel, faults=faults) as tracker, Link("virtual", channel) as robot:
        for n in range(50):
            assert not tracker.send(replace(OFFSET, offset_y_mm=0.1 * n))
        faults.block = 0.0
        tracker.send(replace(OFFSET, offset_y_mm=9.0))
        # Fifty counters on: the first one is out of sequence, the second is taken.
        tracker.send(replace(OFFSET, offset_y_mm=9.5))
        assert [r.message.offset_y_mm for r in robot.receive(0.0)][-1] == 9.5


def until(condition, link):
    """Read a link until something is so; a test that waits in vain is stopped from outside."""
    heard = []
    while not condition(heard):
        heard += link.receive(0.001)
    return heard


@pytest.mark.parametrize("what", ["is_gone", "is_off"])
def test_a_bus_that_goes_away_is_opened_again(what, caplog, monkeypatch):
    monkeypatch.setattr(reconnecting, "LOST_AFTER_S", 0.005)
    channel, faults = next(CHANNELS), Faults()
    caplog.set_level(logging.INFO)
    with Link("faulty", channel, faults=faults) as tracker, Link("virtual", channel) as robot:
        robot.send(STATUS)
        assert [r.message for r in tracker.receive(0.0)] == [STATUS]
        setattr(faults, what, True)
        until(lambda _: tracker.faults[LinkFault.LOST] == 1, tracker)
        if what == "is_gone":
            assert not tracker.send(OFFSET)
            time.sleep(0.02)
            faults.is_gone = False
        until(lambda _: "open again after" in caplog.text, tracker)
        robot.send(STATUS)
        assert STATUS in [r.message for r in until(len, tracker)]
        assert tracker.send(OFFSET)
        assert tracker.faults[LinkFault.BUS_OFF] == (what == "is_off")
    texts = [record.getMessage() for record in caplog.records]
    assert f"CAN faulty:{channel}: lost; it is opened again" in texts
    assert any(text.startswith(f"CAN faulty:{channel}: open again after") for text in texts)
    assert asdict(faults)["is_off"] is False


def test_a_link_that_is_closed_while_its_bus_is_gone_ends(monkeypatch):
    monkeypatch.setattr(reconnecting, "LOST_AFTER_S", 0.005)
    # Links of other tests may still look for their buses.
    others = threading.enumerate()
    faults = Faults()
    link = Link("faulty", next(CHANNELS), faults=faults)
    faults.is_gone = True
    until(lambda _: link.faults[LinkFault.LOST] == 1, link)
    link.close()
    own = set(threading.enumerate()) - set(others)
    assert not any(thread.name.startswith("reopen") for thread in own)


def test_a_bad_datagram_is_counted_and_dropped(multicast):
    with Link(**multicast) as tracker, Link(**multicast) as robot:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
            raw.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for junk in (b"", b"no frame", b"\x81\xa4junk\x01", bytes(2000)):
                raw.sendto(junk, (multicast["channel"], multicast["port"]))
        robot.send(STATUS)
        heard = until(len, tracker)
        assert [r.message for r in heard] == [STATUS]
        assert tracker.faults[LinkFault.UNREADABLE] >= 3
        assert tracker.faults[LinkFault.LOST] == 0


@needs_serial
def test_a_garbage_line_is_counted_and_dropped():
    with SlcanAdapters() as adapters, Link("slcan", adapters.ports[1], **SLCAN) as tracker:
        for junk in (b"t11\r", b"tXYZ8\r", b"t1128zz\r", b"\xff\xfe\r", b"\r\r\a", b"T0\r"):
            adapters.report(1, junk)
        identifier, payload = Protector().protect(STATUS)
        adapters.report(1, b"t%03X8%s\r" % (identifier, payload.hex().upper().encode()))
        heard = until(len, tracker)
        assert [r.message for r in heard] == [STATUS]
        assert tracker.faults[LinkFault.UNREADABLE] >= 4


@needs_serial
def test_a_line_that_waited_is_as_old_as_it_may_be():
    with SlcanAdapters() as adapters, Link("slcan", adapters.ports[1], **SLCAN) as tracker:
        assert list(tracker.receive(0.0)) == []
        protector = Protector()
        for _ in range(3):
            identifier, payload = protector.protect(STATUS)
            adapters.report(1, b"t%03X8%s\r" % (identifier, payload.hex().upper().encode()))
        time.sleep(0.3)
        waited = until(lambda heard: len(heard) == 3, tracker)
        assert all(r.max_age_s >= 0.3 for r in waited)
        assert tracker.inbox.latest(RobotStatus, time.time()) is None
        identifier, payload = protector.protect(STATUS)
        adapters.report(1, b"t%03X8%s\r" % (identifier, payload.hex().upper().encode()))
        (fresh,) = until(len, tracker)
        assert fresh.max_age_s < waited[0].max_age_s


@needs_serial
def test_a_line_that_nobody_reads_blocks_nobody():
    master, slave = os.openpty()
    try:
        link = Link("slcan", os.ttyname(slave), **SLCAN)
        sent = [link.send(replace(OFFSET, offset_y_mm=0.001 * n)) for n in range(3000)]
        assert not all(sent)
        link.send(replace(OFFSET, offset_y_mm=9.0))
        # What waited before the time-out is gone; what is read now is from after it.
        link.close()
        os.set_blocking(master, False)
        read = os.read(master, 100_000)
        assert len(read) < 3000 * 26
        assert f"t112{8:d}".encode() in read
    finally:
        os.close(master)
        os.close(slave)


def test_a_refusal_goes_out_as_unknown():
    channel = next(CHANNELS)
    with Link("virtual", channel) as tracker, Link("virtual", channel) as robot:
        tracker.send(SeamOffset(*[float("nan")] * 4, Validity.REFUSED))
        (received,) = robot.receive(0.0)
    assert encode(received.message) == encode(SeamOffset(*[float("nan")] * 4, Validity.REFUSED))
