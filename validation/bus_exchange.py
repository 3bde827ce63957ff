"""A short exchange of a robot and a tracker, byte by byte, as an integrator may hold a codec against."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from arctrack.control.controller import Controller
from arctrack.control.job import Job
from arctrack.simulation.cell.robot import WELDING
from robot_io import (
    BusMessage,
    Command,
    PoseKind,
    Protector,
    Received,
    RobotPosePosition,
    RobotPoseRotation,
    RobotPulse,
    RobotSync,
    Switch,
    TrackerCommand,
)
from tracker.state import Track

FRAME_S = 0.02

_STATUS = replace(WELDING, weave=Switch.OFF, travel_speed_mm_s=5.0, path_section=3)
_COMMAND = TrackerCommand(Command.DISARM, True, True, 0, 12, None, Switch.ON)


def exchange() -> Iterator[tuple[float, str, BusMessage, int, bytes]]:
    """Yield time, s, sender, message, id and bytes: a robot arms, the seam lies 0.6 mm to the left."""
    robot, tracker = Protector(), Protector()
    controller = Controller(Job("lap"))
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
