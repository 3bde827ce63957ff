"""What a replay believes of the robot and of the time, on a bus of its own and on one beyond it."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from can.interfaces.virtual import VirtualBus

from arctrack.control.controller import Controller
from arctrack.control.job import Job
from arctrack.control.pose_agreement import PoseAgreement
from arctrack.control.robot_messages import TRUSTED
from arctrack.errors import ArctrackError
from arctrack.recording import FrameRow, read_recording
from arctrack.replay import replay_clock as moments
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.replay.replay_clock import PosesVerdict, RealTime, RecordingTime, assumed_command, assumed_robot
from robot_io import (
    BusLogReader,
    BusLogWriter,
    Command,
    DbcVersion,
    GateReason,
    Link,
    LinkFault,
    PoseBuffer,
    PoseKind,
    Received,
    RobotPosePosition,
    RobotPoseRotation,
    RobotStatus,
    SeamGeometry,
    SeamOffset,
    SeamPoint,
    SkipReason,
    Source,
    Switch,
    TrackerCommand,
    TrackerHeartbeat,
    TrackerStatus,
    Trusted,
    Validity,
    Verdict,
)
from robot_io.link import link
from robot_io.link.bus_log import BusLogWriteError
from tracker.state import Track
from tracker.tracker import Tracker
from tracker.warm_up import WarmUp

CHANNELS = (f"test_moments_{n}" for n in itertools.count())
ROWS = [FrameRow(n, 1.0 + 0.125 * n, True, True, 100.0, 0.0625) for n in range(40)]


def no_interrupt() -> None:
    """Nothing interrupts."""


class Clock:
    """Time that passes only while somebody sleeps or waits for a bus; its wall clock is a bus' one."""

    def __init__(self) -> None:
        self.now_s = 5000.0

    def monotonic(self) -> float:
        return self.now_s

    def time(self) -> float:
        return 1.7e9 + self.now_s

    def sleep(self, for_s: float) -> None:
        self.now_s += for_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    receive = VirtualBus.recv

    def wait(bus: VirtualBus, timeout_s: float) -> can.Message | None:
        frame = receive(bus, 0.0)
        if frame is None:
            clock.sleep(timeout_s)
        return frame

    monkeypatch.setattr(moments, "time", clock)
    monkeypatch.setattr(link, "time", clock)
    monkeypatch.setattr(VirtualBus, "recv", wait)
    return clock


def track(row: FrameRow) -> Track:
    return Track(
        row.index,
        row.timestamp_s,
        0,
        offset_y_mm=0.5,
        offset_z_mm=0.25,
        offset_sigma_y_mm=0.01,
        offset_sigma_z_mm=0.01,
        offset_confidence=0.9,
    )


def heard(link: Link) -> list[Received]:
    return list(link.receive(0.0))


STILL = PoseBuffer()
"""The recording's poses: the tool stands still at base's origin."""
STILL.push_all(0.01 * np.arange(1000), np.tile(np.eye(4), (1000, 1, 1)))

JOB = Job("v_groove", poses_proven=True)


def trusted(_now_s: float) -> GateReason:
    return GateReason.NONE


class Robot:
    """A live robot on a bus, which says what a good one says."""

    def __init__(self, channel: str, clock: Clock) -> None:
        self.link = Link("virtual", channel, trusted=Trusted(tracker=(Source.REPLAY,)))
        self._clock = clock
        self.status, self.x_mm = assumed_robot(ROWS[0]), 0.0

    def say(self, command: Command = Command.TRACK, with_poses: bool = True) -> None:
        now_s = self._clock.time()
        self.link.send(self.status, now_s)
        self.link.send(assumed_command(ROWS[0], command), now_s)
        if with_poses:
            self.link.send(RobotPosePosition(self.x_mm, 0.0, 0.0, PoseKind.ACTUAL), now_s)
            self.link.send(RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 0.0), now_s)


def replaying(
    channel: str, rows: list[FrameRow] = ROWS, poses_verdict: PosesVerdict = trusted
) -> tuple[Link, Controller, RealTime]:
    link = Link("virtual", channel, source=Source.REPLAY, trusted=TRUSTED)
    controller = Controller(JOB, Source.REPLAY)
    return (
        link,
        controller,
        RealTime(rows, link, controller, PoseAgreement(STILL), poses_verdict, no_interrupt),
    )


def offsets_of(received: Iterable[Received]) -> list[SeamOffset]:
    return [r.message for r in received if isinstance(r.message, SeamOffset)]


def test_a_frame_goes_out_when_its_time_has_come(clock: Clock) -> None:
    link, _, real_time = replaying(next(CHANNELS))
    with link:
        # Kernels are compiled meanwhile: the frames of that time are not to go out in a burst.
        clock.sleep(20.0)
        began_s = clock.now_s
        for row in ROWS[:3]:
            real_time.publish(row, track(row), None, 1.0)
            assert clock.now_s == pytest.approx(began_s + row.timestamp_s - ROWS[0].timestamp_s)


def test_what_comes_too_late_is_refused(clock: Clock) -> None:
    channel = next(CHANNELS)
    link, controller, real_time = replaying(channel)
    robot = Robot(channel, clock)
    with link, robot.link:
        robot.say(Command.DISARM)
        for row in ROWS:
            # A tenth of a second more than there is from frame to frame.
            clock.sleep(0.225)
            robot.say()
            real_time.publish(row, track(row), None, 225.0)
        offsets = offsets_of(heard(robot.link))
    frames = [offset for offset in offsets if offset.validity is not Validity.REFUSED]
    assert [offset.capture_age_ms for offset in frames[:2]] == pytest.approx([31.25, 131.25], abs=0.5)
    assert [offset.validity for offset in frames[:3]] == [Validity.VALID, Validity.VALID, Validity.HELD]
    assert controller.reasons == Counter({GateReason.CAPTURE_TOO_OLD: len(ROWS) - 2})
    assert offsets[-1].validity is Validity.REFUSED


def test_without_a_robot_nothing_is_valid(clock: Clock) -> None:
    link, controller, real_time = replaying(next(CHANNELS))
    with link:
        offsets = [real_time.publish(row, track(row), None, 1.0) for row in ROWS[:5]]
        (warning,) = real_time.warnings
    assert {offset.validity for offset in offsets} == {Validity.REFUSED}
    assert controller.reasons == Counter({GateReason.NOT_ARMED: 5})
    assert warning == f"virtual:{link.channel}: no RobotStatus was heard, so every offset was refused"


def test_the_robot_is_the_one_that_is_heard(clock: Clock) -> None:
    channel = next(CHANNELS)
    link, controller, real_time = replaying(channel)
    robot = Robot(channel, clock)
    with link, robot.link:
        robot.say(Command.DISARM)
        robot.say()
        assert real_time.publish(ROWS[0], track(ROWS[0]), None, 1.0).validity is Validity.VALID
        clock.sleep(0.1)
        robot.status = replace(robot.status, emergency_stop=Switch.ON)
        robot.say()
        assert real_time.publish(ROWS[1], track(ROWS[1]), None, 1.0).validity is Validity.REFUSED
        # It falls silent: that is no robot, and none is made up.
        assert real_time.publish(ROWS[9], track(ROWS[9]), None, 1.0).validity is Validity.REFUSED
        assert real_time.warnings == ()
    assert controller.reasons == Counter({GateReason.EMERGENCY_STOP: 1, GateReason.HEARTBEAT_LOST: 1})


def test_faults_of_the_bus_are_said(clock: Clock) -> None:
    link, _, real_time = replaying(next(CHANNELS))
    with link:
        link.faults[LinkFault.UNSENT] += 3
        link.faults[LinkFault.BUS_OFF] += 1
        _, warning = real_time.warnings
    assert warning == f"virtual:{link.channel}: faults of the bus: 1 bus off, 3 unsent"


def test_a_replay_whose_log_fails_goes_on_and_says_so(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, written = BusLogWriter.write, itertools.count()

    def fills_up(log: BusLogWriter, frame: can.Message) -> None:
        if next(written) > 30:
            raise BusLogWriteError("log bus.blf: cannot be written: No space left on device")
        write(log, frame)

    monkeypatch.setattr(BusLogWriter, "write", fills_up)
    channel = next(CHANNELS)
    with Link("virtual", channel, trusted=Trusted(tracker=(Source.REPLAY,))) as robot:
        done = replay_recording(
            read_recording(simulated), tmp_path, ReplayOptions(bus=f"virtual:{channel}", pictures=False)
        )
        received = heard(robot)
    offsets = offsets_of(received)
    assert [offset.validity for offset in offsets].count(Validity.VALID) == done.summary.offsets["send"] > 0
    logged = len(list(BusLogReader(tmp_path / "bus.blf")))
    assert done.warnings == (f"virtual:{channel}: faults of the bus: {len(received) - logged} unlogged",)
    assert offsets[-1].validity is Validity.REFUSED


@pytest.mark.parametrize(
    ("x_mm", "with_poses", "reason"),
    [
        (5.0, True, GateReason.NONE),
        (5.1, True, GateReason.ROBOT_ELSEWHERE),
        (-300.0, True, GateReason.ROBOT_ELSEWHERE),
        (0.0, False, GateReason.POSE_IMPLAUSIBLE),
    ],
)
def test_the_robot_must_stand_where_the_recordings_robot_stood(
    clock: Clock, x_mm: float, with_poses: bool, reason: GateReason
) -> None:
    channel = next(CHANNELS)
    link, controller, real_time = replaying(channel)
    robot = Robot(channel, clock)
    robot.x_mm = x_mm
    with link, robot.link:
        for command in (Command.DISARM, Command.TRACK):
            robot.say(command, with_poses)
        real_time.publish(ROWS[0], track(ROWS[0]), None, 1.0)
    assert controller.reasons == Counter({reason: 1} if reason is not GateReason.NONE else {})


def test_a_robot_is_sent_nothing_that_rests_on_poses_in_doubt(clock: Clock) -> None:
    channel = next(CHANNELS)
    link, controller, real_time = replaying(channel, poses_verdict=lambda _: GateReason.POSE_IMPLAUSIBLE)
    robot = Robot(channel, clock)
    with link, robot.link:
        for command in (Command.DISARM, Command.TRACK):
            robot.say(command)
        real_time.publish(ROWS[0], track(ROWS[0]), None, 1.0)
    assert controller.reasons == Counter({GateReason.POSE_IMPLAUSIBLE: 1})


def test_a_robot_that_is_turned_stands_elsewhere() -> None:
    half = math.radians(3.05) / 2.0
    agreement = PoseAgreement(STILL)
    messages = (
        RobotPosePosition(0.0, 0.0, 0.0, PoseKind.ACTUAL),
        RobotPoseRotation.from_quaternion((0.0, 0.0, math.sin(half), math.cos(half)), 2.0),
    )
    verdicts = [agreement.verdict(Received(7.0, message, 3), 1.0) for message in messages]
    assert verdicts == [None, GateReason.ROBOT_ELSEWHERE]
    # Where the recording has no pose, no robot can agree with it.
    assert [agreement.verdict(Received(7.0, message, 3), 90.0) for message in messages][1] is (
        GateReason.ROBOT_ELSEWHERE
    )
    programmed = replace(messages[0], kind=PoseKind.PROGRAMMED)
    assert agreement.verdict(Received(7.0, programmed, 4), 1.0) is None
    assert agreement.verdict(Received(7.0, messages[1], 4), 1.0) is None


@pytest.mark.slow
def test_a_robot_that_talks_between_two_frames_is_heard_to_the_end(
    tmp_path: Path, multicast: dict[str, Any]
) -> None:
    """A socket stores a few hundred messages: fewer than come before the second frame is due."""
    log = tmp_path / "bus.blf"
    rows = [FrameRow(n, 2.0 * n, True, True, 100.0, 0.0625) for n in range(2)]
    with Link(**multicast, log_paths=[log]) as tracker, Link(**multicast) as robot:
        sent, enough = itertools.count(), threading.Event()

        def talk() -> None:
            while not enough.is_set():
                robot.send(assumed_robot(rows[next(sent) % 2]))
                time.sleep(0.001)

        real_time = RealTime(rows, tracker, Controller(JOB), PoseAgreement(STILL), trusted, no_interrupt)
        real_time.publish(rows[0], track(rows[0]), None, 1.0)
        talking = threading.Thread(target=talk)
        talking.start()
        real_time.publish(rows[1], track(rows[1]), None, 1.0)
        enough.set()
        talking.join()
        # What came after the frame was due.
        heard(tracker)
        assert not tracker.inbox.skipped
    assert sum(isinstance(r.message, RobotStatus) for r in BusLogReader(log)) == next(sent)


@pytest.mark.slow
def test_the_bus_is_joined_when_all_is_compiled(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    happened: list[str] = []
    warm_up, step_of = Tracker.warm_up, Tracker.step

    def warmed_up(tracker: Tracker, *options: Any) -> WarmUp:
        done = warm_up(tracker, *options)
        happened.append("ready")
        return done

    def step(tracker: Tracker, *options: Any) -> Track:
        happened.append("step")
        return step_of(tracker, *options)

    def join(*options: Any, **more: Any) -> Link:
        happened.append("joined")
        return Link(*options, **more)

    monkeypatch.setattr(Tracker, "warm_up", warmed_up)
    monkeypatch.setattr(Tracker, "step", step)
    monkeypatch.setattr("arctrack.replay.replay.Link", join)
    replay_recording(read_recording(simulated), tmp_path, ReplayOptions(pictures=False))
    assert happened[:3] == ["ready", "joined", "step"]


def test_a_bus_beyond_this_process_must_be_meant(simulated: Path, tmp_path: Path) -> None:
    options = ReplayOptions(bus="udp_multicast:239.74.163.2", pictures=False)
    with pytest.raises(ArctrackError, match="say --onto-a-robot if that is meant"):
        replay_recording(read_recording(simulated), tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_a_replay_onto_a_bus_beyond_it_listens(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    channel = next(CHANNELS)
    recording = read_recording(simulated)
    stopped = replace(assumed_robot(recording.rows[5]), emergency_stop=Switch.ON)
    robot = Link("virtual", channel, trusted=Trusted(tracker=(Source.REPLAY,)))

    def beyond(_interface: str, channel: str, **options: Any) -> Link:
        link = Link("virtual", channel, **options)
        robot.send(assumed_command(recording.rows[0], Command.DISARM), clock.time() + 0.45)
        robot.send(assumed_command(recording.rows[0]), clock.time() + 0.45)
        robot.send(stopped, clock.time() + 0.45)
        return link

    monkeypatch.setattr("arctrack.replay.replay.Link", beyond)
    options = ReplayOptions(bus=f"socketcan:{channel}", pictures=False, onto_a_robot=True)
    with robot:
        done = replay_recording(recording, tmp_path / "out", options)
        received = heard(robot)
    assert done.summary.offsets == {"send": 0, "hold": 0, "refuse": 14}
    assert done.summary.refusals["emergency_stop"] >= 1
    assert done.summary.refusals["heartbeat_lost"] >= 10
    assert done.warnings == ()
    assert {offset.validity for offset in offsets_of(received)} == {Validity.REFUSED}
    logged = list(BusLogReader(tmp_path / "out" / "bus.blf"))
    assert isinstance(logged[0].message, TrackerCommand)


def recording_time() -> tuple[Link, Controller, RecordingTime]:
    link = Link("virtual", next(CHANNELS), source=Source.REPLAY)
    controller = Controller(Job("v_groove"), Source.REPLAY)
    return link, controller, RecordingTime(ROWS, link, controller, trusted)


def test_nobody_listens_to_virtual() -> None:
    link, controller, by_recording = recording_time()
    with (
        link,
        Link("virtual", link.channel, trusted=Trusted(tracker=(Source.REPLAY,))) as robot,
        Link("virtual", link.channel) as live,
    ):
        offset = by_recording.publish(ROWS[0], track(ROWS[0]), None, 7.0)
        assert (offset.validity, offset.offset_y_mm) == (Validity.VALID, 0.0)
        offset = by_recording.publish(ROWS[3], track(ROWS[3]), None, 7.0)
        by_recording.close()
        received = heard(robot)
        # Who trusts live frames alone hears nothing.
        assert heard(live) == []
        assert set(live.inbox.skipped) == {SkipReason.OTHER_SOURCE}
    assert (offset.validity, offset.offset_y_mm) == (Validity.VALID, 0.5)
    assert controller.verdicts == Counter({Verdict.SEND: 2})
    at_s = [ROWS[n].timestamp_s + ROWS[n].exposure_s / 2.0 for n in (0, 3, 3)]
    assert [r.timestamp_s for r in received if isinstance(r.message, SeamOffset)] == at_s
    assert offsets_of(received)[-1].validity is Validity.REFUSED
    assert by_recording.warnings == ()


def test_the_version_is_sent_again_and_again() -> None:
    link, _, by_recording = recording_time()
    with link, Link("virtual", link.channel, trusted=Trusted(tracker=(Source.REPLAY,))) as robot:
        for row in ROWS:
            by_recording.publish(row, track(row), None, 1.0)
        received = heard(robot)
    counts = Counter(type(r.message) for r in received)
    # 40 frames at 8 a second.
    frame = dict.fromkeys((SeamOffset, SeamPoint, SeamGeometry, TrackerStatus, TrackerHeartbeat), 40)
    assert counts == {**frame, DbcVersion: 5}
    at_s = [r.timestamp_s for r in received if isinstance(r.message, DbcVersion)]
    assert at_s == [ROWS[n].timestamp_s + ROWS[n].exposure_s / 2.0 for n in (0, 8, 16, 24, 32)]
    assert {r.message.source for r in received if isinstance(r.message, DbcVersion)} == {Source.REPLAY}
