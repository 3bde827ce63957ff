"""What once failed open, from end to end over a bus: a controller, its link, a robot that uses what counts.

What is not here: a line that nobody reads, bad datagrams, garbage lines and full queues are in
`tests/robot_io/test_link_faults.py`; a replay where the robot stands elsewhere is in
`tests/arctrack/test_moments.py`; how a process ends in `tests/arctrack/test_replay_ends.py`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import can
import pytest

from arctrack.control.controller import Controller
from arctrack.control.job import Job
from arctrack.simulation.cell.robot import WELDING
from robot_io import (
    SOURCES,
    BusMessage,
    Command,
    GateReason,
    Link,
    MotionState,
    OffsetUse,
    Protector,
    RobotStatus,
    SeamOffset,
    Switch,
    TrackerCommand,
    TrackerState,
    TrackerStatus,
    Trusted,
    Validity,
    WeldingState,
)
from tracker.state import Track

CHANNELS = (f"test_fails_closed_{n}" for n in itertools.count())
FRAME_S = 0.02
WELDS = replace(WELDING, weave=Switch.OFF, travel_speed_mm_s=5.0, path_section=None)
TRACKS = TrackerCommand(Command.TRACK, True, True, 0, None, None, Switch.ON)


class Tracker:
    """A tracker on a bus, its camera at 50 frames a second."""

    def __init__(self, channel: str, job: Job | None = None) -> None:
        self.link = Link("virtual", channel, trusted=Trusted(tracker=SOURCES))
        self.controller = Controller(job or Job("lap"))
        self.offset_y_mm = 0.0

    def step(self, now_s: float, has_frame: bool = True) -> None:
        said: list[BusMessage] = []
        for received in self.link.receive(0.0):
            said += self.controller.on_message(received, now_s)
        if has_frame:
            track = Track(
                0,
                now_s - 0.01,
                0,
                offset_y_mm=self.offset_y_mm,
                offset_z_mm=0.0,
                offset_sigma_y_mm=0.02,
                offset_sigma_z_mm=0.02,
                offset_confidence=0.9,
            )
            said += self.controller.on_track(track, now_s)
        said += self.controller.poll(now_s)
        for message in said:
            if not self.link.send(message, now_s):
                self.controller.unsent(message)


class Robot:
    """A robot on a bus: what it says, what it hears, and what of that counts."""

    def __init__(self, channel: str) -> None:
        self.link = Link("virtual", channel)
        self.use = OffsetUse()
        self.status: RobotStatus | None = WELDS
        self.command: TrackerCommand | None = replace(TRACKS, command=Command.DISARM)
        self.heard: list[BusMessage] = []

    def speak(self, now_s: float) -> None:
        for message in (self.status, self.command):
            if message is not None:
                self.link.send(message, now_s)

    def listen(self, now_s: float) -> SeamOffset | None:
        for received in self.link.receive(0.0):
            self.heard.append(received.message)
            self.use.on_message(received, now_s)
        return self.use.offset(now_s)

    def last(self, kind: type) -> BusMessage:
        return [m for m in self.heard if isinstance(m, kind)][-1]


class Bus:
    """A robot and a tracker on a bus, and the time."""

    def __init__(self) -> None:
        self.channel = next(CHANNELS)
        self.robot, self.trackers = Robot(self.channel), [Tracker(self.channel)]
        self.now_s = 100.0
        self.has_frames = True
        self.offsets: list[SeamOffset | None] = []

    def run(self, n_frames: int) -> SeamOffset | None:
        for _ in range(n_frames):
            self.now_s += FRAME_S
            self.robot.speak(self.now_s)
            for tracker in self.trackers:
                tracker.step(self.now_s, self.has_frames)
            self.offsets.append(self.robot.listen(self.now_s))
        return self.offsets[-1]

    @property
    def reason(self) -> GateReason:
        return self.robot.last(TrackerStatus).gate_reason

    def close(self) -> None:
        for speaker in (self.robot, *self.trackers):
            speaker.link.close()


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = Bus()
    yield bus
    bus.close()


@pytest.fixture
def tracking(bus: Bus) -> Bus:
    bus.run(2)
    bus.robot.command = TRACKS
    assert bus.run(15).validity is Validity.VALID
    return bus


def test_without_a_status_nothing_counts(bus: Bus) -> None:
    bus.robot.status = None
    bus.run(2)
    bus.robot.command = TRACKS
    bus.run(160)
    assert bus.offsets == [None] * 162
    assert bus.reason is GateReason.ROBOT_STATUS_STALE
    offsets = [m for m in bus.robot.heard if isinstance(m, SeamOffset)]
    assert {offset.validity for offset in offsets} == {Validity.REFUSED}


def test_a_status_of_a_bad_crc_is_none(bus: Bus) -> None:
    bus.robot.status = None
    with can.Bus(interface="virtual", channel=bus.channel, ignore_config=True) as other:
        protector = Protector()
        for command in (Command.DISARM, Command.TRACK):
            bus.robot.command = replace(TRACKS, command=command)
            for _ in range(20):
                identifier, payload = protector.protect(replace(WELDS, emergency_stop=Switch.ON))
                damaged = bytes([payload[0] ^ 0x55, *payload[1:]])
                other.send(can.Message(arbitration_id=identifier, data=damaged, is_extended_id=False))
                assert bus.run(1) is None
    assert bus.reason is GateReason.ROBOT_STATUS_STALE


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"motion": MotionState.STOPPED}, GateReason.ROBOT_NOT_MOVING),
        ({"motion": MotionState.PAUSED}, GateReason.ROBOT_NOT_MOVING),
        ({"motion": MotionState.RETRACTING}, GateReason.ROBOT_NOT_MOVING),
        ({"welding": WeldingState.FAULT}, GateReason.WELDING_FAULT),
        ({"emergency_stop": Switch.ON}, GateReason.EMERGENCY_STOP),
    ],
)
def test_a_robot_that_does_not_weld_on_is_refused_by_name(tracking: Bus, changes, reason) -> None:
    tracking.robot.status = replace(WELDS, **changes)
    assert tracking.run(1) is None
    assert tracking.reason is reason
    tracking.robot.status = WELDS
    assert tracking.run(10).validity is Validity.VALID


def test_a_tracker_that_is_disarmed_is_silent(tracking: Bus) -> None:
    tracking.robot.command = replace(TRACKS, command=Command.DISARM)
    assert tracking.run(1) is None
    assert tracking.reason is GateReason.NOT_ARMED
    assert tracking.robot.last(TrackerStatus).state is TrackerState.DISARMED


def test_poses_that_are_not_to_be_trusted_are_refused_by_name(bus: Bus) -> None:
    tracker = bus.trackers[0]
    tracker.controller = Controller(Job("lap", poses_proven=True))
    bus.run(2)
    bus.robot.command = TRACKS
    for verdict in (None, GateReason.POSE_IMPLAUSIBLE, GateReason.ROBOT_ELSEWHERE):
        if verdict is not None:
            tracker.controller.on_poses(verdict, bus.now_s)
        assert bus.run(3) is None
        assert bus.reason is (verdict or GateReason.POSE_IMPLAUSIBLE)
    for _ in range(10):
        tracker.controller.on_poses(GateReason.NONE, bus.now_s)
        bus.run(1)
    assert bus.offsets[-1].validity is Validity.VALID


def test_two_trackers_silence_each_other(tracking: Bus) -> None:
    second = Tracker(tracking.channel)
    second.offset_y_mm = 3.0
    tracking.trackers.append(second)
    tracking.run(50)
    assert tracking.offsets[-45:] == [None] * 45
    counted = [offset.offset_y_mm for offset in tracking.offsets if offset is not None]
    assert set(counted) == {0.0}
    assert tracking.reason is GateReason.OTHER_TRACKER
    # One of them leaves, and the robot says that the fault is over.
    tracking.trackers.pop().link.close()
    tracking.robot.command = replace(TRACKS, command=Command.RESET, request_number=1)
    tracking.run(5)
    tracking.robot.command = replace(TRACKS, request_number=1)
    assert tracking.run(20).validity is Validity.VALID


@pytest.mark.parametrize(
    ("after_mm", "reason"),
    [(2.9, GateReason.NONE), (9.0, GateReason.JUMP), (20.0, GateReason.OUT_OF_RANGE)],
)
def test_no_silence_makes_a_step(tracking: Bus, after_mm: float, reason: GateReason) -> None:
    tracking.has_frames = False
    tracking.run(50)
    assert tracking.reason is GateReason.CAMERA_STOPPED
    assert tracking.offsets[-1] is None
    tracking.has_frames = True
    tracking.trackers[0].offset_y_mm = after_mm
    tracking.run(100)
    steps_mm = [0.0, *(offset.offset_y_mm for offset in tracking.offsets if offset is not None)]
    changes_mm = [abs(b - a) for a, b in itertools.pairwise(steps_mm)]
    assert max(changes_mm) <= 3.0
    assert tracking.reason is reason


def test_the_first_offset_is_no_step(bus: Bus) -> None:
    bus.run(2)
    bus.trackers[0].offset_y_mm = 9.5
    bus.robot.command = TRACKS
    bus.run(60)
    first = [m.offset_y_mm for m in bus.robot.heard if isinstance(m, SeamOffset)]
    first = [offset_mm for offset_mm in first if not math.isnan(offset_mm)]
    assert first[0] == 0.0
    assert max(b - a for a, b in itertools.pairwise(first)) <= 0.4 + 1e-6
    assert first[-1] == 9.5


def test_a_tracker_that_was_killed_ends_its_offsets_within_150_ms(tracking: Bus) -> None:
    killed = tracking.trackers.pop()
    tracking.run(8)
    assert tracking.offsets[-1] is None
    killed.link.close()
    # The next one finds a robot that is armed: it says nothing before that was disarmed.
    tracking.trackers.append(Tracker(tracking.channel))
    tracking.run(50)
    assert tracking.offsets[-1] is None
    assert tracking.reason is GateReason.NOT_ARMED
    tracking.robot.command = replace(TRACKS, command=Command.DISARM)
    tracking.run(1)
    tracking.robot.command = TRACKS
    assert tracking.run(5).validity is Validity.VALID


def test_the_same_offset_twice_is_the_same_place(tracking: Bus) -> None:
    tracking.trackers[0].offset_y_mm = 0.25
    tracking.run(20)
    assert {offset.offset_y_mm for offset in tracking.offsets[-10:]} == {0.25}
