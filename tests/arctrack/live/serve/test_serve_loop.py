"""The live loop, driven turn by turn: a robot on a virtual bus, a camera whose frames are drawn here."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping
from dataclasses import astuple, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from made import playing_cell

from arctrack.control.bus_poses import BusPoses
from arctrack.control.cell_file import CellJob, read_cell_file
from arctrack.control.cell_file.choices import AgainChoice
from arctrack.control.controller import Controller
from arctrack.control.frame_tracking import FrameTracking
from arctrack.control.innovation import InnovationLimits
from arctrack.control.job import Job, PartLimits
from arctrack.control.policy import ServicePolicy
from arctrack.control.pose_watch import nominal_path
from arctrack.control.processor import TOO_BUSY
from arctrack.control.recorded_job import with_job
from arctrack.control.seam_passes import SeamPasses
from arctrack.control.tracking_service import SeamTracker
from arctrack.live.cameras.camera import CameraTraits, UnreadableFrame
from arctrack.live.cameras.recording import RecordingCamera
from arctrack.live.monitor.options import MonitorOptions
from arctrack.live.monitor.status import OffsetFlow, indicated, status_content
from arctrack.live.monitor.words import REASONS, Indication
from arctrack.live.serve.exposure import ExposureChooser
from arctrack.live.serve.live_run import run, run_parts
from arctrack.live.serve.loop import LiveLoop
from arctrack.recording import read_recording
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.simulation.cell.robot import WELDING
from noise_model.condition import Condition
from noise_model.forward import draw_frame
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from robot_io import (
    Command,
    GateLimits,
    GateReason,
    LaserState,
    Link,
    PoseKind,
    RobotPosePosition,
    RobotPoseRotation,
    RobotPulse,
    SeamOffset,
    Source,
    Switch,
    TrackerCommand,
    TrackerHeartbeat,
    TrackerState,
    TrackerStatus,
    Validity,
)
from robot_io.poses.plausibility_limits import PlausibilityLimits
from tracker.seam.correction import UNSTATED
from tracker.state import Frame

CHANNELS = (f"test_serve_{n}" for n in itertools.count())
SPEED_MM_S, STEP_S, PERIOD_S = 10.0, 0.01, 0.08
SEAM_LEFT_MM = 0.6


class DrawnCamera:
    """A camera without light sensors: frames that a test takes, on the test's clock."""

    traits = CameraTraits(knows_arc=False, switches_laser=True)
    is_over = False

    def __init__(self) -> None:
        self.time_s, self.dropped, self.laser_on = 1.0, 0, False
        self.frame: Frame | UnreadableFrame | None = None
        self.pulses, self.exposures_s = [], []

    def tell_pulse(self, pulse, came_at_s):
        self.pulses.append((pulse, came_at_s))

    def want_exposure(self, exposure_s):
        self.exposures_s.append(exposure_s)

    def begin(self) -> None:
        self.frame = None

    def now_s(self) -> float:
        return self.time_s

    def newest(self) -> Frame | UnreadableFrame | None:
        frame, self.frame = self.frame, None
        return frame

    def switch_laser(self, is_on: bool) -> LaserState:
        self.laser_on = is_on
        return LaserState.ON if is_on else LaserState.OFF

    def close(self) -> None:
        self.frame = None


class Stage:
    """A robot that travels along a seam, its camera, and the loop; `run` lets time pass in small steps."""

    def __init__(self, setup: Setup, passes: Mapping[int, CellJob] | None = None) -> None:
        channel = next(CHANNELS)
        self.setup, self.camera = setup, DrawnCamera()
        self.link, self.robot = Link(channel=channel), Link(channel=channel)
        jobs = {number: Job(setup.joint.type, poses_proven=True) for number in (1, 2)}
        trackings = {number: FrameTracking(setup) for number in jobs}
        for number, job in (passes or {}).items():
            jobs[number] = job.to_job(setup, GateLimits())
            make_passes = partial(SeamPasses, job, is_live=True)
            trackings[number] = FrameTracking(setup, job.correction, make_passes=make_passes)
        controller = Controller(jobs)
        path, limits = nominal_path(setup.joint), PlausibilityLimits()
        self.seams = {
            number: SeamTracker(
                BusPoses(path, limits, InnovationLimits(), ServicePolicy()), trackings[number]
            )
            for number in jobs
        }
        self.start_mm = 40.0
        self.tracks = []
        self.loop = LiveLoop(
            self.camera,
            self.link,
            controller,
            self.seams,
            on_track=lambda track, _: self.tracks.append(track),
        )
        self.command = TrackerCommand(Command.DISARM, True, True, 0, 1, None, Switch.ON)
        self.steps = 0
        self.robot_status, self.speaks = WELDING, True
        self.takes = True
        self.rng = np.random.default_rng(1)

    def run(self, seconds: float) -> list:
        """Let time pass, and return what the robot heard."""
        heard = []
        for _ in range(round(seconds / STEP_S)):
            self.camera.time_s += STEP_S
            self._say()
            if self.takes and self.steps % round(PERIOD_S / STEP_S) == 0:
                self.camera.frame = self._shot()
            self.steps += 1
            self.loop.turn(0.0)
            heard += [received.message for received in self.robot.receive(0.0)]
        return heard

    def close(self) -> list:
        """Let the loop end, and return what the robot heard of it."""
        self.loop.close()
        return [received.message for received in self.robot.receive(0.0)]

    @property
    def place_mm(self) -> float:
        return self.start_mm + SPEED_MM_S * self.camera.time_s

    def _say(self) -> None:
        if not self.speaks:
            return
        self.robot.send(RobotPosePosition(self.place_mm, 0.0, 0.0, PoseKind.ACTUAL))
        self.robot.send(RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 0.0))
        self.robot.send(self.robot_status)
        self.robot.send(self.command)

    def _shot(self) -> Frame:
        T_base_tool = np.eye(4)
        T_base_tool[0, 3] = self.place_mm
        exposure_s = self.camera.exposures_s[-1] if self.camera.exposures_s else self.setup.camera.exposure_s
        lit = Condition(float(self.camera.laser_on), 1.0, exposure_s)
        image_dn = draw_frame(self.setup, T_base_tool, lit, self.rng, seam=SeamLine(y_mm=SEAM_LEFT_MM))
        return Frame(self.steps, self.camera.time_s, image_dn, exposure_s)


@pytest.fixture
def stage(seen_setup: Setup):
    stage = Stage(seen_setup)
    with stage.link, stage.robot:
        yield stage


def of_type(heard: list, kind: type) -> list:
    return [message for message in heard if isinstance(message, kind)]


@pytest.mark.slow
def test_a_loop_sends_what_it_tracks_and_goes_on_without_a_camera(stage: Stage) -> None:
    before = stage.run(0.4)
    assert {offset.validity for offset in of_type(before, SeamOffset)} == {Validity.REFUSED}
    # Nobody commanded the laser on: the frames are dark, and the heartbeat says so.
    assert {beat.laser for beat in of_type(before, TrackerHeartbeat)} == {LaserState.OFF}
    assert all({"laser_off", "pose_refused"} & {*track.flag_names} for track in stage.tracks)
    assert "laser_off" in stage.tracks[-1].flag_names

    stage.command = replace(stage.command, command=Command.TRACK)
    armed = stage.run(1.6)
    offsets = of_type(armed, SeamOffset)
    assert offsets[-1].validity is Validity.VALID
    assert offsets[-1].offset_y_mm == pytest.approx(SEAM_LEFT_MM, abs=0.1)
    assert stage.camera.laser_on

    stage.takes = False
    stopped = stage.run(0.6)
    reasons = [status.gate_reason for status in of_type(stopped, TrackerStatus)]
    assert reasons[-1] is GateReason.CAMERA_STOPPED
    assert of_type(stopped, SeamOffset)[-1].validity is Validity.REFUSED
    assert len(of_type(stopped, TrackerHeartbeat)) >= 5

    stage.takes = True
    stage.run(0.2)
    result = stage.loop.result()
    assert result.frames == len(stage.tracks)
    assert result.valid == sum(track.valid for track in stage.tracks)
    late = result.capture_to_send
    assert 0.0 <= late.p50_ms <= late.p99_ms <= late.max_ms < 1000.0 * PERIOD_S
    assert result.arrival_to_send.max_ms <= late.max_ms

    last = stage.close()
    assert of_type(last, SeamOffset)[-1].validity is Validity.REFUSED
    assert not stage.camera.laser_on


@pytest.mark.slow
def test_what_is_indicated_follows_the_offsets_that_go_out(stage: Stage) -> None:
    flow = OffsetFlow()

    def indications(seconds: float) -> list[Indication]:
        shown = []
        for _ in range(round(seconds / 0.1)):
            stage.run(0.1)
            status = stage.loop.status()
            flow.add(status)
            shown.append(indicated(status, flow.age_s))
        return shown

    assert {*indications(0.4)} == {Indication.DISARMED}
    stage.command = replace(stage.command, command=Command.TRACK)
    begun = indications(1.6)
    assert begun[-5:] == 5 * [Indication.TRACKING]
    assert {*begun} == {Indication.NO_OFFSETS, Indication.TRACKING}

    stage.robot_status = replace(WELDING, correction=Switch.OFF)
    assert indications(0.3) == 3 * [Indication.TRACKING]
    assert indications(0.6)[-1] is Indication.NO_OFFSETS
    assert stage.loop.status().state is TrackerState.TRACKING
    assert stage.loop.status().reason is GateReason.CORRECTION_OFF
    stage.robot_status = WELDING
    assert indications(0.4)[-1] is Indication.TRACKING

    stage.takes = False
    assert indications(1.0)[-1] is Indication.NO_OFFSETS
    stage.takes = True
    assert indications(0.6)[-1] is Indication.TRACKING
    stage.speaks = False
    assert indications(1.0)[-1] is Indication.NO_OFFSETS
    assert stage.loop.status().reason is GateReason.HEARTBEAT_LOST
    stage.speaks, stage.command = True, replace(stage.command, command=Command.SEARCH)
    assert indications(1.0)[-1] is Indication.SEARCHING
    stage.command = replace(stage.command, command=Command.DISARM)
    assert indications(0.2)[-1] is Indication.DISARMED


@pytest.mark.slow
def test_delays_are_blamed_on_a_machine_that_is_too_busy(stage: Stage) -> None:
    def words() -> str:
        status = stage.loop.status()
        return status_content(MonitorOptions("", {}), status, None, None, 0.0, 1.0, None)["reason"]

    stage.loop._processor.look = lambda: None
    stage.loop._processor.share = 0.3
    stage.run(0.1)
    stage.command = replace(stage.command, command=Command.TRACK)
    stage.run(1.6)
    stage.speaks = False
    stage.run(0.6)
    assert words() == REASONS[GateReason.HEARTBEAT_LOST]
    assert stage.loop.result().delayed == 0
    stage.loop._processor.share = 0.9
    stage.run(0.6)
    assert words() == TOO_BUSY
    assert stage.loop.result().delayed > 0
    # What no load explains keeps its own words.
    stage.speaks, stage.robot_status = True, replace(WELDING, correction=Switch.OFF)
    stage.run(0.6)
    assert words() == REASONS[GateReason.CORRECTION_OFF]


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.1, 6.0])
def test_the_exposure_goes_to_where_the_stripe_is_known_best(stage: Stage, factor: float) -> None:
    own_s = stage.setup.camera.exposure_s
    stage.loop._exposure = ExposureChooser((0.05 * own_s, 20.0 * own_s), 1.0 / PERIOD_S)
    stage.camera.exposures_s = [factor * own_s]
    stage.run(0.1)
    stage.command = replace(stage.command, command=Command.TRACK)
    stage.run(2.0)
    first, last = stage.tracks[2], stage.tracks[-1]
    chosen_s = stage.camera.exposures_s[1:]
    assert chosen_s
    # Each choice is better by enough: it comes to rest.
    assert len(chosen_s) <= 3
    assert (chosen_s[-1] > factor * own_s) == (factor < 1.0)
    assert last.valid
    # The same arc, whatever the exposure.
    assert last.arc_level == pytest.approx(stage.tracks[4].arc_level, rel=0.1)
    assert last.sigma_y_mm < 1.05 * first.sigma_y_mm or not first.valid


@pytest.mark.slow
def test_after_disarm_and_with_another_job_nothing_is_known_of_the_seam(stage: Stage) -> None:
    stage.command = replace(stage.command, command=Command.DISARM)
    stage.run(0.1)
    stage.command = replace(stage.command, command=Command.TRACK)
    stage.run(0.9)
    first, second = stage.seams[1].tracking.tracker, stage.seams[2].tracking.tracker
    assert first.state.frames > 5
    assert second.state.frames == 0
    stage.command = replace(stage.command, command=Command.DISARM)
    stage.run(0.02)
    assert first.state.frames <= 1
    stage.command = replace(stage.command, job_number=2)
    stage.run(0.1)
    stage.command = replace(stage.command, command=Command.TRACK)
    stage.run(0.9)
    assert second.state.frames > 5
    # A number that no job has leaves the seam as it was, and nothing goes out.
    stage.command = replace(stage.command, job_number=3)
    heard = stage.run(0.3)
    assert of_type(heard, TrackerStatus)[-1].gate_reason is GateReason.JOB_UNKNOWN
    assert stage.loop.seam is stage.seams[2]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*root.json")
def test_a_later_job_follows_the_pass_of_an_earlier_one(seen_setup: Setup, tmp_path: Path) -> None:
    seam = tmp_path / "root.json"
    root = CellJob("root", None, UNSTATED, False, PartLimits(), None, keep_seam=seam)
    again = AgainChoice(seam, side_mm=-1.5, laser=False)
    fill = replace(root, keep_seam=None, again=again, correction=again.displaced(UNSTATED))
    stage = Stage(seen_setup, {1: root, 2: fill})
    wanted = []

    def stay_on(is_on: bool) -> LaserState:
        """A laser that nobody switches."""
        wanted.append(is_on)
        stage.camera.laser_on = True
        return LaserState.UNKNOWN

    stage.camera.switch_laser = stay_on
    with stage.link, stage.robot:
        stage.command = replace(stage.command, command=Command.DISARM, job_number=1)
        stage.run(0.1)
        stage.command = replace(stage.command, command=Command.TRACK)
        stage.run(2.4)
        assert not seam.exists()
        stage.command = replace(stage.command, command=Command.DISARM)
        stage.run(0.02)
        kept = seam.read_text()
        # What the sensor sees between passes is of none of them.
        stage.command = replace(stage.command, command=Command.STORE_ZERO)
        stage.run(1.0)
        assert stage.tracks[-1].valid
        assert stage.seams[1].poses.doubt is None
        stage.command = replace(stage.command, command=Command.DISARM)
        stage.start_mm -= 1.5 * SPEED_MM_S
        stage.run(0.5)
        assert seam.read_text() == kept
        stage.command = replace(stage.command, job_number=2)
        stage.run(0.1)
        stage.command = replace(stage.command, command=Command.TRACK)
        stage.tracks.clear()
        offsets = of_type(stage.run(1.6), SeamOffset)
    assert not wanted[-1]
    assert stage.tracks[-1].flag_names[-1] == "pass_followed"
    assert offsets[-1].validity is Validity.VALID
    assert offsets[-1].offset_y_mm == pytest.approx(SEAM_LEFT_MM - 1.5, abs=0.1)
    assert seam.read_text() == kept


def test_the_newest_frame_wins_and_the_robot_hears_how_many_were_dropped(stage: Stage) -> None:
    stage.takes = False
    stage.run(0.1)
    stage.camera.dropped = 256
    # The pose after it is still to come.
    stage.camera.time_s += 0.005
    stage.camera.frame = stage._shot()
    stage.loop.turn(0.0)
    assert stage.tracks == []
    stage.camera.frame = stage._shot()
    heard = stage.run(0.01)
    assert len(stage.tracks) == 1
    assert stage.loop.result().dropped == 257
    assert of_type(heard, TrackerStatus)[0].dropped_frames_mod256 == 1


def test_a_frame_that_cannot_be_read_is_told(stage: Stage) -> None:
    stage.takes = False
    stage.run(0.1)
    stage.camera.frame = UnreadableFrame(7, stage.camera.time_s, "is torn")
    heard = stage.run(0.03)
    assert [status.frame_unreadable for status in of_type(heard, TrackerStatus)] == [True]
    assert stage.tracks[0].flag_names == ("frame_unreadable",)


def test_a_camera_that_does_not_know_the_light_is_told_it_by_the_robot(stage: Stage) -> None:
    stage.takes = False
    frame = stage.loop._lit(stage._shot())
    assert (frame.laser_on, frame.arc_on) == (True, False)
    stage.run(0.05)
    frame = stage.loop._lit(stage._shot())
    assert (frame.laser_on, frame.arc_on, frame.current_a) == (False, True, WELDING.current_a)


@pytest.mark.slow
def test_a_frame_without_the_laser_between_others_changes_nothing_but_a_count(stage: Stage) -> None:
    stage.camera.traits = replace(stage.camera.traits, interleaves=True)
    shot = stage._shot
    stage.run(0.1)
    stage.command = replace(stage.command, command=Command.TRACK)
    stage.run(1.2)
    took, valid = len(stage.tracks), stage.loop.result().valid
    stage._shot = lambda: replace(shot(), laser_on=stage.steps % 3 != 0)
    heard = stage.run(1.2)
    result = stage.loop.result()
    assert result.dark == 5
    assert {offset.validity for offset in of_type(heard, SeamOffset)} == {Validity.VALID}
    assert result.valid - valid == len(stage.tracks) - took == 10
    # Where nobody commands the laser on, a dark frame is no frame in between.
    stage.command = replace(stage.command, command=Command.DISARM)
    stage.run(0.4)
    assert stage.loop.result().dark == 5
    assert "laser_off" in stage.tracks[-1].flag_names


def test_the_camera_is_told_of_the_arcs_pulse(stage: Stage) -> None:
    pulse = RobotPulse(20_000, 12_000, 3.0)
    stage.robot.send(pulse)
    stage.run(0.02)
    ((told, came_at_s),) = stage.camera.pulses
    assert told == pulse
    assert 0.0 <= stage.camera.time_s - came_at_s < 0.1


def test_an_error_of_the_program_ends_with_a_refusal(stage: Stage) -> None:
    def fail():
        raise RuntimeError("the camera's driver fell over")

    stage.run(0.1)
    stage.camera.newest = fail
    with pytest.raises(RuntimeError, match="fell over"):
        run(stage.loop, lambda: True, 60.0)
    heard = [received.message for received in stage.robot.receive(0.0)]
    assert of_type(heard, TrackerStatus)[-1].gate_reason is GateReason.SHUTTING_DOWN
    assert of_type(heard, SeamOffset)[-1].validity is Validity.REFUSED


class Clock:
    """Time that a test lets pass."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.mark.slow
@pytest.mark.parametrize("name", ["simulated", "flawed_recording"])
def test_a_recording_that_is_played_gives_the_tracks_of_its_replay(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    path = request.getfixturevalue(name)
    cell = read_cell_file(playing_cell(tmp_path / "cell", path))
    recording = with_job(read_recording(path, cell.setup.path), cell, None)
    options = ReplayOptions(cell=cell, pictures=False)
    replayed = replay_recording(recording, tmp_path / "results", options)
    parts = run_parts(cell)
    assert parts.source is Source.REPLAY
    tracks, offsets = [], Counter()

    def on_track(track, messages):
        tracks.append(track)
        offsets.update(message.validity for message in messages if isinstance(message, SeamOffset))

    clock = Clock()
    with Link(channel=cell.bus.channel, source=parts.source) as link:
        camera = RecordingCamera(recording, clock)
        loop = LiveLoop(camera, link, parts.controller, parts.seams, False, on_track)
        camera.begin()
        while not loop.is_over:
            clock.now_s += 0.003
            loop.turn(0.0)
    assert len(tracks) == len(recording.rows)
    assert loop.result().dropped == 0
    for live, kept in zip(tracks, replayed.tracks, strict=True):
        assert repr(astuple(replace(live, stripe=None))) == repr(astuple(kept))
    # No robot stands where the recorded one stood.
    assert set(offsets) == {Validity.REFUSED}


def test_a_recording_that_is_not_asked_in_time_drops_frames(simulated: Path) -> None:
    clock = Clock()
    recording = read_recording(simulated)
    camera = RecordingCamera(recording, clock)
    assert camera.now_s() == camera.now_s()
    camera.begin()
    first = camera.newest()
    assert (first.index, camera.newest()) == (recording.rows[0].index, None)
    clock.now_s += recording.rows[5].timestamp_s - recording.rows[0].timestamp_s
    assert camera.newest().index == recording.rows[5].index
    assert camera.dropped == 4
    assert not camera.is_over
    clock.now_s += 1000.0
    assert camera.newest().index == recording.rows[-1].index
    assert camera.is_over
