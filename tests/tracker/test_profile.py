"""Triangulation against points put into the laser plane by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from rendered import pose_at, small_setup
from scipy.optimize import brentq

from noise_model.arc.scene import Scene, make_scene
from noise_model.compiled.arrays import Float64
from noise_model.compiled.ordering import stable_order
from noise_model.instrument.laser import sheet_in
from noise_model.surface.faces import ridge
from noise_model.surface.joint import SeamLine
from noise_model.transforms import invert, transform
from tracker.geometry import SensorGeometry, to_laser_plane
from tracker.profile import EdgeAlongSeam, edge_lines, lines_of, skewed_sigma_px, triangulate
from tracker.state import (
    AMPLITUDE_E,
    BESIDE_PX,
    DY_MM,
    DZ_MM,
    MISFIT_PX,
    N_LINES,
    SCAN,
    SIGMA_PX,
    WIDTH_PX,
    Y_MM,
    Z_MM,
    Stripe,
)
from tracker.stripe.edge import clear_lines
from tracker.stripe.light import EdgeLines

DISTORTION = (-0.12, 0.03, 0.001, -0.002, 0.0)


def distorted(upright: bool, bow: float = 0.0) -> SensorGeometry:
    setup = small_setup("v_groove", upright=upright)
    setup = replace(setup, laser=replace(setup.laser, bow=bow))
    return SensorGeometry.of(replace(setup, camera=replace(setup.camera, distortion=DISTORTION)))


@pytest.mark.parametrize("bow", [0.0, 0.15])
@pytest.mark.parametrize("upright", [False, True])
def test_points_of_the_sheet_come_back(upright: bool, bow: float) -> None:
    geometry = distorted(upright, bow)
    y, z = (each.ravel() for each in np.meshgrid(np.linspace(-8.0, 8.0, 9), np.linspace(-5.0, 3.0, 5)))
    points_tool = np.column_stack([35.0 + bow * y**2 / (140.0 - z), y, z])
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
    points, column_mm = triangulated(geometry, scene, position)
    scan = points[SCAN]
    assert 7 not in scan
    assert points.shape[1] == np.isfinite(position).sum()
    assert (np.diff(points[Y_MM]) > 0.0).all()
    np.testing.assert_allclose(points[Z_MM], 0.0, atol=2e-3)
    np.testing.assert_allclose(points[Y_MM], y_true[scan.astype(int)], atol=2e-3)
    assert column_mm == pytest.approx(np.median(np.abs(np.diff(y_true))), rel=0.05)
    moved, _ = triangulated(geometry, scene, position + 0.01)
    np.testing.assert_allclose((moved[Z_MM] - points[Z_MM]) / 0.01, points[DZ_MM], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose((moved[Y_MM] - points[Y_MM]) / 0.01, points[DY_MM], rtol=1e-3, atol=1e-5)


def stripe_at(position: Float64, sigma: Float64, beside: Float64) -> Stripe:
    return Stripe(position, sigma, sigma, np.zeros(len(sigma), bool), True, beside)


def triangulated(geometry: SensorGeometry, scene: Scene, position: Float64) -> tuple[Float64, float]:
    sigma = np.full(len(position), 0.1)
    lines = lines_of(stripe_at(position, sigma, sigma), np.zeros(len(position)))
    return triangulate(geometry.stripe_source, scene, lines)[:2]


def test_a_single_point_has_no_spacing() -> None:
    geometry = distorted(False)
    position = np.full(geometry.n_scan, np.nan)
    position[5] = 100.0
    points, column_mm = triangulated(geometry, make_scene(geometry.setup, np.eye(4)), position)
    assert points.shape[1] == 1
    assert np.isnan(column_mm)


def test_rays_that_run_away_from_the_sheet_are_nan() -> None:
    geometry = SensorGeometry.of(small_setup("v_groove"))
    points, _ = to_laser_plane(geometry.setup, np.array([[160.0, -1e5], [160.0, 120.0], [160.0, 1e5]]))
    assert np.isfinite(points[1]).all()
    assert np.isnan(points).any()


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("scattered_px", [0.0, 40.0])
def test_a_stripes_points_lie_where_its_corrected_centres_meet_the_sheet(
    upright: bool, scattered_px: float
) -> None:
    """Points that lie out of order are sorted as well."""
    geometry, rng = distorted(upright), np.random.default_rng(3)
    scene = make_scene(geometry.setup, pose_at(11.0, 2.0, -1.0, (2.0, -1.0, 5.0)).T_base_tool)
    n = geometry.n_scan
    position = 0.5 * geometry.n_pos + rng.normal(0.0, 0.3 + scattered_px, n)
    position[rng.random(n) < 0.2] = np.nan
    sigma, beside, bias, misfit, width = rng.uniform(0.1, 3.0, (5, n))
    amplitude = np.where(np.arange(n) < n // 2, 900.0, 300.0) * rng.uniform(0.95, 1.05, n)
    lines = lines_of(stripe_at(position, sigma, beside), bias)
    lines[AMPLITUDE_E], lines[WIDTH_PX], lines[MISFIT_PX] = amplitude, width, misfit
    edge = EdgeAlongSeam(-2.0, 0.03, 0.05)
    points, _, crossed, mixed_lines = triangulate(geometry.stripe_source, scene, lines, edge)
    own = points[SCAN].astype(int)
    np.testing.assert_array_equal(np.sort(own), np.flatnonzero(np.isfinite(position)))
    assert (np.diff(points[Y_MM]) >= 0.0).all()
    centres = geometry.image_points(points[SCAN], (position - bias)[own])
    there = transform(scene.T_joint_tool, to_laser_plane(geometry.setup, centres)[0])
    np.testing.assert_allclose(points[[Y_MM, Z_MM]], there[:, 1:].T, atol=1e-6)
    over = lines_over(geometry, scene, edge)
    assert crossed == over
    assert mixed_lines == clear_lines(geometry.setup.camera.psf_sigma_px, over.stated) - 1
    possible = math.hypot(over.stated, over.turned)
    skewed = skewed_sigma_px(amplitude, width, edge.contrast, possible)
    assert skewed.any()
    rows = np.array([np.hypot(sigma, skewed), np.hypot(beside, skewed), bias, misfit, np.ones(n)])
    np.testing.assert_allclose(points[SIGMA_PX:], rows[:, own], rtol=1e-12)


def lines_over(geometry: SensorGeometry, scene: Scene, edge: EdgeAlongSeam) -> EdgeLines:
    source = geometry.stripe_source
    found: EdgeLines = edge_lines(
        source.lens,
        source.along_rows,
        scene.T_joint_camera,
        sheet_in(scene.T_joint_tool, source.sheet),
        edge,
        scene.shape.corrugation,
    )
    return found


def test_two_lines_read_as_one_are_one_point_between_them() -> None:
    geometry = distorted(False)
    scene = make_scene(geometry.setup, pose_at(11.0, 2.0, -1.0, (2.0, -1.0, 5.0)).T_base_tool)
    n = geometry.n_scan
    position, ones = 0.5 * geometry.n_pos + 0.3 * np.arange(n), np.ones(n)
    n_lines = np.where((np.arange(n) >= 60) & (np.arange(n) < 100), 2, 1)
    stripe = stripe_at(position, 0.1 * ones, 0.3 * ones)
    lines = lines_of(stripe, 0.0 * ones)
    lines[N_LINES] = n_lines
    points, column_mm, *_ = triangulate(geometry.stripe_source, scene, lines)
    assert points.shape[1] == n - 20
    pairs = points[N_LINES] == 2.0
    np.testing.assert_array_equal(np.sort(points[SCAN, pairs]), np.arange(60.5, 100.0, 2.0))
    each, each_mm = triangulated(geometry, scene, position)
    order = np.argsort(each[SCAN])
    for row in (Y_MM, Z_MM, DY_MM, DZ_MM):
        twin = np.interp(points[SCAN], each[SCAN, order], each[row, order])
        np.testing.assert_allclose(points[row], twin, rtol=1e-4, atol=1e-4)
    # A stripe's spacing is that of its lines.
    assert column_mm == pytest.approx(each_mm, rel=0.02)
    np.testing.assert_allclose(points[SIGMA_PX], 0.1)
    np.testing.assert_allclose(points[BESIDE_PX], np.where(pairs, 0.3 / math.sqrt(2.0), 0.3))


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("joint", ["v_groove", "corrugation"])
def test_an_edge_along_the_seam_crosses_the_stripe_on_a_parabola(joint: str, upright: bool) -> None:
    """Against the camera's own projection of the edge, up to two sigmas of the sheet to either side of it."""
    setup, slope_sigma, height_mm = small_setup(joint, upright=upright), 0.03, -2.0
    geometry = SensorGeometry.of(replace(setup, camera=replace(setup.camera, distortion=DISTORTION)))
    scene = make_scene(geometry.setup, pose_at(11.0, 2.0, -1.0, (2.0, -1.0, 5.0)).T_base_tool)
    camera, sheet = geometry.setup.camera, geometry.stripe_source.sheet
    R, t = scene.T_joint_tool[:3, :3], scene.T_joint_tool[:3, 3]
    normal = R @ sheet.plane[:3]

    def on_edge(x_mm: float) -> Float64:
        return np.array([x_mm, 0.0, height_mm + ridge(x_mm, scene.shape.corrugation)[0]])

    def off_sheet(x_mm: float) -> float:
        return float(normal @ on_edge(x_mm) + sheet.plane[3] - normal @ t)

    def seen(points_mm: Float64) -> Float64:
        there = transform(invert(scene.T_joint_camera), points_mm)
        return geometry.scan_points(camera.project(there))

    x = brentq(off_sheet, 0.0, 80.0, xtol=1e-12)
    x_sigma = brentq(lambda there: off_sheet(there) - sheet.sigma, 0.0, 80.0, xtol=1e-12) - x
    found = lines_over(geometry, scene, EdgeAlongSeam(height_mm, slope_sigma, 0.05))
    middle = seen(on_edge(x)[None])[0]
    at = seen(np.array([on_edge(x + k * x_sigma) for k in np.linspace(-2.0, 2.0, 9)])) - middle
    np.testing.assert_allclose(at[:, 0], found.skew * at[:, 1] + found.bend * at[:, 1] ** 2, atol=0.02)
    assert found.stated == pytest.approx(0.5 * abs(at[6, 0] - at[2, 0]), rel=0.02, abs=1e-6)
    aside = np.array([0.0, slope_sigma * x_sigma, 0.0])
    turned = seen(np.array([on_edge(x) + aside, on_edge(x) - aside]))[:, 0]
    assert found.turned == pytest.approx(0.5 * abs(turned[1] - turned[0]), rel=0.01)


@pytest.mark.parametrize("rises", [True, False])
def test_values_are_ordered_as_numpy_orders_them(rises: bool) -> None:
    rng = np.random.default_rng(4)
    for n in (0, 1, 2, 3, 64, 321):
        values = np.round(rng.normal(size=n), 1) + (0.1 if rises else -0.1) * np.arange(n)
        np.testing.assert_array_equal(stable_order(values), np.argsort(values, kind="stable"))
