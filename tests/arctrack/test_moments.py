"""What a replay believes of the robot and of the time, on a bus of its own and on one beyond it."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from can.interfaces.virtual import VirtualBus

from arctrack.control.controller import Controller
from arctrack.control.frame_tracking import Capture, TrackedFrame
from arctrack.control.job import Job
from arctrack.control.recorded_poses import PoseAgreement, RecordedPoses
from arctrack.control.robot_messages import TRUSTED
from arctrack.control.tracking_service import SeamTracker, TrackingService
from arctrack.errors import ArctrackError
from arctrack.recording import FrameRow, Recording, read_recording
from arctrack.replay import replay_clock as moments
from arctrack.replay.replay import ReplayOptions, bus_faults, replay_recording
from arctrack.replay.replay_clock import RealTime, RecordingTime, assumed_command, assumed_robot
from robot_io import (
    BusLogReader,
    BusLogWriter,
    Command,
    DbcVersion,
    GateReason,
    Link,
    LinkFault,
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


TIMES_S, STILL_MM = 0.01 * np.arange(1000), np.tile(np.eye(4), (1000, 1, 1))
"""The recording's poses: the tool stands still at base's origin."""

JOB = Job("v_groove", poses_proven=True)


class MadeTracking:
    """A tracker that finds the same seam in every row."""

    def begin(self) -> None:
        """Do nothing."""

    def finish(self) -> None:
        """Do nothing."""

    def track(self, shown: None, capture: Capture) -> TrackedFrame:
        return TrackedFrame(track(ROWS[capture.index]), took_ms=1.0)


@pytest.fixture(scope="module")
def still(simulated: Path) -> Recording:
    """Return a recording whose tool stands still."""
    recording = read_recording(simulated)
    poses = replace(recording.poses, timestamps_s=TIMES_S, T_base_tool=STILL_MM)
    return replace(recording, rows=tuple(ROWS), poses=poses)


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


class Replaying:
    """A recording's rows in real time, onto a virtual bus."""

    def __init__(self, still: Recording, channel: str, rows: Sequence[FrameRow] = ROWS) -> None:
        self.link = Link("virtual", channel, source=Source.REPLAY, trusted=TRUSTED)
        self.controller = Controller(JOB, Source.REPLAY)
        self.clock = RealTime(rows, self.link, lambda: None)
        seam = SeamTracker(RecordedPoses(still, has_robot=True), MadeTracking())
        self.service = TrackingService[None](self.controller, seam, self.link.send, self.clock.now_s)
        self._has_begun = False

    def publish(self, row: FrameRow) -> SeamOffset:
        if not self._has_begun:
            self._has_begun = True
            self.clock.begin(self.service)
        self.clock.reach(row, self.service)
        return self.service.track(None, row.index, row.timestamp_s).offset


def offsets_of(received: Iterable[Received]) -> list[SeamOffset]:
    return [r.message for r in received if isinstance(r.message, SeamOffset)]


def test_a_frame_goes_out_when_its_time_has_come(still: Recording, clock: Clock) -> None:
    replaying = Replaying(still, next(CHANNELS))
    with replaying.link:
        # Kernels are compiled meanwhile: the frames of that time are not to go out in a burst.
        clock.sleep(20.0)
        began_s = clock.now_s
        for row in ROWS[:3]:
            replaying.publish(row)
            assert clock.now_s == pytest.approx(began_s + row.timestamp_s - ROWS[0].timestamp_s)


def test_what_comes_too_late_is_refused(still: Recording, clock: Clock) -> None:
    channel = next(CHANNELS)
    replaying, robot = Replaying(still, channel), Robot(channel, clock)
    with replaying.link, robot.link:
        robot.say(Command.DISARM)
        for row in ROWS:
            # A tenth of a second more than there is from frame to frame.
            clock.sleep(0.225)
            robot.say()
            replaying.publish(row)
        offsets = offsets_of(heard(robot.link))
    frames = [offset for offset in offsets if offset.validity is not Validity.REFUSED]
    assert [offset.capture_age_ms for offset in frames[:2]] == pytest.approx([31.25, 131.25], abs=0.5)
    assert [offset.validity for offset in frames[:3]] == [Validity.VALID, Validity.VALID, Validity.HELD]
    assert replaying.controller.reasons == Counter({GateReason.CAPTURE_TOO_OLD: len(ROWS) - 2})
    assert offsets[-1].validity is Validity.REFUSED


def test_without_a_robot_nothing_is_valid(still: Recording, clock: Clock) -> None:
    replaying = Replaying(still, next(CHANNELS))
    with replaying.link:
        offsets = [replaying.publish(row) for row in ROWS[:5]]
        (warning,) = replaying.clock.warnings(replaying.service)
    assert {offset.validity for offset in offsets} == {Validity.REFUSED}
    assert replaying.controller.reasons == Counter({GateReason.NOT_ARMED: 5})
    assert (
        warning == f"virtual:{replaying.link.channel}: no RobotStatus was heard, so every offset was refused"
    )


def test_the_robot_is_the_one_that_is_heard(still: Recording, clock: Clock) -> None:
    channel = next(CHANNELS)
    replaying, robot = Replaying(still, channel), Robot(channel, clock)
    with replaying.link, robot.link:
        robot.say(Command.DISARM)
        robot.say()
        assert replaying.publish(ROWS[0]).validity is Validity.VALID
        clock.sleep(0.1)
        robot.status = replace(robot.status, emergency_stop=Switch.ON)
        robot.say()
        assert replaying.publish(ROWS[1]).validity is Validity.REFUSED
        # It falls silent: that is no robot, and none is made up.
        assert replaying.publish(ROWS[9]).validity is Validity.REFUSED
        assert replaying.clock.warnings(replaying.service) == ()
    assert replaying.controller.reasons == Counter(
        {GateReason.EMERGENCY_STOP: 1, GateReason.HEARTBEAT_LOST: 1}
    )


def test_faults_of_the_bus_are_said() -> None:
    with Link("virtual", next(CHANNELS)) as link:
        link.faults[LinkFault.UNSENT] += 3
        link.faults[LinkFault.BUS_OFF] += 1
        (warning,) = bus_faults(link)
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
    still: Recording, clock: Clock, x_mm: float, with_poses: bool, reason: GateReason
) -> None:
    channel = next(CHANNELS)
    replaying, robot = Replaying(still, channel), Robot(channel, clock)
    robot.x_mm = x_mm
    with replaying.link, robot.link:
        for command in (Command.DISARM, Command.TRACK):
            robot.say(command, with_poses)
        replaying.publish(ROWS[0])
    assert replaying.controller.reasons == Counter({reason: 1} if reason is not GateReason.NONE else {})


def test_a_robot_is_sent_nothing_that_rests_on_poses_in_doubt(still: Recording, clock: Clock) -> None:
    channel = next(CHANNELS)
    ended = replace(still.poses, timestamps_s=TIMES_S[:50], T_base_tool=STILL_MM[:50])
    replaying, robot = Replaying(replace(still, poses=ended), channel), Robot(channel, clock)
    with replaying.link, robot.link:
        for command in (Command.DISARM, Command.TRACK):
            robot.say(command)
        replaying.publish(ROWS[0])
    assert replaying.controller.reasons == Counter({GateReason.POSE_IMPLAUSIBLE: 1})


def test_a_robot_that_is_turned_stands_elsewhere(still: Recording) -> None:
    half = math.radians(3.05) / 2.0
    position = RobotPosePosition(0.0, 0.0, 0.0, PoseKind.ACTUAL)
    turned = RobotPoseRotation.from_quaternion((0.0, 0.0, math.sin(half), math.cos(half)), 2.0)
    level = RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 2.0)

    def verdict(position: RobotPosePosition, rotation: RobotPoseRotation, now_s: float) -> GateReason:
        agreement = PoseAgreement(still.pose_buffer(), 0.1)
        for message in (position, rotation):
            agreement.hear(Received(7.0, message, 3), now_s)
        assert agreement.verdict(now_s + 0.11) is GateReason.POSE_IMPLAUSIBLE
        return agreement.verdict(now_s + 0.09)

    assert verdict(position, level, 1.0) is GateReason.NONE
    assert verdict(position, turned, 1.0) is GateReason.ROBOT_ELSEWHERE
    # Where the recording has no pose, no robot can agree with it.
    assert verdict(position, level, 90.0) is GateReason.ROBOT_ELSEWHERE
    programmed = replace(position, kind=PoseKind.PROGRAMMED)
    assert verdict(programmed, level, 1.0) is GateReason.POSE_IMPLAUSIBLE


@pytest.mark.slow
def test_a_robot_that_talks_between_two_frames_is_heard_to_the_end(
    still: Recording, tmp_path: Path, multicast: dict[str, Any]
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

        real_time = RealTime(rows, tracker, lambda: None)
        seam = SeamTracker(RecordedPoses(still), MadeTracking())
        service = TrackingService[None](Controller(JOB), seam, tracker.send, real_time.now_s)
        real_time.begin(service)
        real_time.reach(rows[0], service)
        talking = threading.Thread(target=talk)
        talking.start()
        real_time.reach(rows[1], service)
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


def offline(still: Recording) -> tuple[Link, TrackingService[None], Callable[[FrameRow], SeamOffset]]:
    """Return a link, a service by the recording's time, and what publishes a row."""
    link, clock = Link("virtual", next(CHANNELS), source=Source.REPLAY), RecordingTime(ROWS)
    seam = SeamTracker(RecordedPoses(still), MadeTracking())
    controller = Controller(Job("v_groove"), Source.REPLAY)
    service = TrackingService[None](
        controller, seam, lambda message: link.send(message, clock.logged_at_s()), clock.now_s
    )
    clock.begin(service)

    def publish(row: FrameRow) -> SeamOffset:
        clock.reach(row, service)
        return service.track(None, row.index, row.timestamp_s).offset

    return link, service, publish


def test_nobody_listens_to_virtual(still: Recording) -> None:
    link, service, publish = offline(still)
    with (
        link,
        Link("virtual", link.channel, trusted=Trusted(tracker=(Source.REPLAY,))) as robot,
        Link("virtual", link.channel) as live,
    ):
        offset = publish(ROWS[0])
        assert (offset.validity, offset.offset_y_mm) == (Validity.VALID, 0.0)
        offset = publish(ROWS[3])
        service.close()
        received = heard(robot)
        # Who trusts live frames alone hears nothing.
        assert heard(live) == []
        assert set(live.inbox.skipped) == {SkipReason.OTHER_SOURCE}
    assert (offset.validity, offset.offset_y_mm) == (Validity.VALID, 0.5)
    assert service.controller.verdicts == Counter({Verdict.SEND: 2})
    at_s = [ROWS[n].timestamp_s + ROWS[n].exposure_s / 2.0 for n in (0, 3, 3)]
    assert [r.timestamp_s for r in received if isinstance(r.message, SeamOffset)] == at_s
    assert offsets_of(received)[-1].validity is Validity.REFUSED


def test_the_version_is_sent_again_and_again(still: Recording) -> None:
    link, _, publish = offline(still)
    with link, Link("virtual", link.channel, trusted=Trusted(tracker=(Source.REPLAY,))) as robot:
        for row in ROWS:
            publish(row)
        received = heard(robot)
    counts = Counter(type(r.message) for r in received)
    # 40 frames at 8 a second.
    frame = dict.fromkeys((SeamOffset, SeamPoint, SeamGeometry, TrackerStatus, TrackerHeartbeat), 40)
    assert counts == {**frame, DbcVersion: 5}
    at_s = [r.timestamp_s for r in received if isinstance(r.message, DbcVersion)]
    assert at_s == [ROWS[n].timestamp_s + ROWS[n].exposure_s / 2.0 for n in (0, 8, 16, 24, 32)]
    assert {r.message.source for r in received if isinstance(r.message, DbcVersion)} == {Source.REPLAY}
