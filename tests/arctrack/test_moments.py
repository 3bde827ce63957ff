"""What a replay believes of the robot and of the time, on a bus of its own and on one beyond it."""

from __future__ import annotations

import itertools
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest
from can.interfaces.virtual import VirtualBus

from arctrack import moments
from arctrack.moments import RealTime, RecordingTime, assumed_robot
from arctrack.publish import LIMITS, Publisher
from arctrack.recording import FrameRow, read_recording
from arctrack.replay import ReplayOptions, replay_recording
from robot_io import (
    BusLogReader,
    BusMessage,
    DbcVersion,
    GateReason,
    Link,
    LinkError,
    Received,
    RobotStatus,
    SeamGeometry,
    SeamOffset,
    Switch,
    TrackerStatus,
    Validity,
    link,
)
from tracker.state import Frame, Pose, Track
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


def test_a_frame_goes_out_when_its_time_has_come(clock: Clock) -> None:
    with Link("virtual", next(CHANNELS)) as link:
        real_time = RealTime(ROWS, link)
        # Kernels are compiled meanwhile: the frames of that time are not to go out in a burst.
        clock.sleep(20.0)
        began_s = clock.now_s
        for row in ROWS[:3]:
            moment = real_time.moment(row, 1.0)
            assert clock.now_s == began_s + row.timestamp_s - ROWS[0].timestamp_s
            assert moment.now_s == row.timestamp_s + row.exposure_s / 2.0
            assert moment.logged_at_s is None


def test_what_comes_too_late_is_refused(clock: Clock) -> None:
    channel = next(CHANNELS)
    with Link("virtual", channel) as link, Link("virtual", channel) as robot:
        real_time, publisher = RealTime(ROWS, link), Publisher(link, "v_groove")
        for row in ROWS:
            # A tenth of a second more than there is from frame to frame.
            clock.sleep(0.225)
            publisher.publish(track(row), real_time.moment(row, 225.0))
        offsets = [r.message for r in heard(robot) if isinstance(r.message, SeamOffset)]
    ages_ms = [offset.capture_age_ms for offset in offsets[:4]]
    assert ages_ms[:2] == pytest.approx([31.25, 131.25], abs=0.5)
    assert [offset.validity for offset in offsets[:3]] == [Validity.VALID, Validity.VALID, Validity.HELD]
    assert publisher.reasons == Counter({GateReason.CAPTURE_TOO_OLD: len(ROWS) - 2})
    assert offsets[-1].validity is Validity.REFUSED


def test_the_robot_is_the_one_that_is_heard(clock: Clock, tmp_path: Path) -> None:
    channel = next(CHANNELS)
    log = tmp_path / "bus.blf"
    stopped = replace(assumed_robot(ROWS[0]), emergency_stop=Switch.ON)
    with Link("virtual", channel, log_paths=[log]) as link, Link("virtual", channel) as robot:
        real_time, publisher = RealTime(ROWS, link), Publisher(link, "v_groove")
        assert real_time.moment(ROWS[0], 1.0).robot == assumed_robot(ROWS[0])
        robot.send(stopped, clock.time())
        moment = real_time.moment(ROWS[1], 1.0)
        assert moment.robot is not None
        assert moment.robot.emergency_stop is Switch.ON
        publisher.publish(track(ROWS[1]), moment)
        # It falls silent: that is no robot, and none is made up.
        assert real_time.moment(ROWS[9], 1.0).robot is None
        (warning,) = real_time.warnings
    assert publisher.reasons == Counter({GateReason.EMERGENCY_STOP: 1})
    assert warning.startswith(f"virtual:{channel}: no RobotStatus was heard for 1 of 3 frames")
    assert [type(r.message) for r in BusLogReader(log)][:1] == [RobotStatus]


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

        real_time = RealTime(rows, tracker)
        real_time.moment(rows[0], 1.0)
        talking = threading.Thread(target=talk)
        talking.start()
        real_time.moment(rows[1], 1.0)
        enough.set()
        talking.join()
        # What came after the frame was due.
        heard(tracker)
        assert not tracker.inbox.skipped
    assert len(list(BusLogReader(log))) == next(sent)


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

    def step(tracker: Tracker, frame: Frame, pose: Pose | None) -> Track:
        happened.append("step")
        return step_of(tracker, frame, pose)

    def join(*options: Any, **more: Any) -> Link:
        happened.append("joined")
        return Link(*options, **more)

    monkeypatch.setattr(Tracker, "warm_up", warmed_up)
    monkeypatch.setattr(Tracker, "step", step)
    monkeypatch.setattr("arctrack.replay.Link", join)
    replay_recording(read_recording(simulated), tmp_path, ReplayOptions(pictures=False))
    assert happened[:3] == ["ready", "joined", "step"]


def test_a_replay_onto_a_bus_beyond_it_listens(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    channel = next(CHANNELS)
    recording = read_recording(simulated)
    stopped = replace(assumed_robot(recording.rows[5]), emergency_stop=Switch.ON)
    robot = Link("virtual", channel)

    def beyond(_interface: str, channel: str, *, log_paths: tuple[Path, ...]) -> Link:
        link = Link("virtual", channel, log_paths=log_paths)
        robot.send(stopped, clock.time() + 0.45)
        return link

    monkeypatch.setattr("arctrack.replay.Link", beyond)
    options = ReplayOptions(bus=f"socketcan:{channel}", pictures=False)
    with robot:
        done = replay_recording(recording, tmp_path / "out", options)
        received = heard(robot)
    # Frames 3 to 6 lie within 0.2 s of the one status; before and after it, it is stale.
    assert done.summary.offsets == {"send": 0, "hold": 0, "refuse": 14}
    assert done.summary.refusals == {"robot_status_stale": 10, "emergency_stop": 4}
    assert done.warnings == ()
    assert len([r for r in received if isinstance(r.message, SeamOffset)]) == 14
    logged = list(BusLogReader(tmp_path / "out" / "bus.blf"))
    assert isinstance(logged[0].message, RobotStatus)


def test_what_did_not_go_out_is_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    send = Link.send

    def fail(link: Link, message: BusMessage, timestamp_s: float | None = None) -> None:
        if isinstance(message, SeamOffset):
            raise LinkError("no acknowledgement")
        send(link, message, timestamp_s)

    with Link("virtual", next(CHANNELS)) as tracker:
        publisher, recording_time = Publisher(tracker, "v_groove"), RecordingTime(ROWS)
        monkeypatch.setattr(Link, "send", fail)
        with pytest.raises(LinkError):
            publisher.publish(track(ROWS[0]), recording_time.moment(ROWS[0], 1.0))
        monkeypatch.setattr(Link, "send", send)
        assert not publisher.verdicts
        doubtful = replace(track(ROWS[1]), offset_confidence=0.0)
        offset = publisher.publish(doubtful, recording_time.moment(ROWS[1], 1.0))
    assert offset.validity is Validity.REFUSED


def test_nobody_listens_to_virtual() -> None:
    recording_time = RecordingTime(ROWS)
    moment = recording_time.moment(ROWS[3], 7.0)
    assert moment.now_s == moment.logged_at_s == ROWS[3].timestamp_s + ROWS[3].exposure_s / 2.0
    assert moment.robot == assumed_robot(ROWS[3])
    assert recording_time.warnings == ()


def test_the_version_is_sent_again_and_again() -> None:
    channel = next(CHANNELS)
    with Link("virtual", channel) as link, Link("virtual", channel) as robot:
        publisher, recording_time = Publisher(link, "v_groove", LIMITS), RecordingTime(ROWS)
        for row in ROWS:
            publisher.publish(track(row), recording_time.moment(row, 1.0))
        received = heard(robot)
    counts = Counter(type(r.message) for r in received)
    # 40 frames at 8 a second.
    assert counts == {SeamOffset: 40, SeamGeometry: 40, TrackerStatus: 40, DbcVersion: 5}
    at_s = [r.timestamp_s for r in received if isinstance(r.message, DbcVersion)]
    assert at_s == [ROWS[n].timestamp_s + ROWS[n].exposure_s / 2.0 for n in (0, 8, 16, 24, 32)]
