"""Jobs by number, and what they ask of a part before the arc and along the seam."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_controller import JOB, TRACKS, WELDS, Cell, assert_refused, track

from arctrack.control.controller import Controller
from arctrack.control.job import NO_JOB, Bridging, Job, PartLimits
from arctrack.control.part_fitness import Bridge, PartCheck, depth_mm, opening_deg
from noise_model.surface.joint import Joint, section
from robot_io import (
    Command,
    Fault,
    GateLimits,
    GateReason,
    JointType,
    SeamGeometry,
    Switch,
    TrackerState,
    Validity,
)
from robot_io.poses.nominal_path import NominalPath
from tracker.seam.correction import AxisCorrection, Correction
from tracker.state import NAN, JointShape

SYMMETRIC, SKEW = JointShape(bevel_angles_deg=(30.0, 30.0)), JointShape(bevel_angles_deg=(30.0, 27.0))
PATH = NominalPath(((0.0, 0.0, 0.0), (200.0, 0.0, 0.0)))
ARC_OFF = replace(WELDS, arc=Switch.OFF)


def test_the_job_is_the_one_of_the_number_that_the_robot_names() -> None:
    only_y = Correction(z=AxisCorrection(enable=False))
    jobs = {7: Job("lap", correction=only_y), 12: Job("butt", GateLimits(range_y_mm=0.1))}
    cell = Cell()
    cell.controller = Controller(jobs)
    assert cell.controller.job is NO_JOB
    for number in (None, 8):
        cell.command = replace(TRACKS, job_number=number)
        cell.run(2)
        assert_refused(cell, GateReason.JOB_UNKNOWN)
        assert sent_joint(cell) is JointType.UNKNOWN
    cell.command = replace(TRACKS, command=Command.DISARM, job_number=7)
    cell.run(2)
    cell.command = replace(TRACKS, job_number=7)
    offset = cell.run(3)
    assert offset.validity is Validity.VALID
    assert math.isnan(offset.offset_z_mm)
    assert sent_joint(cell) is JointType.LAP
    # The other job has limits of its own, and starts from nought.
    cell.command, cell.offset_y_mm = replace(TRACKS, job_number=12), 0.2
    cell.run(2)
    assert_refused(cell, GateReason.OUT_OF_RANGE)
    assert sent_joint(cell) is JointType.BUTT


def sent_joint(cell: Cell) -> JointType:
    return [m for m in cell.sent if isinstance(m, SeamGeometry)][-1].joint


@pytest.mark.parametrize(
    ("limits", "shown", "fault"),
    [
        (PartLimits(gap_mm=(0.0, 1.0)), {"gap_mm": 1.01}, Fault.GAP),
        (PartLimits(gap_mm=(0.0, 1.0)), {"gap_mm": 1.0}, Fault.NONE),
        (PartLimits(gap_mm=(0.0, 1.0)), {"gap_mm": NAN}, Fault.GAP),
        (PartLimits(mismatch_mm=(-0.5, 0.5)), {"mismatch_mm": -0.6}, Fault.MISMATCH),
        (PartLimits(depth_mm=(3.5, 4.5)), {"gap_mm": 0.0, "shape": JointShape(area_mm2=9.0)}, Fault.DEPTH),
        (
            PartLimits(angle_deg=(58.0, 62.0)),
            {"shape": SKEW},
            Fault.ANGLE,
        ),
        (
            PartLimits(angle_deg=(58.0, 62.0)),
            {"shape": SYMMETRIC},
            Fault.NONE,
        ),
    ],
)
def test_a_part_is_refused_by_name_after_so_many_looks(
    limits: PartLimits, shown: dict[str, object], fault: Fault
) -> None:
    looked = replace(track(0.0), **shown)
    check = PartCheck()
    for _ in range(limits.looks - 1):
        check = check.seen(looked, limits)
        assert (check.passed, check.fault) == (False, Fault.NONE)
    # A frame without a seam says nothing.
    check = check.seen(replace(looked, seam_tool_mm=(NAN,) * 3), limits)
    assert (check.passed, check.fault) == (False, Fault.NONE)
    check = check.seen(looked, limits)
    assert (check.passed, check.fault) == (fault is Fault.NONE, fault)


def test_a_look_that_says_otherwise_begins_the_count_anew() -> None:
    limits = PartLimits(gap_mm=(0.0, 1.0), looks=2)
    wide, narrow = replace(track(0.0), gap_mm=2.0), replace(track(0.0), gap_mm=0.5)
    check = PartCheck()
    for looked in (wide, narrow, wide, narrow):
        check = check.seen(looked, limits)
    assert (check.passed, check.fault) == (False, Fault.NONE)
    assert check.seen(narrow, limits).passed


def test_nothing_is_welded_of_which_nothing_was_measured_before_the_arc() -> None:
    cell = Cell(replace(JOB, part=PartLimits(mismatch_mm=(-1.0, 1.0), looks=3)))
    cell.run(10)
    assert_refused(cell, GateReason.PART_REFUSED)
    assert cell.controller.fault is Fault.NONE


def test_a_refused_part_is_a_fault_until_reset_and_the_next_part_is_asked_anew() -> None:
    cell = Cell(replace(JOB, part=PartLimits(gap_mm=(0.0, 1.0), looks=3)))
    cell.gap_mm = 1.5
    cell.robot = ARC_OFF
    cell.run(3)
    assert_refused(cell, GateReason.PART_REFUSED)
    assert (cell.controller.fault, cell.controller.state) == (Fault.GAP, TrackerState.FAULT)
    assert not cell.controller.is_laser_on(cell.now_s)
    cell.robot = WELDS
    cell.run(2)
    assert_refused(cell, GateReason.PART_REFUSED)
    cell.command = replace(TRACKS, command=Command.RESET, request_number=1)
    cell.step()
    cell.gap_mm, cell.robot, cell.command = 0.8, ARC_OFF, replace(TRACKS, request_number=1)
    cell.run(3)
    assert cell.reason is GateReason.ARC_OFF
    cell.robot = WELDS
    assert cell.step().validity is Validity.VALID
    # Disarmed, the next seam begins; the arc burns already.
    cell.command = replace(TRACKS, command=Command.DISARM, request_number=1)
    cell.step()
    cell.command = replace(TRACKS, request_number=1)
    cell.run(5)
    assert_refused(cell, GateReason.PART_REFUSED)


def test_a_gap_that_opens_under_the_arc_refuses_no_part() -> None:
    cell = Cell(replace(JOB, part=PartLimits(gap_mm=(0.0, 1.0), looks=3)))
    cell.robot, cell.gap_mm = ARC_OFF, 0.5
    cell.run(3)
    cell.robot, cell.gap_mm = WELDS, 3.0
    assert cell.run(5).validity is Validity.VALID


def at_mm(x_mm: float, y_mm: float = 0.0) -> np.ndarray:
    T_base_tool = np.eye(4)
    T_base_tool[:2, 3] = x_mm, y_mm
    return T_base_tool


def test_a_stretch_without_a_joint_is_bridged_so_far() -> None:
    bridging = Bridging(PATH, (35.0, 0.0, 0.0), 8.0)
    seen, blind = track(0.0), replace(track(0.0), seam_tool_mm=(NAN,) * 3)
    bridge = Bridge().seen(seen, at_mm(10.0), bridging)
    # A weave goes across, and no way along.
    for x_mm, y_mm, bridged_mm in ((14.0, 0.0, 4.0), (14.0, 3.0, 4.0), (18.5, -3.0, 8.5), (12.0, 0.0, 2.0)):
        bridge = bridge.seen(blind, at_mm(x_mm, y_mm), bridging)
        assert bridge.bridged_mm == pytest.approx(bridged_mm)
    assert bridge.seen(seen, at_mm(20.0), bridging).bridged_mm == 0.0
    # Where the sensor looks past the seam's end, none is missed; nor before its start.
    assert bridge.seen(blind, at_mm(166.0), bridging).bridged_mm == 0.0
    assert Bridge().seen(blind, at_mm(-40.0), bridging).seen_at_mm is NAN
    begun = Bridge().seen(blind, at_mm(-35.0), bridging)
    assert begun.seen(blind, at_mm(-26.0), bridging).bridged_mm == pytest.approx(9.0)


def test_a_tack_that_is_too_long_is_a_fault() -> None:
    cell = Cell(replace(JOB, bridging=Bridging(PATH, (35.0, 0.0, 0.0), 8.0)))
    cell.step()
    cell.sees = False
    cell.x_mm = 7.9
    assert cell.step().validity is Validity.VALID
    cell.x_mm = 8.1
    cell.step()
    assert_refused(cell, GateReason.PART_REFUSED)
    assert cell.controller.fault is Fault.BRIDGED_TOO_FAR
    cell.sees = True
    cell.step()
    assert_refused(cell, GateReason.PART_REFUSED)


def test_a_disarmed_tracker_misses_no_joint() -> None:
    cell = Cell(replace(JOB, bridging=Bridging(PATH, (35.0, 0.0, 0.0), 8.0)))
    cell.command = replace(TRACKS, command=Command.DISARM)
    cell.sees = False
    for cell.x_mm in (0.0, 50.0):
        cell.step()
    cell.command = TRACKS
    cell.step()
    assert cell.controller.fault is Fault.NONE


@pytest.mark.parametrize(
    ("joint_type", "dimensions", "bevels_deg"),
    [
        ("v_groove", {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": 1.0}, (30.0, 30.0)),
        ("v_groove", {"included_angle_deg": 80.0, "depth_mm": 7.0, "root_gap_mm": 0.0}, (40.0, 40.0)),
        ("half_v", {"bevel_angle_deg": 45.0, "depth_mm": 4.0, "root_gap_mm": 1.0}, (45.0, NAN)),
    ],
)
def test_a_grooves_depth_follows_from_its_opening(
    joint_type: str, dimensions: dict[str, float], bevels_deg: tuple[float, float]
) -> None:
    drawn = section(Joint(joint_type, dimensions, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))))
    y_mm, z_mm = drawn.vertices[1:-1].T
    area_mm2 = 0.5 * abs(float(y_mm @ np.roll(z_mm, 1) - np.roll(y_mm, 1) @ z_mm))
    shape = JointShape(area_mm2=area_mm2, bevel_angles_deg=bevels_deg)
    looked = replace(track(0.0), gap_mm=dimensions["root_gap_mm"], shape=shape)
    assert depth_mm(looked) == pytest.approx(dimensions["depth_mm"])
    assert math.isnan(depth_mm(replace(looked, shape=shape._replace(bevel_angles_deg=(NAN, NAN)))))
    assert math.isnan(depth_mm(replace(looked, gap_mm=NAN)))
    assert opening_deg(shape) == pytest.approx(sum(angle for angle in bevels_deg if angle > 0.0))


def test_the_angle_of_plates_is_that_between_them() -> None:
    assert opening_deg(JointShape(plate_angles_deg=(45.0, -45.0))) == pytest.approx(90.0)
    assert opening_deg(JointShape(plate_angles_deg=(0.0, 0.0))) == pytest.approx(180.0)
    assert opening_deg(JointShape(bevel_angles_deg=(30.0, 25.0), plate_angles_deg=(1.0, 1.0))) == 55.0
    assert math.isnan(opening_deg(JointShape()))


def test_limits_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match=r"gap_mm = \[2\.0, 1\.0\]: must be the least and the largest"):
        PartLimits(gap_mm=(2.0, 1.0))
    with pytest.raises(ValueError, match="must be the least and the largest, both finite"):
        PartLimits(depth_mm=(0.0, math.inf))
    with pytest.raises(ValueError, match="looks = 0: must be at least 1"):
        PartLimits(looks=0)
    with pytest.raises(ValueError, match=r"bridge_mm = 0\.0: must be > 0"):
        Bridging(PATH, (35.0, 0.0, 0.0), 0.0)
