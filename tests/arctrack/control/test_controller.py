"""The controller, told all that comes: what it says, when, and what it never says."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arctrack.control.controller import ARMING, Controller
from arctrack.control.job import Job
from arctrack.control.policy import ServicePolicy
from arctrack.simulation.cell.robot import WELDING
from robot_io import (
    BusMessage,
    Command,
    DbcVersion,
    Fault,
    GateReason,
    LaserState,
    MotionState,
    Received,
    RequestResult,
    RobotMode,
    RobotSync,
    SeamGeometry,
    SeamOffset,
    SeamPoint,
    Source,
    Switch,
    TrackerCommand,
    TrackerHeartbeat,
    TrackerState,
    TrackerStatus,
    TrackerSyncEcho,
    Validity,
    WeldingState,
)
from tracker import flags
from tracker.state import Track

FRAME_S = 0.02
JOB = Job("v_groove")
WELDS = replace(WELDING, weave=Switch.OFF, travel_speed_mm_s=5.0, path_section=None)
TRACKS = TrackerCommand(Command.TRACK, True, True, 0, None, None, Switch.ON)


def track(captured_at_s: float, offset_y_mm: float = 0.0, flag_bits: int = 0) -> Track:
    return Track(
        0,
        captured_at_s,
        flag_bits,
        seam_tool_mm=(35.0, 1.0, -2.0),
        sigma_y_mm=0.02,
        sigma_z_mm=0.02,
        offset_y_mm=offset_y_mm,
        offset_z_mm=0.0,
        offset_sigma_y_mm=0.02,
        offset_sigma_z_mm=0.02,
        offset_confidence=0.9,
    )


class Cell:
    """A controller with a robot and a camera that do what they are told, on one clock."""

    def __init__(self, job: Job = JOB, now_s: float = 100.0) -> None:
        self.controller = Controller(job)
        self.now_s = now_s
        self.command, self.robot = replace(TRACKS, command=Command.DISARM), WELDS
        self.robot_sends = self.robot_commands = self.camera_sends = True
        self.offset_y_mm = 0.0
        self.flag_bits = 0
        self.gap_mm, self.x_mm, self.sees = math.nan, 0.0, True
        self.sent: list[BusMessage] = []
        self.step()
        self.command = TRACKS

    def hear(self, message: BusMessage, max_age_s: float = 0.0) -> list[BusMessage]:
        return self.controller.on_message(Received(0.0, message, 0, max_age_s=max_age_s), self.now_s)

    def step(self) -> SeamOffset:
        """One frame later; the offset that stands on the bus then."""
        self.now_s += FRAME_S
        if self.robot_commands:
            self.hear(self.command)
        if self.robot_sends:
            self.hear(self.robot)
            self.robot_heard = self.robot
        if self.camera_sends:
            captured = replace(track(self.now_s - 0.01, self.offset_y_mm, self.flag_bits), gap_mm=self.gap_mm)
            if not self.sees:
                captured = replace(captured, seam_tool_mm=(math.nan,) * 3)
            T_base_tool = np.eye(4)
            T_base_tool[0, 3] = self.x_mm
            self.sent += self.controller.on_track(captured, self.now_s, T_base_tool, 5.0)
        self.sent += self.controller.poll(self.now_s)
        return self.offset

    def run(self, n_frames: int) -> SeamOffset:
        for _ in range(n_frames):
            self.step()
        return self.offset

    @property
    def offset(self) -> SeamOffset:
        return last(self.sent, SeamOffset)

    @property
    def reason(self) -> GateReason:
        return last(self.sent, TrackerStatus).gate_reason


def last(messages: Iterable[BusMessage], kind: type) -> BusMessage:
    return [m for m in messages if isinstance(m, kind)][-1]


def tracking(**changes) -> Cell:
    cell = Cell(replace(JOB, **changes))
    assert cell.step().validity is Validity.VALID
    return cell


def assert_refused(cell: Cell, reason: GateReason) -> None:
    assert cell.offset.validity is Validity.REFUSED
    assert math.isnan(cell.offset.offset_y_mm)
    assert cell.reason is reason


def test_a_frame_is_said_in_order() -> None:
    cell = Cell()
    cell.sent.clear()
    cell.run(5)
    kinds = [type(m) for m in cell.sent]
    frame = [SeamOffset, SeamPoint, SeamGeometry, TrackerStatus]
    assert [kind for kind in kinds if kind is not TrackerHeartbeat] == frame * 5
    assert last(cell.sent, SeamPoint) == SeamPoint(35.0, 1.0, -2.0)
    assert last(cell.sent, TrackerStatus).latency_ms == 5.0
    assert last(cell.sent, TrackerStatus).state is TrackerState.TRACKING


def test_a_seam_point_is_whole_or_unknown() -> None:
    controller = Controller(JOB)
    far = np.eye(4)
    far[0, 3] = 5000.0
    for T_base_tool in (None, far):
        point = last(controller.on_track(track(1.0), 1.01, T_base_tool), SeamPoint)
        assert all(map(math.isnan, (point.x_mm, point.y_mm, point.z_mm)))


def test_nothing_is_valid_before_robot_and_command_are_heard() -> None:
    cell = Cell()
    fresh = Controller(JOB)
    messages = fresh.on_track(track(1.0), 1.01)
    assert last(messages, SeamOffset).validity is Validity.REFUSED
    assert last(messages, TrackerStatus).gate_reason is GateReason.NOT_ARMED
    assert last(messages, TrackerHeartbeat).state is TrackerState.STARTING
    cell.robot_sends = False
    cell.run(20)
    assert_refused(cell, GateReason.ROBOT_STATUS_STALE)


def test_a_robot_that_was_armed_already_must_be_disarmed_first() -> None:
    controller = Controller(JOB)
    for message in (WELDS, TRACKS):
        controller.on_message(Received(0.0, message, 0), 1.0)
    assert last(controller.on_track(track(0.99), 1.0), TrackerStatus).gate_reason is GateReason.NOT_ARMED
    for command in (Command.DISARM, Command.TRACK):
        controller.on_message(Received(0.0, replace(TRACKS, command=command), 0), 1.0)
    assert last(controller.on_track(track(0.99), 1.0), SeamOffset).validity is Validity.VALID


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"emergency_stop": Switch.ON}, GateReason.EMERGENCY_STOP),
        ({"mode": RobotMode.MANUAL}, GateReason.NOT_AUTOMATIC),
        ({"motion": MotionState.STOPPED}, GateReason.ROBOT_NOT_MOVING),
        ({"motion": MotionState.PAUSED}, GateReason.ROBOT_NOT_MOVING),
        ({"motion": MotionState.RETRACTING}, GateReason.ROBOT_NOT_MOVING),
        ({"welding": WeldingState.FAULT}, GateReason.WELDING_FAULT),
        ({"welding": WeldingState.CRATER_FILL}, GateReason.NOT_WELDING),
        ({"arc": Switch.OFF}, GateReason.ARC_OFF),
        ({"correction": Switch.OFF}, GateReason.CORRECTION_OFF),
    ],
)
def test_what_the_robot_says_ends_validity_without_waiting_for_a_frame(changes, reason) -> None:
    cell = tracking()
    cell.camera_sends = False
    cell.robot = replace(WELDS, **changes)
    cell.step()
    assert_refused(cell, reason)
    cell.camera_sends, cell.robot = True, WELDS
    assert cell.step().validity is Validity.VALID


@pytest.mark.parametrize(
    ("command", "reason", "state"),
    [
        (Command.DISARM, GateReason.NOT_ARMED, TrackerState.DISARMED),
        (Command.RESET, GateReason.NOT_ARMED, TrackerState.DISARMED),
        (Command.STORE_ZERO, GateReason.NOT_ARMED, TrackerState.DISARMED),
        (Command.SEARCH, GateReason.SEARCH_ONLY, TrackerState.SEARCHING),
    ],
)
def test_the_command_is_obeyed(command, reason, state) -> None:
    cell = tracking()
    cell.command = replace(TRACKS, command=command)
    cell.step()
    assert_refused(cell, reason)
    assert cell.controller.state is state


def test_a_job_may_let_offsets_out_in_a_search() -> None:
    cell = tracking(offsets_in_search=True)
    cell.command = replace(TRACKS, command=Command.SEARCH)
    assert cell.step().validity is Validity.VALID
    assert cell.controller.state is TrackerState.SEARCHING


def test_a_commanded_hold_holds_for_a_second() -> None:
    cell = tracking()
    cell.command = replace(TRACKS, command=Command.HOLD)
    assert cell.step().validity is Validity.HELD
    assert cell.controller.state is TrackerState.HOLDING
    cell.run(60)
    assert_refused(cell, GateReason.HOLD_COMMANDED)


def test_one_missing_command_ends_validity_and_the_next_one_goes_on() -> None:
    cell = tracking()
    cell.offset_y_mm = 0.3
    cell.run(4)
    assert cell.offset.offset_y_mm == 0.3
    cell.robot_commands = False
    cell.run(7)
    assert cell.offset.validity is Validity.VALID
    cell.step()
    assert_refused(cell, GateReason.HEARTBEAT_LOST)
    assert cell.controller.state is TrackerState.DISARMED
    cell.robot_commands = True
    # No soft start: the robot still stands where it was sent.
    assert cell.step().offset_y_mm == 0.3


def test_a_status_that_waited_in_a_buffer_is_as_old_as_it_may_be() -> None:
    cell = tracking()
    cell.robot_sends = False
    cell.run(10)
    cell.hear(WELDS, max_age_s=3.0)
    cell.step()
    assert_refused(cell, GateReason.ROBOT_STATUS_STALE)


def test_axes_are_those_that_job_and_robot_enable() -> None:
    cell = tracking()
    cell.command = replace(TRACKS, enable_z=False)
    cell.step()
    assert not math.isnan(cell.offset.offset_y_mm)
    assert math.isnan(cell.offset.offset_z_mm)
    cell.command = replace(TRACKS, enable_y=False, enable_z=False)
    cell.step()
    assert_refused(cell, GateReason.NO_AXIS_ENABLED)


def test_the_start_is_soft_after_each_arming() -> None:
    cell = Cell()
    cell.offset_y_mm = 5.0
    for _ in range(2):
        offsets_mm = []
        for _ in range(20):
            cell.step()
            offsets_mm.append(cell.offset.offset_y_mm)
            is_there = cell.offset.offset_y_mm == 5.0
            assert cell.reason is (GateReason.NONE if is_there else GateReason.SOFT_START)
            assert cell.offset.confidence == (0.9 if is_there else 0.0)
        # 20 mm/s, 20 ms a frame.
        assert offsets_mm == pytest.approx([min(5.0, 0.4 * n) for n in range(20)])
        cell.command = replace(TRACKS, command=Command.DISARM)
        cell.camera_sends = False
        cell.step()
        cell.camera_sends, cell.command = True, TRACKS


def test_a_camera_that_stops_is_said() -> None:
    cell = tracking()
    cell.camera_sends = False
    cell.run(9)
    assert cell.offset.validity is Validity.VALID
    cell.run(2)
    assert_refused(cell, GateReason.CAMERA_STOPPED)
    # Again and again, so that a robot that joins hears it.
    n_before = sum(isinstance(m, SeamOffset) for m in cell.sent)
    cell.run(50)
    assert sum(isinstance(m, SeamOffset) for m in cell.sent) - n_before in (8, 9, 10)
    cell.camera_sends = True
    assert cell.step().validity is Validity.VALID


def test_another_tracker_is_a_fault_until_reset() -> None:
    cell = tracking()
    cell.hear(SeamOffset(3.0, 0.0, 5.0, 1.0, Validity.VALID))
    cell.step()
    assert_refused(cell, GateReason.OTHER_TRACKER)
    assert cell.controller.state is TrackerState.FAULT
    cell.run(100)
    assert last(cell.sent, TrackerHeartbeat).fault is Fault.OTHER_TRACKER
    assert_refused(cell, GateReason.OTHER_TRACKER)
    assert not cell.controller.is_laser_on(cell.now_s)
    # The number of a request that was seen before resets nothing.
    cell.command = replace(TRACKS, command=Command.RESET)
    cell.step()
    assert_refused(cell, GateReason.OTHER_TRACKER)
    cell.command = replace(TRACKS, command=Command.RESET, request_number=1)
    cell.step()
    assert_refused(cell, GateReason.NOT_ARMED)
    cell.command = replace(TRACKS, request_number=1)
    assert cell.step().validity is Validity.VALID


def test_poses_must_be_proven_where_the_job_says_so() -> None:
    cell = Cell(replace(JOB, poses_proven=True))
    cell.step()
    assert_refused(cell, GateReason.POSE_IMPLAUSIBLE)
    cell.controller.on_poses(GateReason.NONE, cell.now_s)
    assert cell.step().validity is Validity.VALID
    cell.controller.on_poses(GateReason.ROBOT_ELSEWHERE, cell.now_s)
    cell.step()
    assert_refused(cell, GateReason.ROBOT_ELSEWHERE)
    cell.controller.on_poses(GateReason.NONE, cell.now_s)
    cell.run(5)
    assert cell.offset.validity is Validity.VALID
    cell.step()
    assert_refused(cell, GateReason.POSE_IMPLAUSIBLE)


def test_what_did_not_go_out_is_neither_held_nor_followed() -> None:
    cell = tracking()
    cell.offset_y_mm = 1.0
    for _ in range(10):
        cell.step()
        cell.controller.unsent(cell.offset)
    # As far as one frame and the silence allow from nought, not from what nobody heard.
    assert cell.step().offset_y_mm == pytest.approx(1.0)
    cell.offset_y_mm = 1.2
    cell.step()
    cell.controller.unsent(cell.offset)
    cell.offset_y_mm = math.nan
    assert (cell.step().validity, cell.offset.offset_y_mm) == (Validity.HELD, pytest.approx(1.0))


def test_a_refusal_that_did_not_go_out_is_said_again() -> None:
    cell = tracking()
    cell.camera_sends = False
    cell.robot = replace(WELDS, emergency_stop=Switch.ON)
    cell.step()
    assert_refused(cell, GateReason.EMERGENCY_STOP)
    assert not any(isinstance(m, SeamOffset) for m in cell.controller.poll(cell.now_s))
    cell.controller.unsent(cell.offset)
    assert last(cell.controller.poll(cell.now_s), SeamOffset).validity is Validity.REFUSED


def test_the_last_word_is_refused() -> None:
    cell = tracking()
    messages = cell.controller.close(cell.now_s)
    assert [type(m) for m in messages[:3]] == [SeamOffset, SeamPoint, TrackerStatus]
    assert messages[0].validity is Validity.REFUSED
    assert messages[2].gate_reason is GateReason.SHUTTING_DOWN
    assert last(messages, TrackerHeartbeat).state is TrackerState.DISARMED
    cell.step()
    assert_refused(cell, GateReason.SHUTTING_DOWN)
    assert not cell.controller.is_laser_on(cell.now_s)


def test_following_that_has_stopped_is_refused_at_once() -> None:
    cell = tracking()
    cell.flag_bits = flags.FOLLOW_STOPPED.mask
    cell.step()
    assert_refused(cell, GateReason.NOT_ARMED)
    assert cell.controller.state is TrackerState.DISARMED


def test_the_heartbeat_beats_with_and_without_a_camera() -> None:
    cell = Cell()
    cell.run(50)
    cell.camera_sends = False
    cell.run(50)
    beats = [m for m in cell.sent if isinstance(m, TrackerHeartbeat)]
    assert len(beats) == pytest.approx(20, abs=2)
    assert [b.rolling for b in beats] == list(range(beats[0].rolling, beats[0].rolling + len(beats)))
    assert {b.source for b in beats} == {Source.LIVE}
    assert {b.laser for b in beats} == {LaserState.UNKNOWN}
    cell.controller.on_laser(LaserState.INTERLOCK_OPEN)
    cell.run(6)
    assert last(cell.sent, TrackerHeartbeat).laser is LaserState.INTERLOCK_OPEN
    versions = [m for m in cell.sent if isinstance(m, DbcVersion)]
    assert len(versions) in (2, 3)


def test_the_laser_is_on_only_while_a_robot_that_is_heard_wants_it() -> None:
    cell = Cell()
    for command in Command:
        for enable in Switch:
            cell.command = replace(TRACKS, command=command, laser_enable=enable)
            cell.step()
            wanted = command in (*ARMING, Command.STORE_ZERO, Command.FIND) and enable is Switch.ON
            assert cell.controller.is_laser_on(cell.now_s) == wanted
    cell.command = TRACKS
    cell.step()
    assert cell.controller.is_laser_on(cell.now_s + 0.149)
    assert not cell.controller.is_laser_on(cell.now_s + 0.151)


def test_a_sync_is_echoed_with_its_delay() -> None:
    cell = Cell()
    assert cell.hear(RobotSync(9, 1000, None), 0.0015) == [TrackerSyncEcho(9, 1500, Source.LIVE)]
    assert cell.hear(RobotSync(10, 1000, None), 2.0) == [TrackerSyncEcho(10, None, Source.LIVE)]


def test_a_position_is_stored_as_zero_once_for_each_request() -> None:
    cell = tracking()
    cell.offset_y_mm = 0.25
    cell.run(3)
    cell.command = replace(TRACKS, command=Command.STORE_ZERO, request_number=1)
    cell.run(6)
    beat = last(cell.sent, TrackerHeartbeat)
    assert (beat.request_number, beat.request_result) == (1, RequestResult.DONE)
    # The level stays, the seam moves: the zero does not.
    cell.offset_y_mm = 0.5
    cell.run(2)
    cell.command = replace(TRACKS, request_number=1)
    cell.run(5)
    assert cell.offset.offset_y_mm == pytest.approx(0.25)
    cell.command = replace(TRACKS, request_number=1, job_number=7)
    cell.run(5)
    assert cell.offset.offset_y_mm == pytest.approx(0.5)


@pytest.mark.parametrize("problem", ["not valid", "uncertain", "first request", "old"])
def test_a_position_that_is_not_known_is_no_zero(problem) -> None:
    cell = tracking()
    cell.offset_y_mm = 0.25
    if problem == "not valid":
        cell.flag_bits = flags.JOINT_NOT_FOUND.mask
    elif problem == "uncertain":
        cell.offset_y_mm = math.nan
    cell.run(3)
    if problem == "old":
        cell.camera_sends = False
        cell.run(15)
    if problem == "first request":
        cell.controller = Controller(JOB)
        cell.robot_commands = False
        cell.step()
        cell.robot_commands = True
    cell.command = replace(TRACKS, command=Command.STORE_ZERO, request_number=1)
    cell.run(6)
    assert last(cell.sent, TrackerHeartbeat).request_result is RequestResult.REFUSED


def test_what_was_sent_before_a_clock_was_set_back_never_passes_for_new() -> None:
    cell = tracking()
    cell.run(50)
    set_back_at_s, cell.flag_bits = cell.now_s, 0
    cell.now_s -= 1.0
    cell.offset_y_mm = math.nan
    while cell.now_s < set_back_at_s + 0.5:
        offset = cell.step()
        if offset.validity is Validity.HELD:
            # The last capture was taken when the clock was set back.
            assert offset.capture_age_ms / 1000.0 >= cell.now_s - (set_back_at_s - 1.0) - 0.03
    assert_refused(cell, GateReason.NOT_MEASURED)


def test_a_clock_that_is_set_back_refuses_and_recovers() -> None:
    cell = tracking()
    cell.now_s -= 50.0
    cell.robot_sends = cell.robot_commands = False
    cell.step()
    assert cell.offset.validity is Validity.REFUSED
    cell.robot_sends = cell.robot_commands = True
    cell.command = replace(TRACKS, command=Command.DISARM)
    cell.step()
    cell.command = TRACKS
    assert cell.step().validity is Validity.VALID


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_times_must_make_sense(value) -> None:
    with pytest.raises(ValueError, match="service policy command_age_s"):
        ServicePolicy(command_age_s=value)


EVENTS = st.sampled_from(
    ["robot", "no robot", "stop", "weld", "arm", "disarm", "silence", "camera", "no camera", "jump", "back"]
)


@given(st.lists(EVENTS, max_size=60))
def test_whatever_happens_an_offset_that_counts_has_a_robot_behind_it(events) -> None:
    cell = Cell()
    before: SeamOffset | None = None
    for event in events:
        if event in ("robot", "no robot"):
            cell.robot_sends = event == "robot"
        elif event in ("stop", "weld"):
            cell.robot = replace(WELDS, motion=MotionState.STOPPED) if event == "stop" else WELDS
        elif event in ("arm", "disarm"):
            cell.command = replace(TRACKS, command=Command.TRACK if event == "arm" else Command.DISARM)
        elif event in ("camera", "no camera"):
            cell.camera_sends = event == "camera"
        elif event == "silence":
            cell.now_s += 0.5
        else:
            cell.offset_y_mm = 4.0 if event == "jump" else 0.0
        cell.step()
        offset = cell.offset
        if offset.validity is Validity.REFUSED:
            continue
        assert cell.robot_heard is WELDS
        assert cell.command.command is Command.TRACK
        assert abs(offset.offset_y_mm) <= JOB.limits.range_y_mm
        if before is not None and not math.isnan(before.offset_y_mm) and event not in ("arm", "disarm"):
            assert abs(offset.offset_y_mm - before.offset_y_mm) <= JOB.limits.jump_mm + 1e-9
        before = offset
