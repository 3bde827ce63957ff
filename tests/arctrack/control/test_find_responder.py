"""The answers to FIND: one each, of frames after it alone, and a refusal by name for all that goes wrong."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arctrack.control.controller import Controller
from arctrack.control.find_responder import (
    COLLECT_S,
    COMPUTE_S,
    FRAMES,
    MAX_MOVED_MM,
    SPACING_MM,
    found_messages,
)
from arctrack.control.job import Job, PartLimits
from arctrack.simulation.cell.robot import WELDING
from robot_io import (
    Command,
    Fault,
    FindRefusal,
    FindResult,
    FoundPosition,
    FoundRotation,
    MotionState,
    PoseAt,
    PoseStatus,
    Received,
    RequestResult,
    SeamOffset,
    Source,
    Switch,
    TrackerCommand,
    TrackerHeartbeat,
    WeldingState,
)
from tracker import flags
from tracker.find import FoundJoint
from tracker.state import Frame, Track

FRAME_S = 0.02
STANDS = replace(WELDING, motion=MotionState.STOPPED, welding=WeldingState.OFF, arc=Switch.OFF)
DISARMED = TrackerCommand(Command.DISARM, True, True, 0, 1, None, Switch.ON)
FINDS = replace(DISARMED, command=Command.FIND, request_number=1)
FOUND = replace(
    FoundJoint.refused("seam", ""),
    point_base_mm=np.array([10.0, 2.0, -3.0]),
    axes_base=np.eye(3),
    covariance_mm2=np.diag([np.inf, 0.01, 0.04]),
    direction_covariance=np.diag([np.inf, np.inf]),
    track=Track(0, 0.0, 0, gap_mm=0.5, mismatch_mm=-0.1),
)


class Finder:
    """A finder that needs some time, and keeps what it was shown."""

    def __init__(self) -> None:
        self.joint, self.delay, self.kept = FOUND, 3, []

    def begin(self) -> None:
        self.kept, self.left = [], self.delay

    def keep(self, frame: Frame, T_base_tool) -> None:
        self.kept.append((frame, T_base_tool))

    def found(self, job_number: int) -> FoundJoint | None:
        assert job_number == 1
        self.left -= 1
        return self.joint if self.left < 0 else None


class Cell:
    """A controller whose robot stands and asks; what it sends is counted by request."""

    def __init__(self, part: PartLimits | None = None) -> None:
        self.finder = Finder()
        self.controller = Controller(
            {number: Job("lap", part=part or PartLimits()) for number in (1, 2)}, finder=self.finder
        )
        self.now_s, self.robot, self.command = 100.0, STANDS, DISARMED
        self.robot_sends = self.robot_commands = self.camera_sends = True
        self.x_mm, self.speed_mm_s = 0.0, 0.0
        self.laser_on, self.status, self.is_doubted = True, PoseStatus.INTERPOLATED, False
        self.captured_s = -0.01
        self.sent: list = []
        self.run(3)
        self.command = FINDS

    def hear(self, message) -> None:
        self.sent += self.controller.on_message(Received(0.0, message, 0), self.now_s)

    def run(self, n_frames: int) -> list[FindResult]:
        """Let frames pass, and return the results that were sent meanwhile."""
        before = len(self.sent)
        for _ in range(n_frames):
            self.now_s += FRAME_S
            self.x_mm += FRAME_S * self.speed_mm_s
            if self.robot_sends:
                self.hear(self.robot)
            if self.robot_commands:
                self.hear(self.command)
            if self.camera_sends:
                self.show(self.now_s + self.captured_s)
            self.sent += self.controller.poll(self.now_s)
        return of_type(self.sent[before:], FindResult)

    def show(self, captured_s: float) -> None:
        T_base_tool, unmoved = np.eye(4), np.zeros(3)
        T_base_tool[0, 3] = self.x_mm
        pose = PoseAt(captured_s, self.status, None, T_base_tool, unmoved, unmoved, 0.01)
        frame = Frame(0, captured_s, np.zeros((1, 1), np.uint8), 0.001, laser_on=self.laser_on)
        self.controller.on_shown(frame, pose, self.is_doubted, self.now_s)


def of_type(messages: list, kind: type) -> list:
    return [message for message in messages if isinstance(message, kind)]


def assert_nothing_known(cell: Cell) -> None:
    (position,), (rotation,) = of_type(cell.sent, FoundPosition), of_type(cell.sent, FoundRotation)
    assert all(map(math.isnan, (position.x_mm, position.y_mm, position.z_mm)))
    assert all(map(math.isnan, rotation.quaternion_xyzw))


def test_a_find_is_answered_once_and_the_heartbeat_says_so() -> None:
    cell = Cell()
    (result,) = cell.run(50)
    assert (result.request_number, result.refusal) == (1, FindRefusal.NONE)
    assert (result.sigma_y_mm, result.sigma_z_mm) == pytest.approx((0.1, 0.2))
    assert (result.gap_mm, result.mismatch_mm) == (0.5, -0.1)
    (position,), (rotation,) = of_type(cell.sent, FoundPosition), of_type(cell.sent, FoundRotation)
    assert position == FoundPosition(10.0, 2.0, -3.0)
    assert rotation.quaternion_xyzw == pytest.approx((0.0, 0.0, 0.0, 1.0))
    # One place tells no direction, and no face was seen.
    assert math.isnan(rotation.direction_sigma_deg)
    assert math.isnan(rotation.normal_sigma_deg)
    beat = of_type(cell.sent, TrackerHeartbeat)[-1]
    assert (beat.request_number, beat.request_result) == (1, RequestResult.DONE)
    cell.command = replace(FINDS, request_number=2)
    assert [r.request_number for r in cell.run(50)] == [2]
    # The same number again is no new request.
    cell.command = DISARMED
    cell.run(2)
    cell.command = replace(FINDS, request_number=0)
    assert cell.run(50) == []


def test_frames_of_a_robot_that_moves_lie_apart() -> None:
    cell = Cell()
    cell.robot, cell.speed_mm_s = replace(STANDS, motion=MotionState.MOVING), 20.0
    (result,) = cell.run(100)
    assert result.refusal is FindRefusal.NONE
    places_mm = [T_base_tool[0, 3] for _, T_base_tool in cell.finder.kept]
    assert len(places_mm) == FRAMES
    assert np.diff(places_mm).min() >= SPACING_MM


def test_a_robot_that_is_slow_is_answered_by_the_frames_that_came() -> None:
    cell = Cell()
    cell.robot, cell.speed_mm_s = replace(STANDS, motion=MotionState.MOVING), 1.0
    (result,) = cell.run(round((COLLECT_S + 0.5) / FRAME_S))
    assert result.refusal is FindRefusal.NONE
    assert len(cell.finder.kept) == 2


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({"robot": WELDING}, FindRefusal.ARC_ON),
        ({"robot": replace(STANDS, arc=Switch.UNKNOWN)}, FindRefusal.ARC_ON),
        ({"laser_on": False}, FindRefusal.LASER_OFF),
        ({"status": PoseStatus.REFUSED}, FindRefusal.POSE_REFUSED),
        ({"status": PoseStatus.EXTRAPOLATED}, FindRefusal.POSE_REFUSED),
        ({"is_doubted": True}, FindRefusal.POSES_DOUBTED),
        ({"camera_sends": False}, FindRefusal.CAMERA_STOPPED),
        # Frames from before the request, however late they come, and from after now.
        ({"captured_s": -30.0}, FindRefusal.CAMERA_STOPPED),
        ({"captured_s": 0.01}, FindRefusal.CAMERA_STOPPED),
        ({"captured_s": math.nan}, FindRefusal.CAMERA_STOPPED),
        ({"command": replace(FINDS, job_number=7)}, FindRefusal.JOB_UNKNOWN),
        ({"command": replace(FINDS, job_number=None)}, FindRefusal.JOB_UNKNOWN),
        ({"speed_mm_s": 1.1 * MAX_MOVED_MM / FRAME_S}, FindRefusal.MOVED_TOO_FAR),
    ],
)
def test_what_is_wrong_refuses_by_its_name_and_tells_nothing_else(changes, refusal) -> None:
    cell = Cell()
    for name, value in changes.items():
        setattr(cell, name, value)
    (result,) = cell.run(round((COLLECT_S + 1.0) / FRAME_S))
    assert (result.request_number, result.refusal) == (1, refusal)
    assert math.isnan(result.gap_mm)
    assert_nothing_known(cell)
    assert of_type(cell.sent, TrackerHeartbeat)[-1].request_result is RequestResult.REFUSED


@pytest.mark.parametrize("delay", [10**6, 3])
@pytest.mark.parametrize(
    ("message", "refusal"),
    [
        (replace(FINDS, command=Command.DISARM), FindRefusal.WITHDRAWN),
        (replace(FINDS, command=Command.RESET), FindRefusal.WITHDRAWN),
        (replace(FINDS, job_number=2), FindRefusal.WITHDRAWN),
        (WELDING, FindRefusal.ARC_ON),
        (SeamOffset(0.0, 0.0, 0.0, 0.0, validity=0), FindRefusal.FAULT),
    ],
)
def test_what_changes_before_the_answer_ends_the_request_even_if_it_changes_back_at_once(
    delay, message, refusal
) -> None:
    cell = Cell()
    cell.finder.delay = delay
    assert cell.run(FRAMES) == []
    cell.hear(message)
    cell.hear(STANDS)
    cell.hear(FINDS)
    results = cell.run(50)
    assert results[0] == replace(results[0], request_number=1, refusal=refusal)
    assert len(results) == 1
    assert_nothing_known(cell)


def test_a_new_request_takes_the_place_of_an_old_one_with_frames_of_its_own() -> None:
    cell = Cell()
    cell.run(FRAMES - 1)
    cell.command, asked_s = replace(FINDS, request_number=2), cell.now_s
    results = cell.run(50)
    assert [(r.request_number, r.refusal) for r in results] == [
        (1, FindRefusal.WITHDRAWN),
        (2, FindRefusal.NONE),
    ]
    assert min(frame.timestamp_s for frame, _ in cell.finder.kept) > asked_s


@pytest.mark.parametrize("silent", ["robot_sends", "robot_commands"])
def test_a_robot_that_falls_silent_gets_no_joint(silent: str) -> None:
    cell = Cell()
    cell.finder.delay = 30
    cell.run(FRAMES)
    setattr(cell, silent, False)
    (result,) = cell.run(40)
    expected = FindRefusal.ROBOT_STATUS_STALE if silent == "robot_sends" else FindRefusal.WITHDRAWN
    assert result.refusal is expected


def test_a_finder_that_is_lost_or_none_is_said() -> None:
    cell = Cell()
    cell.finder.delay = 10**6
    (result,) = cell.run(round((COLLECT_S + COMPUTE_S + 1.0) / FRAME_S))
    assert result.refusal is FindRefusal.NOT_AVAILABLE
    cell = Cell()
    cell.controller = Controller(Job("lap"), Source.LIVE)
    (result,) = cell.run(5)
    assert result.refusal is FindRefusal.NOT_AVAILABLE


def test_a_tracker_that_ends_answers_before_it_does() -> None:
    cell = Cell()
    cell.run(2)
    (result,) = of_type(cell.controller.close(cell.now_s), FindResult)
    assert result.refusal is FindRefusal.SHUTTING_DOWN


def test_a_part_beyond_its_limits_is_refused_with_what_was_measured_of_it() -> None:
    cell = Cell(PartLimits(gap_mm=(0.0, 0.3)))
    (result,) = cell.run(50)
    assert (result.refusal, result.gap_mm) == (FindRefusal.GAP, 0.5)
    assert_nothing_known(cell)


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({"covariance_mm2": np.diag([np.inf, 0.01, 4.0])}, FindRefusal.SIGMA_TOO_LARGE),
        ({"covariance_mm2": np.full((3, 3), np.nan)}, FindRefusal.SIGMA_TOO_LARGE),
        ({"point_base_mm": np.array([0.0, 1700.0, 0.0])}, FindRefusal.OUT_OF_RANGE),
        ({"refusal": "stripe_lost", "track": None}, FindRefusal.STRIPE_LOST),
    ],
)
def test_a_joint_that_the_bus_cannot_carry_is_refused(changes, refusal) -> None:
    result, position, _ = found_messages(1, replace(FOUND, **changes), PartLimits())
    assert result.refusal is refusal
    assert math.isnan(position.x_mm)


def test_every_refusal_of_a_find_has_a_name_on_the_bus() -> None:
    names = {flag.name.upper() for flag in flags.FLAGS if flag.invalidates}
    faults = {fault.name for fault in Fault if Fault.NONE < fault < Fault.BRIDGED_TOO_FAR} - {"OTHER_TRACKER"}
    assert names | faults <= FindRefusal.__members__.keys()


EVENTS = st.sampled_from(
    [
        "frame",
        "frame",
        "frame",
        "ask",
        "disarm",
        "job",
        "arc",
        "silence",
        "dark",
        "late frame",
        "extrapolated",
    ]
)


@given(st.lists(EVENTS, max_size=60))
def test_whatever_happens_each_request_has_one_answer_of_frames_after_it(events: list[str]) -> None:
    cell = Cell()
    cell.command, cell.finder.delay = DISARMED, 2
    asked_s: dict[int, float] = {}
    for event in events:
        cell.robot, cell.robot_commands, cell.laser_on = STANDS, True, True
        cell.captured_s, cell.status = -0.01, PoseStatus.INTERPOLATED
        if event == "ask":
            number = cell.command.request_number + 1
            cell.command = replace(FINDS, request_number=number)
            asked_s[number] = cell.now_s + FRAME_S
        elif event == "disarm":
            cell.command = replace(cell.command, command=Command.DISARM)
        elif event == "job":
            cell.command = replace(cell.command, job_number=3 - cell.command.job_number)
            cell.finder.found = lambda job_number: FOUND
        elif event == "arc":
            cell.robot = WELDING
        elif event == "silence":
            cell.robot_commands = False
        elif event == "dark":
            cell.laser_on = False
        elif event == "late frame":
            cell.captured_s = -0.05
        elif event == "extrapolated":
            cell.status = PoseStatus.EXTRAPOLATED
        found = [r for r in cell.run(1) if r.refusal is FindRefusal.NONE]
        for result in found:
            assert len(cell.finder.kept) == FRAMES
            assert all(frame.timestamp_s > asked_s[result.request_number] for frame, _ in cell.finder.kept)
    cell.command = replace(cell.command, command=Command.DISARM)
    cell.run(2)
    answered = [result.request_number for result in of_type(cell.sent, FindResult)]
    assert answered == list(asked_s)
