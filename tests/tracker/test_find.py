"""Find of a joint: its place and attitude on displaced parts, and what one section cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered import frame_of, pose_at, small_setup
from scipy.spatial.transform import Rotation

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import seam_height_mm
from noise_model.transforms import invert, transform
from tracker import flags
from tracker.find import Finder, FoundJoint, JointSection, find_joint, found_corner, found_joint
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Pose, Track

PIVOT_MM = np.array([220.0, 0.0, 0.0])


def displaced(turn_deg: tuple[float, float, float], move_mm: tuple[float, float, float]) -> Float64:
    """The displacement (4, 4) of a part that is turned about a place of its seam and moved."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    T[:3, 3] = PIVOT_MM - T[:3, :3] @ PIVOT_MM + move_mm
    return T


def shown(
    joint: str, T_part: Float64, stations_mm: tuple[float, ...], off_mm: tuple[float, float] = (0.0, 0.0)
) -> tuple[Finder, list[tuple[Frame, Pose]]]:
    """A sensor, and what it sees of a displaced part: the nominal one from a pose displaced back."""
    setup = small_setup(joint)
    frames = []
    for n, x_mm in enumerate(stations_mm):
        pose = pose_at(x_mm, *off_mm)
        frame = frame_of(setup, Pose(invert(T_part) @ pose.T_base_tool), arc=0.0, index=n)
        frames.append((replace(frame, arc_on=False), pose))
    return Finder(SensorGeometry.of(setup)), frames


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["v_groove", "lap", "butt", "fillet"])
def test_place_direction_and_attitude_of_a_displaced_part_are_found_within_their_sigma(joint: str) -> None:
    T_part = displaced((2.0, -1.5, 3.0), (8.0, 3.0, -2.0))
    finder, frames = shown(joint, T_part, (170.0, 190.0))
    found = find_joint(finder, frames)
    assert found.refusal == ""
    point = transform(invert(T_part), found.point_base_mm)
    setup = finder.geometry.setup
    off_mm = point[1:] - np.array([0.0, seam_height_mm(setup.joint)])
    assert np.all(np.abs(off_mm) < 3.0 * np.sqrt(np.diagonal(found.covariance_mm2)[1:]))
    assert np.all(np.abs(off_mm) < 0.03)
    along, normal = T_part[:3, 0], T_part[:3, 2]
    angle_deg = np.degrees(np.linalg.norm(np.cross(found.axes_base[0], along)))
    assert angle_deg < 3.0 * np.linalg.norm(found.direction_sigma_deg)
    assert np.degrees(np.linalg.norm(np.cross(found.normal_base, normal))) < 0.2
    # Each plate's line lies in its plate, which a fillet's leans by half of its angle.
    lean = np.radians(45.0) if joint == "fillet" else 0.0
    for sign, face, sigma in zip((1.0, -1.0), found.faces_base, found.face_sigmas_rad, strict=True):
        plate_normal = T_part[:3, :3] @ np.array([0.0, -sign * np.sin(lean), np.cos(lean)])
        assert abs(face @ plate_normal) < 4.0 * sigma


@pytest.mark.slow
def test_one_place_tells_no_direction_and_is_less_sure_for_it() -> None:
    T_part = displaced((0.0, 0.0, 3.0), (0.0, 1.0, 0.0))
    finder, frames = shown("lap", T_part, (190.0, 190.0))
    found = find_joint(finder, frames)
    assert np.isinf(np.diagonal(found.direction_covariance)).all()
    assert np.isinf(found.sigma_mm[0])
    at_two = find_joint(*shown("lap", T_part, (190.0, 205.0)))
    assert np.isfinite(at_two.direction_covariance).all()
    assert found.sigma_mm[1] > at_two.sigma_mm[1]


@pytest.mark.slow
def test_a_robot_that_searches_beside_its_path_finds_a_part_twenty_mm_off() -> None:
    T_part = displaced((0.0, 0.0, 0.0), (0.0, 20.0, 0.0))
    finder, frames = shown("v_groove", T_part, (190.0,))
    refused = find_joint(finder, frames)
    named = next(flag for flag in flags.FLAGS if flag.name == refused.refusal)
    assert named.invalidates
    assert np.isnan(refused.point_base_mm).all()
    _, retried = shown("v_groove", T_part, (190.0,), off_mm=(16.0, 0.0))
    found = find_joint(finder, [*frames, *retried])
    assert found.refusal == ""
    assert found.point_base_mm[1] == pytest.approx(20.0, abs=0.05)


@pytest.mark.slow
def test_an_end_lies_between_the_frames_with_the_joint_and_the_one_without() -> None:
    finder, frames = shown("v_groove", np.eye(4), (170.0, 180.0))
    plate = replace(
        finder.geometry.setup, joint=replace(finder.geometry.setup.joint, type="flat", dimensions={})
    )
    pose = pose_at(184.0)
    bare = replace(frame_of(plate, pose, arc=0.0, index=9), arc_on=False), pose
    end = find_joint(finder, [*frames, bare], "end")
    # The sheet stands 35 mm ahead: it saw the joint at 215 mm, and none at 219 mm.
    assert end.refusal == ""
    assert end.point_base_mm[0] == pytest.approx(217.0, abs=0.1)
    assert end.sigma_mm[0] == pytest.approx(4.0 / np.sqrt(12.0), rel=0.1)
    assert find_joint(finder, [*frames, bare], "start").refusal == "start_not_passed"


def section(x_mm: float, y_mm: float, z_mm: float, sigma_mm: float = 0.1) -> JointSection:
    return JointSection(
        T_base_joint=np.eye(4),
        point_base_mm=np.array([x_mm, y_mm, z_mm]),
        covariance_mm2=sigma_mm**2 * np.eye(2),
        calibration_base_mm=np.zeros((1, 3)),
        calibration="",
        faces_base=np.tile([0.0, 1.0, 0.0], (2, 1)),
        face_sigmas_rad=np.full(2, 0.01),
        track=Track(0, 0.0, 0),
    )


def test_sections_make_the_line_of_weighted_least_squares() -> None:
    rng = np.random.default_rng(5)
    x_mm, sigma_mm = np.array([0.0, 7.0, 20.0, 31.0]), np.array([0.1, 0.2, 0.1, 0.3])
    y_mm, z_mm = rng.normal(0.0, 1e-3, (2, 4)) + 0.02 * x_mm
    found = found_joint([section(*numbers) for numbers in zip(x_mm, y_mm, z_mm, sigma_mm, strict=True)])
    for values, axis in ((y_mm, 1), (z_mm, 2)):
        (slope, start), covariance = np.polyfit(x_mm, values, 1, w=1.0 / sigma_mm, cov="unscaled")
        assert found.point_base_mm[axis] == pytest.approx(start + slope * found.point_base_mm[0], abs=1e-9)
        assert found.axes_base[0][axis] / found.axes_base[0][0] == pytest.approx(slope, abs=1e-9)
        assert found.direction_covariance[axis - 1, axis - 1] == pytest.approx(covariance[0, 0], rel=0.01)


def test_sections_of_one_place_count_once() -> None:
    one = found_joint([section(0.0, 0.0, 0.0)])
    ten = found_joint([section(0.01 * n, 0.0, 0.0) for n in range(10)])
    assert ten.sigma_mm[1] == pytest.approx(one.sigma_mm[1])


def test_a_line_that_bends_is_less_sure() -> None:
    straight = found_joint([section(x_mm, 0.0, 0.0) for x_mm in range(0, 40, 4)])
    bent = found_joint([section(x_mm, 0.003 * x_mm**2, 0.0) for x_mm in range(0, 40, 4)])
    assert bent.sigma_mm[1] > 2.0 * straight.sigma_mm[1]


def line(point_mm: tuple[float, float, float], along: tuple[float, float, float]) -> FoundJoint:
    x, y, z = along
    axes = np.array([along, (-y, x, z), (0.0, 0.0, 1.0)])
    variances = np.diag([np.inf, 0.01, 0.04])
    return replace(
        FoundJoint.refused("seam", ""),
        point_base_mm=np.array(point_mm),
        axes_base=axes,
        covariance_mm2=variances,
        direction_covariance=np.zeros((2, 2)),
    )


def test_two_seams_meet_at_a_corner() -> None:
    first, second = line((10.0, 2.0, 0.0), (1.0, 0.0, 0.0)), line((50.0, -30.0, 0.2), (0.0, 1.0, 0.0))
    corner = found_corner(first, second)
    assert corner.kind == "corner"
    assert corner.point_base_mm == pytest.approx([50.0, 2.0, 0.1])
    # x by the second, y by the first, the height by both.
    assert np.diagonal(corner.covariance_mm2) == pytest.approx([0.01, 0.01, 0.02])
    assert found_corner(first, replace(second, refusal="stripe_lost")).refusal == "stripe_lost"
    assert found_corner(first, line((0.0, 9.0, 0.0), (1.0, 0.0, 0.0))).refusal == "seams_parallel"
    unknown = replace(second, direction_covariance=np.full((2, 2), np.inf))
    assert found_corner(first, unknown).refusal == "direction_unknown"
