"""Geometry and timing against OpenCV's projection and plane geometry."""

import dataclasses

import cv2
import numpy as np
import pytest
import scenes
from effect_scenes import CONDITIONS, affected, charge, nominal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from noise_model.effects import apply_setup_effects, pose_time_s
from noise_model.surface.joint import seam_frame
from noise_model.transforms import moved
from noise_model.view import View

LASER = CONDITIONS["laser"]


def sharp(joint="flat"):
    return nominal(joint, psf_sigma_px=0.0, width=160, height=120)


def project(camera, T_base_camera, distortion, points_base):
    """(u, v) of points (N, 3) of base by OpenCV."""
    T = np.linalg.inv(T_base_camera)
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    uv, _ = cv2.projectPoints(
        points_base, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], matrix, np.array(distortion)
    )
    return uv[:, 0]


def stripe_rows(image, columns):
    """The stripe's centre by a parabola through the logarithms of its three highest rows."""
    rows = np.argmax(image[:, columns], axis=0)
    low, mid, high = (np.log(image[rows + i, columns]) for i in (-1, 0, 1))
    return rows + 0.5 * (low - high) / (low - 2.0 * mid + high)


def check_stripe(setup, T_base_camera, distortion, points_base, T_base_tool):
    u, v = project(setup.camera, T_base_camera, distortion, points_base).T
    columns = np.arange(15, 145)
    order = np.argsort(u)
    image = charge(setup, LASER, T_base_tool)
    np.testing.assert_allclose(stripe_rows(image, columns), np.interp(columns, u[order], v[order]), atol=0.03)


def on_the_sheet(T_base_tool, normal, point):
    """Points (N, 3) of base where the laser's plane, 35 mm ahead of the tool, meets a plane."""
    y = np.linspace(-40.0, 40.0, 801)
    column, offset = T_base_tool[:3, :3], T_base_tool[:3, 3]
    # Points (35, y, z) of the tool, z so that they lie on the plane.
    base = (column @ np.stack([np.full(801, 35.0), y, np.zeros(801)])).T + offset
    z = ((point - base) @ normal) / (column[:, 2] @ normal)
    return base + z[:, np.newaxis] * column[:, 2]


def test_a_tilted_plate_takes_its_stations_and_ridges_along():
    """Where the joint is not in base's plane its frame would slide along the seam otherwise."""
    low = ((-300.0, 0.0, -150.0), (300.0, 0.0, -150.0))
    setup = nominal("corrugation")
    setup = dataclasses.replace(setup, joint=dataclasses.replace(setup.joint, seam_in_base_mm=low))
    true = apply_setup_effects(affected(setup, surface_tilt={"pitch_deg": 5.0, "roll_deg": 1.0}))
    at = np.array([0.0, 0.0, -150.0])
    turned = moved(seam_frame(setup.joint, at), [1.0, 5.0, 0.0], np.zeros(3))
    np.testing.assert_allclose(seam_frame(true.joint, at), turned, atol=1e-9)


def test_a_camera_off_its_place_sees_the_stripe_elsewhere():
    """The turn is a rotation vector in the camera's own frame, and so is the move."""
    setup = sharp()
    values = {
        "rot_x_deg": 0.5,
        "rot_y_deg": -0.8,
        "rot_z_deg": 1.5,
        "move_x_mm": 0.8,
        "move_y_mm": -1.2,
        "move_z_mm": 2.0,
    }
    T_camera_moved = np.eye(4)
    T_camera_moved[:3, :3] = cv2.Rodrigues(np.radians([0.5, -0.8, 1.5]))[0]
    T_camera_moved[:3, 3] = [0.8, -1.2, 2.0]
    T_base_tool = scenes.pose((4.0, 0.5, 1.0), (3.0, -2.0, 4.0))
    T_base_camera = T_base_tool @ setup.camera.T_tool_camera @ T_camera_moved
    points = on_the_sheet(T_base_tool, np.array([0.0, 0.0, 1.0]), np.zeros(3))
    check_stripe(affected(setup, hand_eye=values), T_base_camera, (0.0,) * 5, points, T_base_tool)


@pytest.mark.parametrize("axis", "xyz")
def test_a_turn_of_the_camera_is_a_shift_of_the_image(axis):
    """0.5 deg about x or y shifts the middle by f tan(0.5 deg), about z it turns the image round it."""
    setup = sharp()
    camera = apply_setup_effects(affected(setup, hand_eye={f"rot_{axis}_deg": 0.5})).camera
    ahead = setup.camera.T_tool_camera @ np.array([0.0, 0.0, 150.0, 1.0])
    aside = setup.camera.T_tool_camera @ np.array([10.0, 0.0, 150.0, 1.0])
    uv = project(setup.camera, camera.T_tool_camera, (0.0,) * 5, np.stack([ahead[:3], aside[:3]]))
    shift = setup.camera.fx * np.tan(np.radians(0.5))
    middle = np.array([79.5, 59.5])
    wanted = {"x": (0.0, shift), "y": (-shift, 0.0), "z": (0.0, 0.0)}[axis]
    np.testing.assert_allclose(uv[0] - middle, wanted, atol=1e-6)
    if axis == "z":
        reach = setup.camera.fx * 10.0 / 150.0
        turned = reach * np.array([np.cos(np.radians(0.5)), -np.sin(np.radians(0.5))])
        np.testing.assert_allclose(uv[1] - middle, turned, atol=1e-6)


@settings(max_examples=25)
@given(st.floats(-15.0, 15.0), st.floats(-15.0, 15.0), st.floats(-30.0, 30.0), st.floats(-40.0, 40.0))
def test_a_tilted_plate_is_a_plane_through_its_origin(roll_deg, pitch_deg, heading_deg, y_mm):
    """Its normal is turned by the rotation vector (roll, pitch, 0) of the joint's axes."""
    heading = np.radians(heading_deg)
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    left = np.array([-along[1], along[0], 0.0])
    setup = sharp()
    line = [tuple(float(x) for x in y_mm * left + s * along) for s in (-300.0, 300.0)]
    joint = dataclasses.replace(setup.joint, seam_in_base_mm=tuple(line))
    setup = dataclasses.replace(setup, joint=joint)
    tilted = apply_setup_effects(affected(setup, surface_tilt={"roll_deg": roll_deg, "pitch_deg": pitch_deg}))
    turn = Rotation.from_rotvec(np.radians(roll_deg) * along + np.radians(pitch_deg) * left)
    origin = y_mm * left
    normal = turn.apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(tilted.joint.surface_normal_in_base, normal, atol=1e-12)
    for before, after in zip(line, tilted.joint.seam_in_base_mm, strict=True):
        np.testing.assert_allclose(after, origin + turn.apply(np.array(before) - origin), atol=1e-9)


def test_the_camera_sees_the_tilted_plane():
    """Distances along the rays are those of a plane; the stripe lies where the sheet meets it."""
    setup = affected(sharp(), surface_tilt={"roll_deg": 4.0, "pitch_deg": -3.0})
    T_base_tool = scenes.pose((4.0, 0.5, 1.0))
    normal = Rotation.from_rotvec([4.0, -3.0, 0.0], degrees=True).apply([0.0, 0.0, 1.0])
    T_base_camera = T_base_tool @ setup.camera.T_tool_camera
    view = View.of(apply_setup_effects(setup), T_base_tool)
    v, u = np.mgrid[:120, :160]
    camera = setup.camera
    d = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    d_base = d @ T_base_camera[:3, :3].T
    wanted = -(T_base_camera[:3, 3] @ normal) / (d_base @ normal)
    np.testing.assert_allclose(view.distance_mm, wanted, rtol=1e-5)
    points = on_the_sheet(T_base_tool, normal, np.zeros(3))
    check_stripe(setup, T_base_camera, (0.0,) * 5, points, T_base_tool)


def test_a_distorted_lens_shows_the_stripe_where_opencv_does():
    setup = sharp()
    stated = (0.05, 0.0, 0.001, 0.0, 0.3)
    setup = dataclasses.replace(setup, camera=dataclasses.replace(setup.camera, distortion=stated))
    values = {"k1": -0.8, "k2": 2.0, "p1": 0.004, "p2": -0.003}
    points = on_the_sheet(np.eye(4), np.array([0.0, 0.0, 1.0]), np.zeros(3))
    check_stripe(
        affected(setup, lens_distortion=values),
        setup.camera.T_tool_camera,
        (-0.75, 2.0, 0.005, -0.003, 0.3),
        points,
        np.eye(4),
    )


def test_a_late_clock_shows_the_pose_of_another_time():
    """A tool at 10 mm/s and 50 ms of delay: a frame of 3 s was taken where the stamps say 3.05 s."""
    setup = affected(nominal(), pose_delay={"delay_s": 0.05})
    x_mm = 10.0 * pose_time_s(setup, 3.0)
    assert x_mm - 10.0 * pose_time_s(nominal(), 3.0) == pytest.approx(0.5)
    # The clock alone: a frame's own pose and time are predicted alike.
    np.testing.assert_array_equal(charge(setup, LASER), charge(nominal(), LASER))
