"""Pixels of many scenes in one call: they see what each scene shows on its own."""

import dataclasses

import numpy as np
import pytest
import scenes
from sheet_twin import beyond_fan_mm

from arctrack.nominal import nominal_setup
from noise_model.arc.map import arc_at, arc_kernel
from noise_model.arc.scene import Scenes, make_scene
from noise_model.forward import look
from noise_model.instrument.camera import Rays
from noise_model.instrument.laser import sheet_of, sheets_of
from noise_model.surface.joint import BentSeam, SeamLine
from noise_model.surface.ray_casting import MISS, ways_are_open
from noise_model.transforms import invert, transform
from noise_model.view import View

POSES = (scenes.pose(), scenes.pose((7.0, -1.0, 1.0), (1.0, -2.0, 3.0)), scenes.pose((40.0, 0.5, -0.5)))
LINES = (SeamLine(25.0, -0.8, 0.1, 0.03), SeamLine(45.0, 0.6, -0.1, -0.02, 0.01))
BENT = BentSeam(LINES, SeamLine(0.0, 0.3, 0.1))


def alone(setup, poses=POSES):
    rays = Rays.of(setup.camera)
    return [look(setup, T_base_tool, BENT, rays, np.arange(rays.cos4.size)).bent for T_base_tool in poses]


def together(setup):
    rays = Rays.of(setup.camera)
    pixels = np.tile(np.arange(rays.cos4.size), len(POSES))
    pose = np.repeat(np.arange(len(POSES)), rays.cos4.size)
    return View.along(setup, POSES, [BENT] * len(POSES), pose, rays.at(pixels))


@pytest.mark.parametrize("joint", ["v_groove", "lap", "corrugation"])
def test_many_scenes_show_what_each_of_them_shows(joint):
    setup = nominal_setup(joint, "mild_steel", width=48, height=36)
    parts, every = alone(setup), together(setup)
    assert len(every.scenes) == len(POSES) * len(LINES)
    unit_e, start = 1000.0, 0
    arc_e, laser_e, (points, _, faces) = every.arc_e(), every.laser_e(unit_e), every.surface
    for view in parts:
        of_frame = slice(start, start + len(view.which))
        np.testing.assert_array_equal(laser_e[of_frame], view.laser_e(unit_e))
        np.testing.assert_array_equal(points[of_frame], view.surface[0])
        for n in range(len(LINES)):
            kernel = arc_kernel(setup, view.scenes[n])
            mean_e, shown = arc_at(kernel, view.rays.xy, view.rays.cos4, np.flatnonzero(view.which == n))
            here = np.flatnonzero(view.which == n) + start
            np.testing.assert_array_equal(faces[here], shown)
            np.testing.assert_allclose(arc_e[here], np.where(shown == MISS, 0.0, mean_e), rtol=1e-6)
        start = of_frame.stop
    assert arc_e.max() > 0.0
    assert laser_e.max() > 0.0


def test_a_frame_shows_what_its_pixels_show_in_a_row():
    setup = nominal_setup("lap", "mild_steel", width=48, height=36)
    frame, row = View.of(setup, POSES[0]), View.of(setup, POSES[0], pixels=np.arange(48 * 36))
    assert (frame.shape, row.shape) == ((36, 48), (48 * 36,))
    assert (frame.is_frame, row.is_frame) == (True, False)
    for of_frame, of_row in zip((*frame.surface, *frame.sheet), (*row.surface, *row.sheet), strict=True):
        np.testing.assert_array_equal(of_frame.reshape(of_row.shape), of_row)
    np.testing.assert_array_equal(frame.arc_e().ravel(), row.arc_e())
    np.testing.assert_array_equal(frame.laser_e(1000.0).ravel(), row.laser_e(1000.0))
    np.testing.assert_array_equal(frame.rays.uv_px[7, 11], (11.0, 7.0))


def test_some_pixels_show_what_all_show():
    (view,) = alone(nominal_setup("lap", "mild_steel", width=48, height=36), POSES[:1])
    chosen = np.arange(len(view.which)) % 3 == 0
    np.testing.assert_array_equal(view.subset(chosen).arc_e(), view.arc_e()[chosen])
    assert view.arc_e().any()


def test_sheets_of_many_scenes_are_those_of_each():
    setup = nominal_setup("lap", "mild_steel", width=16, height=12)
    stacked = together(setup).scenes
    sheets = sheets_of(setup.laser, stacked.T_joint_tool)
    for n in range(len(stacked)):
        sheet = sheet_of(setup.laser, stacked[n].T_joint_tool)
        for name in ("origin", "plane", "tool_up", "axis", "side"):
            np.testing.assert_allclose(getattr(sheets, name)[n], getattr(sheet, name), rtol=1e-12, atol=1e-12)
        assert stacked.below_surface[n] == stacked[n].below_surface


@pytest.mark.parametrize("half_angle_deg", [None, 24.0])
def test_the_sheet_is_seen_where_the_tools_frame_has_it(half_angle_deg):
    setup = nominal_setup("lap", "mild_steel", width=160, height=120)
    laser = dataclasses.replace(
        setup.laser, origin_in_tool_mm=(35.0, -60.0, 140.0), fan_half_angle_deg=half_angle_deg
    )
    view = together(dataclasses.replace(setup, laser=laser))
    points = view.surface[0]
    near, shaded = np.zeros((2, len(points)), dtype=bool)
    for n in range(len(view.scenes)):
        scene, here = view.scenes[n], np.flatnonzero(view.which == n)
        in_tool = transform(invert(scene.T_joint_tool), points[here])
        sigmas = laser.reach_sigmas * laser.stripe_sigma_mm * np.abs(140.0 - in_tool[:, 2]) / 140.0
        near[here] = np.abs(in_tool @ laser.plane[:3] + laser.plane[3]) < sigmas
        origin, is_free = transform(scene.T_joint_tool, laser.origin_mm), np.zeros(len(here), dtype=bool)
        ways_are_open(points[here], origin, scene.shape.vertices, scene.shape.corrugation, is_free)
        shaded[here] = near[here] & (~is_free | (beyond_fan_mm(in_tool, laser) > 0.0))
    np.testing.assert_array_equal(view.sheet.near, near)
    np.testing.assert_array_equal(view.sheet.shaded, shaded)
    assert near.any()
    assert shaded.any()


def test_a_camera_under_the_sheet_is_refused_among_others():
    setup = nominal_setup("lap", "mild_steel", width=16, height=12)
    low = make_scene(setup, scenes.pose((0.0, 0.0, -500.0)))
    view = alone(setup)[0]
    stretches = view.scenes
    assert low.below_surface
    sunk = Scenes.of([stretches[n] for n in range(len(stretches) - 1)] + [low])
    with pytest.raises(ValueError, match="below the surface"):
        dataclasses.replace(view, scenes=sunk, _cache={}).arc_e()
