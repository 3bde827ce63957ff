"""The watch over poses, told what comes off a bus."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from arctrack.control.innovation import InnovationLimits, SeamMeasurement, SeamMotion
from arctrack.control.pose_watch import PoseWatch
from arctrack.simulation.cell.robot import WELDING
from robot_io import (
    Command,
    PoseKind,
    Received,
    RobotPosePosition,
    RobotPoseRotation,
    RobotSync,
    Switch,
    TrackerCommand,
)
from robot_io.clocks.sync import SyncLimits
from robot_io.poses.nominal_path import NominalPath
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_questions import Implausibility

PATH = NominalPath(((0.0, 0.0, 0.0), (300.0, 0.0, 0.0)))
WELDS = replace(WELDING, path_section=None)


class Bus:
    """What a watch hears of a robot that travels at 10 mm/s."""

    def __init__(self):
        self.watch = PoseWatch(PATH, PlausibilityLimits(), InnovationLimits(), SyncLimits(), 0.2)
        self.now_s, self.n = 100.0, 0
        self.clock_s = 0.0
        self.kind, self.off_mm, self.sends_status = PoseKind.ACTUAL, 0.0, True
        self.round_trip_us = 600

    def hear(self, message, max_age_s=0.0):
        now_s = self.now_s + self.clock_s
        return self.watch.hear(Received(now_s - max_age_s, message, self.n % 15, max_age_s=max_age_s), now_s)

    def run(self, seconds):
        sample = None
        for _ in range(round(seconds / 0.01)):
            self.n += 1
            self.now_s += 0.01
            if self.sends_status:
                self.hear(WELDS)
            if self.n % 10 == 0:
                self.hear(RobotSync(self.n // 10 % 256, round(1e6 * self.now_s) % 2**28, self.round_trip_us))
            x_mm = 10.0 * (self.now_s - 100.0)
            self.hear(RobotPosePosition(x_mm, self.off_mm, 0.0, self.kind))
            sample = self.hear(RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 2.0))
        return sample

    @property
    def doubt(self):
        return self.watch.doubt(self.now_s + self.clock_s)


def test_nothing_is_trusted_before_poses_have_shown_enough():
    bus = Bus()
    assert bus.doubt is Implausibility.UNPROVEN
    sample = bus.run(0.5)
    assert bus.doubt is None
    assert sample.timestamp_s == pytest.approx(bus.now_s - 0.002)


def test_a_sample_that_waited_keeps_its_own_time():
    bus = Bus()
    bus.run(0.1)
    bus.now_s += 0.05
    bus.n += 1
    bus.hear(RobotPosePosition(1.5, 0.0, 0.0, PoseKind.ACTUAL), max_age_s=0.03)
    sample = bus.hear(RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 2.0), max_age_s=0.03)
    assert sample.timestamp_s == pytest.approx(bus.now_s - 0.032)


def test_silence_and_a_jump_end_the_trust_and_a_new_seam_begins_it():
    bus = Bus()
    bus.run(1.0)
    assert bus.watch.doubt(bus.now_s + 0.2) is Implausibility.STOPPED
    bus.off_mm = 8.0
    bus.run(1.0)
    assert bus.doubt is Implausibility.NOT_REJOINED
    for command in (Command.TRACK, Command.DISARM):
        bus.hear(TrackerCommand(command, True, True, 0, None, None, Switch.ON))
    assert bus.doubt is Implausibility.UNPROVEN
    bus.run(0.5)
    assert bus.doubt is None


def test_programmed_poses_are_no_poses_of_the_tool_but_hold_them():
    bus = Bus()
    bus.run(0.5)
    bus.kind, bus.off_mm = PoseKind.PROGRAMMED, 30.0
    assert bus.run(0.01) is None
    bus.kind, bus.off_mm = PoseKind.ACTUAL, 0.0
    bus.run(0.01)
    assert bus.doubt is Implausibility.PROGRAMMED_PLACE


def test_a_status_that_is_old_says_nothing():
    bus = Bus()
    bus.run(1.0)
    bus.sends_status = False
    bus.run(0.3)
    # The tool stands, and nobody says any more that it moves.
    still = bus.now_s
    for _ in range(20):
        bus.n += 1
        bus.now_s += 0.01
        bus.hear(RobotPosePosition(10.0 * (still - 100.0), 0.0, 0.0, PoseKind.ACTUAL))
        bus.hear(RobotPoseRotation.from_quaternion((0.0, 0.0, 0.0, 1.0), 2.0))
    assert bus.doubt is None


def test_a_seam_that_moves_otherwise_is_contradicted():
    bus = Bus()
    bus.run(1.0)
    for n in range(60):
        weave_mm = 1.5 * math.sin(0.3 * n)
        bus.watch.see(SeamMeasurement(10.0 + 0.2 * n, (weave_mm, 0.0), (0.05, 0.05)))
    assert bus.doubt is SeamMotion.CONTRADICTED
    bus.hear(TrackerCommand(Command.RESET, True, True, 1, None, None, Switch.ON))
    assert bus.doubt is Implausibility.UNPROVEN


@pytest.mark.parametrize("round_trip_us", [600, None])
def test_a_clock_that_is_set_on_is_forgiven_where_sync_shows_it(round_trip_us):
    bus = Bus()
    bus.run(2.0)
    bus.clock_s, bus.round_trip_us = 1.0, round_trip_us
    bus.run(1.0)
    assert bus.doubt is (Implausibility.LATE if round_trip_us is None else None)
