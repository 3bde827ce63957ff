"""The expected stripe against what the forward model draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendered import pose_at, small_setup
from scipy.optimize import least_squares

from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import SeamLine
from noise_model.transforms import invert, transform
from tracker.geometry import SensorGeometry
from tracker.stripe.expected import FAN_SLACK_MM, expect_stripe

SEAM = SeamLine(0.0, 0.8, -0.4, 0.01, 0.002)


def drawn(setup, pose, geometry: SensorGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Centre and sigma of a Gaussian fitted to the noise-free stripe of every tenth scan line."""
    image = predict(setup, pose.T_base_tool, Condition(1.0, 0.0, 0.005), seam=SEAM).mean_e
    lines = image.T if geometry.along_rows else image
    center, sigma = np.full(len(lines), np.nan), np.full(len(lines), np.nan)
    place = np.arange(lines.shape[1], dtype=float)
    for s in range(5, len(lines), 10):
        line = lines[s].astype(np.float64)
        peak = int(np.argmax(line))
        if line[peak] < 100.0:
            continue
        part = slice(max(0, peak - 12), peak + 13)
        found = least_squares(
            lambda x, r=place[part], e=line[part]: x[0] * np.exp(-0.5 * ((r - x[1]) / x[2]) ** 2) - e,
            [line[peak], float(peak), 3.0],
        )
        center[s], sigma[s] = found.x[1], abs(found.x[2])
    return center, sigma


PLAIN, DISTORTED = (0.0,) * 5, (-0.1, 0.02, 1e-3, -5e-4, 0.01)
TILTED = (*DISTORTED, 0.05, -0.02, 0.01, 0.001, -0.002, 5e-4, 0.001, 0.05, -0.03)


@pytest.mark.parametrize(
    ("upright", "distortion", "bow"),
    [(False, PLAIN, 0.3), (True, PLAIN, 0.0), (False, DISTORTED, 0.0), (False, TILTED, -0.15)],
)
@pytest.mark.parametrize("joint", ["v_groove", "lap", "corrugation"])
def test_it_lies_where_the_forward_model_draws_it(
    joint: str, upright: bool, distortion: tuple[float, ...], bow: float
) -> None:
    setup = small_setup(joint, upright=upright)
    setup = replace(setup, laser=replace(setup.laser, bow=bow))
    setup = replace(setup, camera=replace(setup.camera, distortion=distortion))
    geometry = SensorGeometry.of(setup)
    assert geometry.along_rows is not upright
    pose = pose_at(3.0, turn_deg=(1.0, -2.0, 3.0))
    expected = expect_stripe(geometry, make_scene(setup, pose.T_base_tool, SEAM))
    assert expected is not None
    center, sigma = drawn(setup, pose, geometry)
    off = center - expected.position_px - expected.bias_px
    wide = sigma / expected.sigma_px
    seen = np.isfinite(off)
    print(
        f"{joint}: {seen.sum()} lines, centre off by {np.nanmedian(np.abs(off)):.4f} px, 90 % below "
        f"{np.nanquantile(np.abs(off), 0.9):.4f} px, width ratio {np.nanmedian(wide):.4f}"
    )
    assert seen.sum() >= 20
    assert expected.widest_px == expected.sigma_px.max()
    # Lines on whose flanks another face begins are neither Gaussian nor asked for.
    assert np.nanmedian(np.abs(off)) < 0.02
    assert np.nanquantile(np.abs(off), 0.75) < 0.05
    assert np.nanmedian(wide) == pytest.approx(1.0, abs=0.03)


def test_the_lean_matters() -> None:
    setup = small_setup("corrugation")
    geometry = SensorGeometry.of(setup)
    pose = pose_at(12.0)
    expected = expect_stripe(geometry, make_scene(setup, pose.T_base_tool, SEAM))
    assert expected is not None
    center, _ = drawn(setup, pose, geometry)
    without = np.nanmedian(np.abs(center - expected.position_px))
    with_bias = np.nanmedian(np.abs(center - expected.position_px - expected.bias_px))
    print(f"corrugation's flank: off by {without:.3f} px without the lean, {with_bias:.3f} px with it")
    assert with_bias < 0.3 * without


def best_bell(line_e: np.ndarray, start_px: float, dark_e2: float) -> np.ndarray:
    """Centre and sigma of the likeliest Gaussian in a noise-free line, as if it had shot and dark noise."""
    r = np.arange(len(line_e), dtype=float)
    near = np.abs(r - start_px) < 16.0

    def bell(x: np.ndarray) -> np.ndarray:
        return np.asarray(x[0] * np.exp(-0.5 * ((r[near] - x[1]) / x[2]) ** 2))

    x = np.array([line_e.max(), start_px, 3.5])
    for _ in range(6):
        sigma = np.sqrt(bell(x) + dark_e2)
        x = least_squares(lambda x, sigma=sigma: (line_e[near] - bell(x)) / sigma, x).x
    return x[1:]


def test_a_sheet_that_mirrors_the_laser_leans_it_by_pixels() -> None:
    """Poses at which a corrugation of bare steel mirrors a part of the stripe into the lens."""
    setup = small_setup("corrugation")
    setup = replace(setup, material=TABLE_1["mild_steel"])
    geometry = SensorGeometry.of(setup)
    lean, off, wide = [], [], []
    for station in (26.0, 28.0, 38.0, 40.0):
        pose = pose_at(station)
        expected = expect_stripe(geometry, make_scene(setup, pose.T_base_tool))
        assert expected is not None
        lines = predict(setup, pose.T_base_tool, Condition(1.0, 0.0, 0.005)).mean_e.T.astype(np.float64)
        for s in range(10, len(lines), 20):
            start = expected.position_px[s] + expected.bias_px[s]
            center, sigma = best_bell(lines[s], start, geometry.dark_variance_e2)
            lean.append(center - expected.position_px[s])
            off.append(center - start)
            wide.append(sigma / expected.sigma_px[s])
    print(
        f"leans of up to {np.abs(lean).max():.2f} px, {np.std(lean):.2f} px RMS, known to {np.std(off):.3f}, "
        f"width ratio {np.median(wide):.3f} ± {np.std(wide):.3f}"
    )
    assert np.std(lean) > 1.0
    # The light is as seen; the noise it is weighted by is not, with no arc here.
    assert np.std(off) < 0.15 * np.std(lean)
    assert np.quantile(np.abs(np.log(wide)), 0.9) < 0.1


def test_beside_the_image_it_is_expected_where_the_plates_go_on() -> None:
    setup = small_setup("v_groove")
    for axis, off_mm in ((0, -40.0), (1, 200.0)):
        aside = setup.camera.T_tool_camera.copy()
        aside[axis, 3] += off_mm
        geometry = SensorGeometry.of(replace(setup, camera=replace(setup.camera, T_tool_camera=aside)))
        expected = expect_stripe(geometry, make_scene(geometry.setup, pose_at(0.0).T_base_tool))
        assert expected is not None
        inside = (expected.position_px > 0.0) & (expected.position_px < geometry.n_pos)
        assert inside.all() if axis == 1 else not inside.any()
    # Far beside the seam there is one plate.
    np.testing.assert_allclose(np.diff(expected.position_px, 2), 0.0, atol=1e-6)


def test_beyond_the_fan_none_is_expected() -> None:
    """It fans out 5 deg to either side 140 mm above the plate: that is 12.2 mm."""
    setup = small_setup("v_groove")
    laser = replace(setup.laser, fan_half_angle_deg=5.0)
    wide, narrow = (
        expect_stripe(geometry, make_scene(geometry.setup, pose_at(0.0).T_base_tool))
        for geometry in map(SensorGeometry.of, (setup, replace(setup, laser=laser)))
    )
    assert wide is not None
    assert narrow is not None
    assert wide.shown.all()
    assert wide.is_sought.all()
    for name in ("position_px", "sigma_px", "bias_px"):
        np.testing.assert_array_equal(getattr(narrow, name), getattr(wide, name))
    half_mm = 140.0 * np.tan(np.radians(5.0))
    T_camera_tool = invert(setup.camera.T_tool_camera)
    for lines, end_mm in ((narrow.shown, half_mm), (narrow.is_sought, half_mm + FAN_SLACK_MM)):
        ends = np.array([[35.0, side * end_mm, 0.0] for side in (-1.0, 1.0)])
        u = np.sort(setup.camera.project(transform(T_camera_tool, ends))[:, 0])
        np.testing.assert_array_equal(np.flatnonzero(lines)[[0, -1]], [np.ceil(u[0]), np.floor(u[1])])


def test_what_lies_behind_the_camera_is_none() -> None:
    setup = small_setup("v_groove")
    scene = make_scene(setup, pose_at(0.0, turn_deg=(0.0, 80.0, 0.0)).T_base_tool)
    assert expect_stripe(SensorGeometry.of(setup), scene) is None


def test_a_leg_that_rises_behind_the_camera_leaves_the_rest_expected() -> None:
    setup = small_setup("fillet")
    setup = replace(setup, joint=replace(setup.joint, dimensions={"included_angle_deg": 30.0}))
    geometry, pose = SensorGeometry.of(setup), pose_at(0.0)
    scene = make_scene(setup, pose.T_base_tool, SEAM)
    expected = expect_stripe(geometry, scene)
    assert expected is not None
    center, _ = drawn(setup, pose, geometry)
    off_px = center - expected.position_px - expected.bias_px
    assert np.isfinite(off_px).sum() >= 15
    assert np.nanmedian(np.abs(off_px)) < 0.05


def test_a_stripe_that_cannot_be_seen_is_no_setup() -> None:
    setup = small_setup("v_groove")
    behind = replace(setup, laser=replace(setup.laser, plane_in_tool=(1.0, 0.0, 0.0, -500.0)))
    with pytest.raises(ValueError, match="behind the camera"):
        SensorGeometry.of(behind)
