import dataclasses
import math

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st

from noise_model.surface.joint import (
    REACH_MM,
    Joint,
    SeamLine,
    corrugation_height,
    seam_frame,
    seam_height_mm,
    section,
)
from noise_model.transforms import invert

STRAIGHT = ((-90.0, 0.0, 0.0), (230.0, 0.0, 0.0))
slopes = st.floats(-0.5, 0.5)
millimetres = st.floats(-50.0, 50.0)


@pytest.mark.parametrize("name", scenes.JOINTS)
def test_a_section_is_the_cross_section_as_drawn(name):
    joint = scenes.JOINTS[name]
    vertices = section(joint).vertices
    assert vertices[0, 0] == -REACH_MM
    assert vertices[-1, 0] == REACH_MM
    y = np.linspace(-20.0, 20.0, 4001)[1:-1] + 0.0003
    drawn = np.interp(y, vertices[:, 0], vertices[:, 1])
    np.testing.assert_allclose(drawn, scenes.height(joint, np.full_like(y, 30.0), y), atol=1e-9)


def test_a_v_groove_by_hand():
    joint = Joint("v_groove", {"included_angle_deg": 90.0, "depth_mm": 3.0, "root_gap_mm": 2.0}, STRAIGHT)
    np.testing.assert_allclose(
        section(joint).vertices[1:-1], [[-4.0, 0.0], [-1.0, -3.0], [1.0, -3.0], [4.0, 0.0]], atol=1e-12
    )
    assert seam_height_mm(joint) == -3.0


def test_a_v_groove_without_a_gap_has_one_root():
    size = {"included_angle_deg": 60.0, "depth_mm": 3.0, "root_gap_mm": 0.0}
    half_mouth = 3.0 / math.sqrt(3.0)
    np.testing.assert_allclose(
        section(Joint("v_groove", size, STRAIGHT)).vertices[1:-1],
        [[-half_mouth, 0.0], [0.0, -3.0], [half_mouth, 0.0]],
        atol=1e-12,
    )


def test_a_laps_sheet_lies_to_the_right_of_travel():
    vertices = section(scenes.JOINTS["lap"]).vertices
    np.testing.assert_array_equal(vertices[:, 1], [2.0, 2.0, 0.0, 0.0])
    np.testing.assert_array_equal(vertices[1:3, 0], [0.0, 0.0])
    assert seam_height_mm(scenes.JOINTS["lap"]) == 0.0


@given(st.floats(-500.0, 500.0))
def test_a_corrugations_height(x):
    joint = scenes.JOINTS["corrugation"]
    height = corrugation_height(np.array(x), section(joint).corrugation)
    np.testing.assert_allclose(height, scenes.corrugation(joint, np.array(x)), atol=1e-9)


def test_a_corrugation_by_hand():
    shape = section(scenes.JOINTS["corrugation"])
    x = np.array([0.0, 7.5, 15.0, 30.0, 45.0, 52.5, 60.0, -60.0, -7.5])
    np.testing.assert_allclose(
        corrugation_height(x, shape.corrugation), [8.0, 4.0, 0.0, 0.0, 0.0, 4.0, 8.0, 8.0, 4.0], atol=1e-12
    )
    plain = section(scenes.JOINTS["lap"])
    np.testing.assert_array_equal(corrugation_height(x, plain.corrugation), 0.0)


def test_along_base_x_the_joint_frame_is_base():
    np.testing.assert_array_equal(seam_frame(scenes.JOINTS["flat"], np.array([40.0, 3.0, 1.0])), np.eye(4))


def test_a_turned_and_moved_seam_line():
    start, direction = np.array([10.0, 20.0, 5.0]), np.array([0.6, 0.8, 0.0])
    joint = dataclasses.replace(
        scenes.JOINTS["lap"],
        seam_in_base_mm=(tuple(start - 70.0 * direction), tuple(start + 200.0 * direction)),
    )
    T_base_joint = seam_frame(joint, start)
    np.testing.assert_allclose(T_base_joint[:3, 0], direction, atol=1e-12)
    np.testing.assert_allclose(T_base_joint[:3, 1], [-0.8, 0.6, 0.0], atol=1e-12)
    np.testing.assert_allclose(T_base_joint[:3, 2], [0.0, 0.0, 1.0], atol=1e-12)
    origin = T_base_joint[:3, 3]
    # On the line, and beside base's origin: the shortest way between them is across the line.
    np.testing.assert_allclose(np.cross(origin - start, direction), 0.0, atol=1e-9)
    assert origin @ direction == pytest.approx(0.0, abs=1e-9)


def test_a_leaning_surface():
    normal = np.array([0.0, -math.sin(0.2), math.cos(0.2)])
    joint = dataclasses.replace(scenes.JOINTS["lap"], surface_normal_in_base=tuple(normal))
    T_base_joint = seam_frame(joint, np.zeros(3))
    np.testing.assert_allclose(T_base_joint[:3, 2], normal, atol=1e-12)
    np.testing.assert_allclose(T_base_joint[:3, :3].T @ T_base_joint[:3, :3], np.eye(3), atol=1e-12)


def test_of_several_segments_the_nearest_one_counts():
    corner = ((-100.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 100.0, 0.0))
    joint = dataclasses.replace(scenes.JOINTS["flat"], seam_in_base_mm=corner)
    np.testing.assert_allclose(seam_frame(joint, np.array([-50.0, 5.0, 0.0]))[:3, 0], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        seam_frame(joint, np.array([-5.0, 50.0, 0.0]))[:3, 0], [0.0, 1.0, 0.0], atol=1e-12
    )
    # Past an end the last segment goes on.
    np.testing.assert_allclose(
        seam_frame(joint, np.array([3.0, 400.0, 0.0]))[:3, 0], [0.0, 1.0, 0.0], atol=1e-12
    )


@given(
    st.tuples(millimetres, millimetres, millimetres),
    st.lists(st.tuples(st.floats(5.0, 300.0), st.floats(-80.0, 80.0)), min_size=2, max_size=5),
)
def test_stations_run_on_through_every_bend(start, steps):
    """As long as the way is: the seam's history on one segment is asked for stations of the next."""
    points = [np.array(start)]
    heading = 0.0
    for length, turn_deg in steps:
        heading += math.radians(turn_deg)
        points.append(points[-1] + length * np.array([math.cos(heading), math.sin(heading), 0.0]))
    joint = dataclasses.replace(scenes.JOINTS["flat"], seam_in_base_mm=tuple(tuple(p) for p in points))
    began = seam_frame(joint, 0.5 * (points[0] + points[1]))
    expected = (invert(began) @ [*points[0], 1.0])[0]
    assert expected == pytest.approx(points[0] @ began[:3, 0], abs=1e-9)
    for before, after, (length, _) in zip(points[:-1], points[1:], steps, strict=True):
        T_joint_base = invert(seam_frame(joint, 0.5 * (before + after)))
        np.testing.assert_allclose(T_joint_base @ [*before, 1.0], [expected, 0.0, 0.0, 1.0], atol=1e-6)
        expected += length
        np.testing.assert_allclose(T_joint_base @ [*after, 1.0], [expected, 0.0, 0.0, 1.0], atol=1e-6)


@given(millimetres, millimetres, millimetres, slopes, slopes)
def test_a_seams_frame_is_a_rigid_pose_through_its_station(station, y, z, slope_y, slope_z):
    T = SeamLine(station, y, z, slope_y, slope_z).frame()
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(T @ [station, 0.0, 0.0, 1.0], [station, y, z, 1.0], atol=1e-9)
    # It runs on with the stated slopes, and its cross-section stays level.
    there = (T @ [station + 7.0, 0.0, 0.0, 1.0])[:3] - [station, y, z]
    np.testing.assert_allclose(there[1:], there[0] * np.array([slope_y, slope_z]), atol=1e-9)
    assert T[2, 1] == pytest.approx(0.0, abs=1e-12)


def test_the_nominal_seam_is_no_change():
    np.testing.assert_array_equal(SeamLine().frame(), np.eye(4))


V = scenes.JOINTS["v_groove"].dimensions
CORRUGATION = scenes.JOINTS["corrugation"].dimensions


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("type", {"type": "dovetail"}),
        ("thickness_mm", {"type": "lap", "dimensions": {}}),
        ("thickness_mm", {"type": "lap", "dimensions": {"thickness_mm": 0.0}}),
        ("thickness_mm", {"type": "lap", "dimensions": {"thickness_mm": math.nan}}),
        ("depth_mm", {"type": "v_groove", "dimensions": V | {"depth_mm": -1.0}}),
        ("root_gap_mm", {"type": "v_groove", "dimensions": V | {"root_gap_mm": -0.1}}),
        ("included_angle_deg", {"type": "v_groove", "dimensions": V | {"included_angle_deg": 180.0}}),
        ("width_mm", {"type": "corrugation", "dimensions": CORRUGATION | {"width_mm": 61.0}}),
        ("pitch_mm", {"type": "corrugation", "dimensions": CORRUGATION | {"pitch_mm": 0.0}}),
        ("seam_in_base_mm", {"seam_in_base_mm": ((0.0, 0.0, 0.0),)}),
        ("seam_in_base_mm", {"seam_in_base_mm": ((0.0, 0.0), (1.0, 0.0))}),
        ("seam_in_base_mm", {"seam_in_base_mm": ((5.0, 0.0, 0.0), (5.0, 0.0, 0.0))}),
        ("seam_in_base_mm", {"seam_in_base_mm": ((math.nan, 0.0, 0.0), (5.0, 0.0, 0.0))}),
        ("seam_in_base_mm", {"seam_in_base_mm": ((0.0, 0.0, 0.0), (math.inf, 0.0, 0.0))}),
        ("surface_normal_in_base", {"surface_normal_in_base": (0.0, 0.0, 2.0)}),
        ("surface_normal_in_base", {"surface_normal_in_base": (0.0, 0.0, math.nan)}),
        ("surface_normal_in_base", {"surface_normal_in_base": (1.0, 0.0, 0.0)}),
    ],
)
def test_a_joint_that_cannot_be_names_its_key(key, changes):
    with pytest.raises(ValueError, match=rf"^\[joint\] {key}"):
        dataclasses.replace(scenes.JOINTS["flat"], **changes)


def test_infinite_dimensions_are_refused():
    with pytest.raises(ValueError, match=r"^\[joint\] depth_mm"):
        Joint("v_groove", V | {"depth_mm": math.inf}, STRAIGHT)
