from __future__ import annotations

import importlib.util
import itertools
import math
import sys
import threading
import time

import can
import pytest
from bus_messages import EXAMPLES
from can.interfaces.virtual import VirtualBus
from slcan_adapters import SlcanAdapters

from robot_io.link.bus_log import BusLogError
from robot_io.link.bus_log_reader import BusLogReader
from robot_io.link.inbox import SkipReason
from robot_io.link.link import Link, LinkError
from robot_io.poses.pose_assembler import PoseAssembler
from robot_io.protocol.codec import CodecError, decode, encode
from robot_io.protocol.messages import SeamOffset, Validity

OFFSET = EXAMPLES[2]
CHANNELS = (f"test_link_{n}" for n in itertools.count())


def as_bytes(messages):
    # NaN is not equal to itself; its code on the bus is.
    return [encode(decode(*encode(message))) for message in messages]


def exchange(sender, receiver):
    for message in EXAMPLES:
        sender.send(message)
    return [r.message for r in itertools.islice(receiver.receive(60.0), len(EXAMPLES))]


def test_virtual_both_ways():
    channel = next(CHANNELS)
    with Link("virtual", channel) as robot, Link("virtual", channel) as tracker:
        assert as_bytes(exchange(robot, tracker)) == as_bytes(EXAMPLES)
        assert as_bytes(exchange(tracker, robot)) == as_bytes(EXAMPLES)
        assert list(robot.receive(0.0)) == []
        assert tracker.inbox.latest(SeamOffset, time.time()) == OFFSET


def test_recording_time_reaches_the_receiver_and_the_logs(tmp_path):
    channel = next(CHANNELS)
    logs = [tmp_path / "bus.blf", tmp_path / "bus.asc", tmp_path / "bus.log"]
    with Link("virtual", channel) as listener:
        with Link("virtual", channel, log_paths=logs) as link:
            for i, message in enumerate(EXAMPLES):
                link.send(message, timestamp_s=0.25 * i)
        received = list(listener.receive(0.0))
    assert [r.timestamp_s for r in received] == [0.25 * i for i in range(len(EXAMPLES))]
    for path in logs:
        logged = list(BusLogReader(path))
        assert [r.timestamp_s for r in logged] == [r.timestamp_s for r in received]
        assert as_bytes(r.message for r in logged) == as_bytes(EXAMPLES)


def test_everything_on_the_bus_is_logged_foreign_frames_too(tmp_path):
    channel = next(CHANNELS)
    path = tmp_path / "bus.blf"
    with (
        can.Bus(interface="virtual", channel=channel, ignore_config=True) as other,
        Link("virtual", channel) as robot,
        Link("virtual", channel, log_paths=[path]) as tracker,
    ):
        other.send(can.Message(arbitration_id=0x700, data=b"\x01", is_extended_id=False))
        robot.send(EXAMPLES[0])
        assert [r.message for r in tracker.receive(0.0)] == [EXAMPLES[0]]
        tracker.send(OFFSET)
        assert tracker.inbox.skipped == {SkipReason.FOREIGN: 1}
    with can.BLFReader(path) as log:
        assert [frame.arbitration_id for frame in log] == [0x700, 0x110, 0x112]


def test_poses_go_over_the_bus_whole():
    channel = next(CHANNELS)
    assembler = PoseAssembler()
    with Link("virtual", channel) as robot, Link("virtual", channel) as tracker:
        for i in range(20):
            robot.send(EXAMPLES[0], timestamp_s=0.01 * i)
            robot.send(EXAMPLES[1], timestamp_s=0.01 * i)
        poses = [pose for r in tracker.receive(0.0) if (pose := assembler.push(r))]
    assert [pose.timestamp_s for pose in poses] == pytest.approx([0.01 * i - 0.002 for i in range(20)])
    assert poses[0].position_base_mm == pytest.approx((412.5, -88.025, 3.0))
    assert poses[0].quaternion_xyzw == pytest.approx((-0.6, 0.0, 0.8, 0.0), abs=1e-4)


def test_what_cannot_be_sent_does_not_go_out(tmp_path):
    channel = next(CHANNELS)
    with (
        Link("virtual", channel, log_paths=[tmp_path / "bus.blf"]) as tracker,
        Link("virtual", channel) as robot,
    ):
        with pytest.raises(CodecError, match=r"SeamOffset\.offset_y_mm"):
            tracker.send(SeamOffset(40.0, 0.0, 0.0, 1.0, Validity.VALID))
        with pytest.raises(BusLogError, match="before the log's start"):
            tracker.send(OFFSET, timestamp_s=-1.0)
        assert list(robot.receive(0.0)) == []
        tracker.send(OFFSET)
        assert len(list(robot.receive(0.0))) == 1


@pytest.mark.parametrize(
    ("interface", "channel", "cure"),
    [
        ("carrier_pigeon", "coop", "check the interface's name"),
        ("socketcan", "nosuchcan0", "ip link set nosuchcan0 up"),
        ("slcan", "/dev/nosuchtty", "serial port"),
        ("kvaser", "0", "install Kvaser's CANlib"),
        ("udp_multicast", "10.0.0.1", "multicast address"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_one_clear_line(tmp_path, interface, channel, cure):
    with pytest.raises(LinkError) as caught:
        Link(interface, channel, log_paths=[tmp_path / "bus.asc"])
    text = str(caught.value)
    assert text.startswith(f"CAN {interface}:{channel}: cannot open (")
    assert cure in text
    assert "\n" not in text


def test_a_bus_that_fails_in_use_is_one_clear_line():
    channel = next(CHANNELS)
    link = Link("virtual", channel)
    link.close()
    with pytest.raises(LinkError, match=f"CAN virtual:{channel}: cannot send"):
        link.send(OFFSET)
    with pytest.raises(LinkError, match=f"CAN virtual:{channel}: cannot receive"):
        next(link.receive(0.0))


class CountingBus(VirtualBus):
    """An adapter whose clock counts from its start, or that has none."""

    def __init__(self, channel, start_s, has_clock, **options):
        super().__init__(channel, preserve_timestamps=True, **options)
        self.start_s, self.has_clock = start_s, has_clock

    def _recv_internal(self, timeout):
        frame, filtered = super()._recv_internal(timeout)
        if frame is not None:
            frame.timestamp = frame.timestamp - self.start_s if self.has_clock else 0.0
        return frame, filtered


@pytest.mark.parametrize("has_clock", [True, False])
def test_an_adapter_that_counts_from_its_start_is_on_the_wall_clock(tmp_path, monkeypatch, has_clock):
    monkeypatch.setitem(can.interfaces.BACKENDS, "counting", (__name__, "CountingBus"))
    channel, path = next(CHANNELS), tmp_path / "bus.blf"
    began_s = time.time()
    options = {"start_s": began_s - 100.0, "has_clock": has_clock}
    with (
        Link("virtual", channel) as robot,
        Link("counting", channel, log_paths=[path], **options) as tracker,
    ):
        for _ in range(5):
            robot.send(OFFSET)
        tracker.send(EXAMPLES[0])
        received = list(tracker.receive(0.0))
        ended_s = time.time()
    assert len(received) == 5
    assert all(began_s - 1e-3 <= r.timestamp_s <= ended_s for r in received)
    assert tracker.inbox.latest(SeamOffset, received[-1].timestamp_s) == OFFSET
    with can.BLFReader(path) as log:
        assert all(began_s - 1e-3 <= frame.timestamp <= ended_s + 1e-3 for frame in log)


def wait_for_ever(link, heard, ended):
    heard.extend(link.receive(None))
    ended.set()


@pytest.mark.parametrize("bus", ["virtual", "multicast"])
def test_closing_ends_who_waits_in_another_thread(tmp_path, request, bus):
    options = {"channel": next(CHANNELS)} if bus == "virtual" else request.getfixturevalue("multicast")
    heard, ended = [], threading.Event()
    with Link(**options) as robot:
        link = Link(**options, log_paths=[tmp_path / "bus.blf"])
        waiting = threading.Thread(target=wait_for_ever, args=(link, heard, ended), daemon=True)
        waiting.start()
        robot.send(OFFSET)
        while not heard:
            time.sleep(0.001)
        link.close()
        assert ended.wait(60.0)
        waiting.join()
    assert [r.message for r in heard] == [OFFSET]
    assert len(list(BusLogReader(tmp_path / "bus.blf"))) == 1


def test_udp_multicast_between_two_links(tmp_path, multicast):
    path = tmp_path / "bus.blf"
    with Link(**multicast) as robot, Link(**multicast, log_paths=[path]) as tracker:
        assert as_bytes(exchange(robot, tracker)) == as_bytes(EXAMPLES)
        assert as_bytes(exchange(tracker, robot)) == as_bytes(EXAMPLES)
        # Multicast hands a sender its own frames back: they are no messages.
        assert list(tracker.receive(0.05)) == []
        assert not tracker.inbox.skipped
        assert not robot.inbox.skipped
    with can.BLFReader(path) as log:
        assert len(list(log)) == 2 * len(EXAMPLES)


@pytest.mark.skipif(importlib.util.find_spec("serial") is None, reason="pyserial is not installed")
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
def test_slcan_between_two_links():
    options = {"bitrate_bit_s": 500_000, "sleep_after_open": 0.0}
    with (
        SlcanAdapters() as adapters,
        Link("slcan", adapters.ports[0], **options) as robot,
        Link("slcan", adapters.ports[1], **options) as tracker,
    ):
        assert as_bytes(exchange(robot, tracker)) == as_bytes(EXAMPLES)
        assert as_bytes(exchange(tracker, robot)) == as_bytes(EXAMPLES)
        assert b"S6\r" in adapters.heard[0]


def test_unknown_offsets_stay_unknown():
    channel = next(CHANNELS)
    with Link("virtual", channel) as tracker, Link("virtual", channel) as robot:
        tracker.send(SeamOffset(math.nan, math.nan, math.nan, math.nan, Validity.REFUSED))
        (received,) = robot.receive(0.0)
    assert math.isnan(received.message.offset_y_mm)
    assert received.message.validity is Validity.REFUSED
