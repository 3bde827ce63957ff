import dataclasses
import math

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st
from sheet_twin import irradiance

from noise_model.instrument.laser import (
    Laser,
    plane_in,
    plane_met,
    sheet_in_tool,
    sheet_of,
    sheet_reflected,
    tangent_plane,
)
from noise_model.surface.brdf import TABLE_1, lobe_numbers
from noise_model.transforms import pose_matrix, transform

LASER = scenes.setup("flat").laser
UP = np.array([[0.0, 0.0, 1.0]])


def one(point, normal=(0.0, 0.0, 1.0), laser=LASER):
    return float(irradiance(np.array([point]), np.array([normal]), laser)[0])


@given(
    st.floats(-1.5, 1.5),
    st.floats(-40.0, 40.0),
    st.floats(-20.0, 60.0),
    st.floats(-0.9, 0.9),
    st.floats(-0.9, 0.9),
)
def test_the_sheet_as_recording_md_states_it(across, y, z, lean_x, lean_y):
    """In angles: psi of the ray to the axis, theta_i to the normal."""
    point, origin = np.array([35.0 + across, y, z]), np.array([35.0, 0.0, 140.0])
    normal = np.array([lean_x, lean_y, 1.0]) / math.sqrt(1.0 + lean_x**2 + lean_y**2)
    depth = 140.0 - z
    ray = point - origin
    psi = math.atan2(math.hypot(ray[0], ray[1]), depth)
    theta_i = math.acos(max(-1.0, min(1.0, float(-ray @ normal) / float(np.linalg.norm(ray)))))
    sigma = 0.45 * depth / 140.0
    want = 0.0
    if theta_i < math.pi / 2.0:
        fall_off = (140.0 / depth) ** 2 * math.cos(theta_i) / math.cos(psi)
        want = math.exp(-((across / sigma) ** 2) / 2.0) * fall_off
    assert one(point, normal) == pytest.approx(want, rel=1e-9, abs=1e-12)


def test_it_is_one_all_along_a_level_plate_at_tool_height():
    y = np.linspace(-30.0, 30.0, 7)
    points = np.column_stack([np.full(7, 35.0), y, np.zeros(7)])
    np.testing.assert_allclose(irradiance(points, np.broadcast_to(UP, (7, 3)), LASER), 1.0)


def test_by_hand():
    assert one((35.45, 0.0, 0.0)) == pytest.approx(math.exp(-0.5))
    # Half way up the sheet is half as wide and four times as bright.
    assert one((35.0, 0.0, 70.0)) == pytest.approx(4.0)
    assert one((35.225, 0.0, 70.0)) == pytest.approx(4.0 * math.exp(-0.5))
    # A face that leans by 60 degrees takes half of it.
    assert one((35.0, 0.0, 0.0), (0.0, math.sqrt(0.75), 0.5)) == pytest.approx(0.5)


def test_a_leaning_sheet():
    lean = math.radians(20.0)
    normal = (math.cos(lean), 0.0, math.sin(lean))
    d = -(normal[0] * 35.0 + normal[2] * 140.0)
    laser = dataclasses.replace(LASER, plane_in_tool=(*normal, d))
    on_sheet = (35.0 + 140.0 * math.tan(lean), 0.0, 0.0)
    beside = (on_sheet[0] + 0.45 / math.cos(lean), 0.0, 0.0)
    # cos(theta_i) is cos(psi) on a level plate, however far the ray leans.
    assert one(on_sheet, laser=laser) == pytest.approx(1.0)
    assert one(beside, laser=laser) == pytest.approx(math.exp(-0.5))


@given(st.floats(-60.0, 60.0), st.floats(20.0, 200.0), st.floats(-0.4, 0.4), st.floats(-40.0, 40.0))
def test_the_fan_ends_at_its_angle_in_the_sheet(angle_deg, along_mm, beside_mm, lean_deg):
    """A ray at an angle from the sheet's steepest line is lit as without an end, or not at all."""
    lean, angle = math.radians(lean_deg), math.radians(angle_deg)
    normal = np.array([math.cos(lean), 0.0, math.sin(lean)])
    steepest, level = np.array([math.sin(lean), 0.0, -math.cos(lean)]), np.array([0.0, 1.0, 0.0])
    origin = np.array([35.0, 0.0, 140.0])
    wide = dataclasses.replace(LASER, plane_in_tool=(*normal.tolist(), -float(normal @ origin)))
    narrow = dataclasses.replace(wide, fan_half_angle_deg=25.0)
    point = origin + along_mm * (steepest + math.tan(angle) * level) + beside_mm * normal
    # An array and a tuple, as where a view's stripe is drawn: else it would be compiled once more.
    upward, toward_eye = np.array([0.0, 0.0, 1.0]), (0.0, 0.0, 1.0)
    seen = [
        sheet_reflected(
            sheet_of(laser, np.eye(4)), lobe_numbers(TABLE_1["zn_coated"]), point, upward, toward_eye
        )
        for laser in (wide, narrow)
    ]
    lit = abs(angle_deg) <= 25.0 - 1e-9
    if lit or abs(angle_deg) >= 25.0 + 1e-9:
        assert one(point, laser=narrow) == (one(point, laser=wide) if lit else 0.0)
        assert seen[1] == (seen[0] if lit else 0.0)


@pytest.mark.parametrize(
    ("point", "normal"),
    [
        ((35.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
        ((35.0, 0.0, 150.0), (0.0, 0.0, -1.0)),
        ((35.0, 0.0, 140.0), (0.0, 0.0, 1.0)),
    ],
)
def test_dark_from_behind_and_above(point, normal):
    assert one(point, normal) == 0.0


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("wavelength_nm", 0.0),
        ("stripe_sigma_mm", -0.1),
        ("peak_e", math.nan),
        ("origin_in_tool_mm", (35.0, 0.0, 0.0)),
        ("origin_in_tool_mm", (35.0, 0.0, -140.0)),
        ("plane_in_tool", (2.0, 0.0, 0.0, -35.0)),
        ("plane_in_tool", (0.0, 0.0, 0.0, -35.0)),
        ("plane_in_tool", (0.0, 0.0, 1.0, -35.0)),
        ("plane_in_tool", (math.nan, 0.0, 0.0, -35.0)),
        ("plane_in_tool", (1.0, 0.0, 0.0, math.nan)),
        ("fan_half_angle_deg", 0.0),
        ("fan_half_angle_deg", 90.0),
        ("fan_half_angle_deg", math.nan),
        ("bow", 0.6),
        ("bow", math.nan),
    ],
)
def test_a_laser_that_cannot_be_names_its_key(key, value):
    with pytest.raises(ValueError, match=rf"^\[laser\] {key}"):
        dataclasses.replace(LASER, **{key: value})


def test_a_laser_is_what_it_was_told():
    assert Laser(690.0, (1.0, 0.0, 0.0, -35.0), (35.0, 0.0, 140.0), 0.45, 5000.0) == LASER


def test_a_planes_points_lie_on_it_in_another_frame():
    T_a_b = pose_matrix((3.0, -7.0, 11.0), (0.1, -0.3, 0.3, 0.9))
    normal = np.array([0.6, 0.0, 0.8])
    points_b = -5.0 * normal + np.outer([1.0, -4.0, 9.0], [0.8, 2.0, -0.6])
    plane_a = np.array(plane_in(T_a_b, np.array([*normal, 5.0])))
    np.testing.assert_allclose(transform(T_a_b, points_b) @ plane_a[:3] + plane_a[3], 0.0, atol=1e-12)
    np.testing.assert_allclose(plane_a[:3], T_a_b[:3, :3] @ normal, atol=1e-12)


@pytest.mark.parametrize("lean_deg", [0.0, 20.0, -40.0])
def test_the_point_below_the_laser_lies_on_its_plane_at_tool_height(lean_deg):
    lean, turn = np.radians([lean_deg, 7.0])
    normal = np.array([np.cos(lean) * np.cos(turn), np.cos(lean) * np.sin(turn), np.sin(lean)])
    laser = dataclasses.replace(LASER, plane_in_tool=(*normal.tolist(), -35.0 * normal[0]))
    point = laser.point_mm
    assert point @ normal + laser.plane[3] == pytest.approx(0.0, abs=1e-12)
    assert point[2] == 0.0
    below = np.array([*laser.origin_in_tool_mm[:2], 0.0])
    np.testing.assert_allclose(np.cross(point - below, [*normal[:2], 0.0]), 0.0, atol=1e-12)


BOWED = dataclasses.replace(LASER, plane_in_tool=(0.96, 0.0, 0.28, -72.8), bow=0.15)


def test_a_bowed_sheet_is_a_cone_about_its_origin():
    """Sideways on a plate it leaves its plane by a parabola; it holds whole rays of the laser."""
    level = BOWED.point_mm + np.outer(np.linspace(-60.0, 60.0, 7), [0.0, 1.0, 0.0])
    np.testing.assert_allclose(BOWED.off_mm(level), -0.15 * level[:, 1] ** 2 / 140.0, atol=1e-12)
    on = [35.0, 0.0, 140.0] + 140.0 * np.array([0.0, 0.5, -1.0])
    on[0] -= float(BOWED.off_mm(on)) / 0.96
    along = BOWED.origin_mm + np.outer([0.3, 1.0, 2.0], on - BOWED.origin_mm)
    np.testing.assert_allclose(BOWED.off_mm(along), 0.0, atol=1e-12)


@given(st.floats(-0.5, 0.5), st.floats(-0.6, 0.6), st.floats(-30.0, 30.0), st.floats(-0.2, 0.2))
def test_a_ray_meets_a_bowed_sheet(x, y, height_mm, bow):
    laser = dataclasses.replace(BOWED, bow=bow)
    sheet, eye, way = (
        sheet_in_tool(laser),
        np.array([-60.0, 5.0, 150.0 + height_mm]),
        np.array([x + 0.8, y, -1.0]),
    )
    *normal, d = plane_met(sheet, eye, way)
    met = eye - (normal @ eye + d) / (normal @ way) * way
    assert float(laser.off_mm(met)) == pytest.approx(0.0, abs=1e-3)
    touching = tangent_plane(sheet, met)
    np.testing.assert_allclose(touching[:3], laser.normals(met[np.newaxis])[0], atol=1e-12)
    gradient = [(laser.off_mm(met + step) - laser.off_mm(met - step)) / 2e-3 for step in 1e-3 * np.eye(3)]
    np.testing.assert_allclose(touching[:3], gradient, atol=1e-6)


def test_a_bowed_sheet_stays_where_it_is_in_another_frame():
    T = pose_matrix((4.0, -3.0, 6.0), (0.01, 0.0, 0.01, 1.0))
    moved, y = BOWED.in_frame(T), np.linspace(-40.0, 40.0, 9)
    points = np.column_stack([np.full(9, 75.0), y, np.zeros(9)])
    for _ in range(3):
        points[:, 0] -= BOWED.off_mm(points) / BOWED.normals(points)[:, 0]
    plane_alone = dataclasses.replace(dataclasses.replace(BOWED, bow=0.0).in_frame(T), bow=BOWED.bow)
    assert np.abs(plane_alone.off_mm(transform(T, points))).max() > 0.1
    # A turned fan's cone is no longer even about its axis, which is of third order in the fan's angle.
    np.testing.assert_allclose(moved.off_mm(transform(T, points)), 0.0, atol=0.03)
