"""Where the seam meets the sheet, what is no pose, and what a hand-eye tolerance leaves: by matrices."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rendered import pose_at, small_setup
from scipy.spatial.transform import Rotation

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import SeamLine, corrugation_height
from noise_model.transforms import invert, transform
from tracker import flags
from tracker.checks import FrameChecks
from tracker.geometry import SensorGeometry, meet_laser_plane
from tracker.seam.expected import check_pose, is_rotation, pose_numbers
from tracker.seam.locate import (
    SeamSource,
    confidence,
    meet_ridges,
    seam_point,
)
from tracker.state import Frame, Pose
from tracker.step import step
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerMemory

SEAM = SeamLine(20.0, 1.2, -0.6, 0.03, -0.02)


@pytest.mark.parametrize("bow", [0.0, -0.15])
@pytest.mark.parametrize("joint", ["v_groove", "corrugation"])
@given(y=st.floats(-5.0, 5.0), z=st.floats(-3.0, 3.0), x=st.floats(-20.0, 20.0))
def test_the_seam_meets_the_sheet(joint: str, y: float, z: float, x: float, bow: float) -> None:
    setup = small_setup(joint)
    setup = replace(setup, laser=replace(setup.laser, bow=bow))
    scene = make_scene(setup, pose_at(x, 0.5, -0.5, (1.0, -2.0, 4.0)).T_base_tool, SEAM)
    point = np.array(
        seam_point(SeamSource.of(setup), scene.T_joint_tool.tolist(), scene.shape.corrugation, y, z)
    )
    assert float(setup.laser.off_mm(point)) == pytest.approx(0.0, abs=1e-8)
    station, *beside = transform(scene.T_joint_tool, point)
    height = z + float(corrugation_height(station, scene.shape.corrugation))
    assert beside == pytest.approx([y, height], abs=1e-8)


@given(lean_deg=st.floats(-60.0, 60.0), x=st.floats(-20.0, 20.0), height_mm=st.floats(0.5, 12.0))
@example(lean_deg=55.0, x=3.0, height_mm=12.0)
@example(lean_deg=49.359375, x=0.0, height_mm=10.0)
def test_a_sheet_that_leans_like_the_ridges_flanks_meets_the_seam_too(
    lean_deg: float, x: float, height_mm: float
) -> None:
    """Where x = b - a c(x) has a slope beyond -1 putting x back into the right side runs off."""
    lean = math.radians(lean_deg)
    plane = np.array([math.cos(lean), 0.0, math.sin(lean), -math.cos(lean) * x])
    corrugation = np.array([height_mm, 20.0, 30.0])
    of_valley = -(0.2 * plane[2] + plane[3]) / plane[0]
    met = meet_ridges(x, of_valley, plane[2] / plane[0], corrugation)
    height = 0.2 + float(corrugation_height(met, corrugation))
    assert plane @ [met, 0.0, height, 1.0] == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_a_tolerance_moves_the_camera_before_a_sheet_that_stands_still(joint: str) -> None:
    setup = small_setup(joint)
    scene = make_scene(setup, pose_at(3.0, 0.5, -0.5, (2.0, -3.0, 4.0)).T_base_tool)
    point = np.array(
        seam_point(SeamSource.of(setup), scene.T_joint_tool.tolist(), scene.shape.corrugation, 0.4, -0.3)
    )
    T_camera_tool = invert(setup.camera.T_tool_camera)
    seen = transform(T_camera_tool, point)
    moves = []
    for axis in np.eye(3):
        turned = Rotation.from_rotvec(math.radians(setup.tolerance.hand_eye_deg) * axis).apply(seen)
        for ray, origin in ((turned, np.zeros(3)), (seen, setup.tolerance.hand_eye_mm * axis)):
            R, place = setup.camera.T_tool_camera[:3, :3], setup.camera.T_tool_camera[:3, 3]
            met = meet_laser_plane(setup, place + R @ origin, (R @ ray)[None])[0]
            moves.append(met - point)
    found = SensorGeometry.of(setup).calibration_field.moves_mm(point)
    np.testing.assert_allclose(found.T @ found, np.transpose(moves) @ np.array(moves), rtol=1e-5, atol=1e-9)


@given(st.lists(st.floats(0.01, 3.0), min_size=1, max_size=2))
def test_confidence_is_that_of_independent_normal_errors(sigmas: list[float]) -> None:
    setup = small_setup("v_groove")
    rng = np.random.default_rng(0)
    errors = rng.normal(0.0, 1.0, (20000, len(sigmas))) * sigmas
    within = (np.abs(errors) < setup.tolerance.seam_mm).all(axis=1).mean()
    y_mm, z_mm = (*sigmas, 0.0)[:2]
    assert confidence(setup.tolerance.seam_mm, y_mm, z_mm) == pytest.approx(within, abs=0.02)


def flags_of(source: SeamSource, T_base_tool: Float64) -> int:
    """Return the flags that a pose raises."""
    asked = FrameChecks()
    can_look = check_pose(asked, source, pose_numbers(source, T_base_tool))
    assert can_look == (asked.flags == 0)
    return asked.flags


@pytest.mark.parametrize("joint", ["v_groove", "lap"])
def test_a_line_that_runs_against_the_travel_is_told(joint: str) -> None:
    setup = small_setup(joint)
    points = setup.joint.seam_in_base_mm
    reversed_ = replace(setup, joint=replace(setup.joint, seam_in_base_mm=points[::-1]))
    for turn_deg in ((0.0, 0.0, 0.0), (20.0, -20.0, 30.0)):
        T_base_tool = pose_at(10.0, 0.5, 1.0, turn_deg).T_base_tool
        assert flags_of(SeamSource.of(setup), T_base_tool) == 0
        assert flags_of(SeamSource.of(reversed_), T_base_tool) == flags.SEAM_REVERSED.mask


def test_what_is_no_pose_is_told() -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [10.0, -20.0, 30.0], degrees=True).as_matrix()
    assert is_rotation(T.tolist())
    mirrored, scaled, sheared = T.copy(), T.copy(), T.copy()
    mirrored[:3, 0] *= -1.0
    scaled[:3, :3] *= 1.01
    sheared[:3, 0] += 0.01 * T[:3, 1]
    for wrong in (mirrored, scaled, sheared):
        assert not is_rotation(wrong.tolist())
    for row, column, value in ((0, 3, np.nan), (1, 1, np.inf), (3, 0, 1e-9), (3, 3, 2.0)):
        wrong = T.copy()
        wrong[row, column] = value
        assert not is_rotation(wrong.tolist())


@pytest.mark.parametrize("no_pose", [np.eye(4)[:3], np.full((4, 4), np.nan), 2.0 * np.eye(4)])
def test_a_step_refuses_what_is_no_pose(no_pose: Float64) -> None:
    geometry = SensorGeometry.of(small_setup("v_groove"))
    camera, sensor = geometry.setup.camera, geometry.setup.sensor
    frame = Frame(3, 0.1, np.zeros((camera.height, camera.width), sensor.dtype), camera.exposure_s)
    state, track, _ = step(geometry, TrackerMemory(), frame, Pose(no_pose), Work.of(geometry))
    assert track.flags == flags.POSE_REFUSED.mask
    assert state.frames == 1
