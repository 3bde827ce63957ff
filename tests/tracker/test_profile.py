"""Triangulation against points put into the laser plane by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from rendered import pose_at, small_setup

from noise_model.arc.scene import make_scene
from noise_model.surface.joint import SeamLine
from noise_model.transforms import invert, transform
from tracker.geometry import SensorGeometry, to_laser_plane
from tracker.profile import StripeLines, edge_lines, measured_points, triangulate
from tracker.stripe.askew import askew_sigma_px
from tracker.stripe.edge import clear_lines

DISTORTION = (-0.12, 0.03, 0.001, -0.002, 0.0)


def distorted(upright: bool) -> SensorGeometry:
    setup = small_setup("v_groove", upright=upright)
    return SensorGeometry.of(replace(setup, camera=replace(setup.camera, distortion=DISTORTION)))


@pytest.mark.parametrize("upright", [False, True])
def test_points_of_the_sheet_come_back(upright: bool) -> None:
    geometry = distorted(upright)
    y, z = np.meshgrid(np.linspace(-8.0, 8.0, 9), np.linspace(-5.0, 3.0, 5))
    points_tool = np.column_stack([np.full(y.size, 35.0), y.ravel(), z.ravel()])
    camera = geometry.setup.camera
    found, _ = to_laser_plane(
        geometry.setup, camera.project(transform(invert(camera.T_tool_camera), points_tool))
    )
    np.testing.assert_allclose(found, points_tool, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("upright", [False, True])
def test_a_profile_lies_on_its_surface_and_knows_how_it_moves(upright: bool) -> None:
    geometry = distorted(upright)
    seam = SeamLine(0.0, 1.5, 0.7, 0.02, -0.01)
    scene = make_scene(geometry.setup, pose_at(11.0, 2.0, -1.0, (2.0, -1.0, 5.0)).T_base_tool, seam)
    scan = np.arange(geometry.n_scan, dtype=float)
    position = np.full(geometry.n_scan, np.nan)
    y_true = np.full(geometry.n_scan, np.nan)
    # Walk the plate beside the groove: where the sheet meets z = 0 of the seam's frame.
    plane = np.asarray(geometry.setup.laser.plane_in_tool)
    R, t = scene.T_joint_tool[:3, :3], scene.T_joint_tool[:3, 3]
    normal, d = R @ plane[:3], plane[3] - R @ plane[:3] @ t
    y = np.linspace(-30.0, 30.0, 3001)
    points_joint = np.column_stack([-(normal[1] * y + d) / normal[0], y, np.zeros_like(y)])
    camera = geometry.setup.camera
    T_camera_joint = invert(scene.T_joint_camera)
    at = geometry.scan_points(camera.project(transform(T_camera_joint, points_joint)))
    order = np.argsort(at[:, 0])
    position[:] = np.interp(scan, at[order, 0], at[order, 1], left=np.nan, right=np.nan)
    y_true[:] = np.interp(scan, at[order, 0], y[order])
    position[7] = np.nan
    profile = triangulate(geometry, scene, position, *np.full((2, geometry.n_scan), 0.1))
    assert 7 not in profile.scan
    assert len(profile.y_mm) == np.isfinite(position).sum()
    assert (np.diff(profile.y_mm) > 0.0).all()
    np.testing.assert_allclose(profile.z_mm, 0.0, atol=2e-3)
    np.testing.assert_allclose(profile.y_mm, y_true[profile.scan.astype(int)], atol=2e-3)
    assert profile.column_mm == pytest.approx(np.median(np.abs(np.diff(y_true))), rel=0.05)
    moved = triangulate(geometry, scene, position + 0.01, *np.full((2, geometry.n_scan), 0.1))
    np.testing.assert_allclose((moved.z_mm - profile.z_mm) / 0.01, profile.dz_mm, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose((moved.y_mm - profile.y_mm) / 0.01, profile.dy_mm, rtol=1e-3, atol=1e-5)


def test_a_single_point_has_no_spacing() -> None:
    geometry = distorted(False)
    position = np.full(geometry.n_scan, np.nan)
    position[5] = 100.0
    profile = triangulate(
        geometry, make_scene(geometry.setup, np.eye(4)), position, *np.ones((2, geometry.n_scan))
    )
    assert len(profile.y_mm) == 1
    assert np.isnan(profile.column_mm)


def test_rays_that_run_away_from_the_sheet_are_nan() -> None:
    geometry = SensorGeometry.of(small_setup("v_groove"))
    points, _ = to_laser_plane(geometry.setup, np.array([[160.0, -1e5], [160.0, 120.0], [160.0, 1e5]]))
    assert np.isfinite(points[1]).all()
    assert np.isnan(points).any()


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("scattered_px", [0.0, 40.0])
def test_a_stripes_points_are_its_triangulation_with_bias_and_steps_taken_in(
    upright: bool, scattered_px: float
) -> None:
    """Points that lie out of order are sorted as well."""
    geometry, rng = distorted(upright), np.random.default_rng(3)
    scene = make_scene(geometry.setup, pose_at(11.0, 2.0, -1.0, (2.0, -1.0, 5.0)).T_base_tool)
    n = geometry.n_scan
    position = 0.5 * geometry.n_pos + rng.normal(0.0, 0.3 + scattered_px, n)
    position[rng.random(n) < 0.2] = np.nan
    sigma, beside, width, bias, misfit = rng.uniform(0.1, 3.0, (5, n))
    amplitude = np.where(np.arange(n) < n // 2, 900.0, 300.0) * rng.uniform(0.95, 1.05, n)
    lines = StripeLines(position, sigma, beside, amplitude, width, bias, misfit, np.ones(n, np.int64))
    points = measured_points(geometry.stripe_source, scene, lines, 0.05, -2.0, 0.03)
    over = edge_lines(geometry.stripe_source, scene, -2.0, 0.03)
    askew = askew_sigma_px(amplitude, width, 0.05, over.possible)
    assert askew.any()
    twin = triangulate(geometry, scene, position - bias, np.hypot(sigma, askew), np.hypot(beside, askew))
    own = twin.scan.astype(int)
    rows = twin.y_mm, twin.z_mm, twin.dy_mm, twin.dz_mm, twin.sigma_px, twin.beside_px, bias[own], misfit[own]
    found = points.y_mm, points.z_mm, points.dy_mm, points.dz_mm, points.sigma_px
    found = *found, points.beside_px, points.bias_px, points.misfit_px
    np.testing.assert_array_equal(points.scan, twin.scan)
    np.testing.assert_allclose(np.array(found), np.array(rows), rtol=1e-12)
    assert points.column_mm == pytest.approx(twin.column_mm)
    assert points.sheet_lines == over.stated
    clear = clear_lines(geometry.setup.camera.psf_sigma_px, over.stated)
    assert points.mixed_mm == pytest.approx(twin.column_mm * (clear - 1))


def test_two_lines_read_as_one_are_one_point_between_them() -> None:
    geometry = distorted(False)
    scene = make_scene(geometry.setup, pose_at(11.0, 2.0, -1.0, (2.0, -1.0, 5.0)).T_base_tool)
    n = geometry.n_scan
    position, ones = 0.5 * geometry.n_pos + 0.3 * np.arange(n), np.ones(n)
    sigma, beside, nothing = 0.1 * ones, 0.3 * ones, np.zeros(n)
    n_lines = np.where((np.arange(n) >= 60) & (np.arange(n) < 100), 2, 1)
    points = measured_points(
        geometry.stripe_source,
        scene,
        StripeLines(position, sigma, beside, 900.0 * ones, 3.0 * ones, nothing, nothing, n_lines),
        0.05,
        -2.0,
        0.03,
    )
    assert len(points.scan) == n - 20
    pairs = points.n_lines == 2.0
    np.testing.assert_array_equal(np.sort(points.scan[pairs]), np.arange(60.5, 100.0, 2.0))
    each = triangulate(geometry, scene, position, sigma, beside)
    for name in ("y_mm", "z_mm", "dy_mm", "dz_mm"):
        order = np.argsort(each.scan)
        twin = np.interp(points.scan, each.scan[order], getattr(each, name)[order])
        np.testing.assert_allclose(getattr(points, name), twin, rtol=1e-4, atol=1e-4)
    # A stripe's spacing is that of its lines.
    assert points.column_mm == pytest.approx(each.column_mm, rel=0.02)
    np.testing.assert_allclose(points.sigma_px, 0.1)
    np.testing.assert_allclose(points.beside_px, np.where(pairs, 0.3 / math.sqrt(2.0), 0.3))


@pytest.mark.parametrize("upright", [False, True])
def test_an_edge_is_spread_over_the_lines_that_its_ends_are_seen_in(upright: bool) -> None:
    geometry, z_mm, slope_sigma = distorted(upright), -2.0, 0.03
    scene = make_scene(geometry.setup, pose_at(11.0, 2.0, -1.0, (2.0, -1.0, 5.0)).T_base_tool)
    laser, camera = geometry.setup.laser, geometry.setup.camera
    normal = scene.T_joint_tool[:3, :3] @ laser.plane[:3]
    d = laser.plane[3] - normal @ scene.T_joint_tool[:3, 3]
    x, along = -(normal[2] * z_mm + d) / normal[0], laser.stripe_sigma_mm / normal[0]
    ends = np.array([[x - along, 0, z_mm], [x + along, 0, z_mm], [x, -slope_sigma * along, z_mm]])
    ends = np.vstack([ends, [x, slope_sigma * along, z_mm]])
    scan = geometry.scan_points(camera.project(transform(invert(scene.T_joint_camera), ends)))[:, 0]
    stated, turned = abs(scan[1] - scan[0]) / 2.0, abs(scan[3] - scan[2]) / 2.0
    found = edge_lines(geometry.stripe_source, scene, z_mm, slope_sigma)
    assert found == pytest.approx((stated, np.hypot(stated, turned)), rel=1e-6)
