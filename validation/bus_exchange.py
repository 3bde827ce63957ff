"""A short exchange of a robot and a tracker, byte by byte, as an integrator may hold a codec against."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from arctrack.control.controller import Controller
from arctrack.control.find_responder import FRAMES
from arctrack.control.job import Job
from arctrack.simulation.cell.robot import WELDING
from noise_model.compiled.arrays import Float64
from robot_io import (
    BusMessage,
    Command,
    MotionState,
    PoseAt,
    PoseKind,
    PoseStatus,
    Protector,
    Received,
    RobotPosePosition,
    RobotPoseRotation,
    RobotPulse,
    RobotSync,
    Switch,
    TrackerCommand,
    WeldingState,
)
from tracker.find import FoundJoint
from tracker.state import Frame, Track

FRAME_S = 0.02

_STATUS = replace(WELDING, weave=Switch.OFF, travel_speed_mm_s=5.0, path_section=3)
_STANDS = replace(_STATUS, motion=MotionState.STOPPED, welding=WeldingState.OFF, arc=Switch.OFF)
_COMMAND = TrackerCommand(Command.DISARM, True, True, 0, 12, None, Switch.ON)


def exchange() -> Iterator[tuple[float, str, BusMessage, int, bytes]]:
    """Yield time, s, sender, message, id and bytes.

    A robot arms, the seam lies 0.6 mm to the left. Then it stands, and asks where the joint is.
    """
    robot, tracker = Protector(), Protector()
    controller = Controller(Job("lap"), finder=_KnownJoint())
    for n in range(4):
        now_s = FRAME_S * n
        said: list[BusMessage] = [
            RobotPosePosition(100.0 + 5.0 * now_s, 0.0, 0.0, PoseKind.ACTUAL),
            RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 2.0),
            _STATUS,
        ]
        if n < 2:
            said.append(replace(_COMMAND, command=Command.DISARM if n == 0 else Command.TRACK))
        if n == 0:
            said += [RobotSync(1, 1_000_000, 620), RobotPulse(20_000, 12_000, 3.0)]
        answers: list[BusMessage] = []
        for message in said:
            yield now_s, "robot", message, *robot.protect(message)
            answers += controller.on_message(Received(now_s, message, 0), now_s)
        answers += controller.on_track(_track(now_s), now_s + 0.008, np.eye(4), 6.0)
        for message in answers:
            yield now_s + 0.008, "tracker", message, *tracker.protect(message)
    now_s = FRAME_S * 4
    for message in (_STANDS, replace(_COMMAND, command=Command.FIND, request_number=1)):
        yield now_s, "robot", message, *robot.protect(message)
        controller.on_message(Received(now_s, message, 0), now_s)
    for n in range(FRAMES):
        now_s += FRAME_S
        frame = Frame(n, now_s - 0.005, np.zeros((1, 1), np.uint8), 0.001)
        unmoved = np.zeros(3)
        pose = PoseAt(frame.timestamp_s, PoseStatus.INTERPOLATED, None, np.eye(4), unmoved, unmoved, 0.01)
        controller.on_shown(frame, pose, False, now_s)
    for message in controller.poll(now_s):
        yield now_s, "tracker", message, *tracker.protect(message)


class _KnownJoint:
    """A finder whose every frame shows the same joint."""

    def begin(self) -> None:
        """Forget nothing."""

    def keep(self, frame: Frame, T_base_tool: Float64) -> None:
        """Take a frame."""

    def found(self, job_number: int) -> FoundJoint:
        """Return the joint."""
        return replace(
            FoundJoint.refused("seam", ""),
            point_base_mm=np.array([135.0, 0.6, 0.0]),
            axes_base=np.eye(3),
            covariance_mm2=np.diag([np.inf, 0.02**2, 0.03**2]),
            direction_covariance=np.diag([np.inf, np.inf]),
            faces_base=np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]),
            face_sigmas_rad=np.radians([0.3, 0.3]),
            track=_track(0.0),
        )


def _track(now_s: float) -> Track:
    return Track(
        0,
        now_s,
        0,
        seam_tool_mm=(35.0, 0.6, 0.0),
        sigma_y_mm=0.02,
        sigma_z_mm=0.03,
        offset_y_mm=0.6,
        offset_z_mm=0.0,
        offset_sigma_y_mm=0.03,
        offset_sigma_z_mm=0.04,
        offset_confidence=0.95,
        gap_mm=0.2,
        mismatch_mm=0.0,
        arc_level=1.0,
        map_misfit=0.9,
    )
