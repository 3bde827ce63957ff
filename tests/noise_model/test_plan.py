"""Designs and the setups they make, held against vectors written out and against rendered frames."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_setups import SETUPS, expected_e, steel_groove
from scipy.constants import c, h, k

from noise_model.arc.scene import make_scene
from noise_model.instrument.spectrum import ArcSpectrum, Filter, FilterCurve
from noise_model.plan.design import (
    SensorDesign,
    clears_torch,
    design_of,
    filter_gains,
    filter_of,
    passes_laser,
    with_design,
)
from noise_model.plan.light import stripe_level_e, stripe_light
from noise_model.plan.noise import NODES, Surroundings, expected_pixels, speckle_floor_px
from noise_model.stripe import stripe_reference
from noise_model.transforms import invert, transform

DESIGNS = st.builds(
    SensorDesign,
    tilt_deg=st.floats(1.0, 65.0),
    azimuth_deg=st.floats(-179.0, 180.0),
    preview_mm=st.floats(15.0, 60.0),
    stand_off_mm=st.floats(80.0, 300.0),
    lean_deg=st.floats(-30.0, 30.0),
    filter_fwhm_nm=st.floats(2.0, 30.0),
    exposure_s=st.floats(1e-4, 2e-2),
)


@pytest.mark.parametrize("name", SETUPS)
def test_a_setups_own_design_gives_it_back(name: str) -> None:
    setup = SETUPS[name]
    made = with_design(setup, design_of(setup))
    np.testing.assert_allclose(made.camera.T_tool_camera, setup.camera.T_tool_camera, atol=1e-9)
    np.testing.assert_allclose(made.laser.plane_in_tool, setup.laser.plane_in_tool, atol=1e-12)
    np.testing.assert_allclose(made.laser.origin_in_tool_mm, setup.laser.origin_in_tool_mm, atol=1e-9)
    assert made.laser.peak_e == pytest.approx(setup.laser.peak_e, rel=1e-12)
    assert made.arc.radiance_e == pytest.approx(setup.arc.radiance_e, rel=1e-12)


@given(DESIGNS)
@settings(max_examples=60, deadline=None)
def test_a_design_is_read_back_from_what_it_made(design: SensorDesign) -> None:
    made = with_design(steel_groove(), design)
    found = design_of(made)
    assert math.remainder(found.azimuth_deg - design.azimuth_deg, 360.0) == pytest.approx(0.0, abs=1e-6)
    for name in ("tilt_deg", "preview_mm", "stand_off_mm", "lean_deg", "filter_fwhm_nm", "exposure_s"):
        assert getattr(found, name) == pytest.approx(getattr(design, name), abs=1e-6)
    # The axis' angle to the plane, and the roll: the stripe along the image's rows.
    axis, plane = made.camera.T_tool_camera[:3, 2], np.asarray(made.laser.plane_in_tool)
    assert design.triangulation_deg == pytest.approx(
        math.degrees(math.asin(min(1.0, abs(float(axis @ plane[:3]))))), abs=1e-6
    )
    assert float(made.camera.T_tool_camera[:3, 1] @ [0.0, 1.0, 0.0]) == pytest.approx(0.0, abs=1e-9)
    # The laser stands as far from the stripe's foot as it did, and in its own plane.
    origin = np.asarray(made.laser.origin_in_tool_mm)
    assert np.linalg.norm(origin - [design.preview_mm, 0.0, 0.0]) == pytest.approx(140.0, abs=1e-9)
    assert plane[:3] @ origin + plane[3] == pytest.approx(0.0, abs=1e-9)


def test_a_diffuse_plate_goes_with_the_working_aperture_and_is_dimmer_under_a_leaning_sheet() -> None:
    setup = steel_groove()
    setup = replace(
        setup,
        material=replace(setup.material, kappa_spec=0.0),
        joint=replace(setup.joint, type="flat"),
        camera=replace(setup.camera, psf_sigma_px=0.0),
    )
    own = design_of(setup)

    def peak(design: SensorDesign) -> float:
        return float(expected_e(with_design(setup, design), np.eye(4), laser=1.0).max())

    # N (1 + m) = N Z / (Z - f) of a thin lens: the image of a radiance goes with ((Z - f) / Z)^2.
    near, f = peak(replace(own, stand_off_mm=100.0)), setup.camera.focal_length_mm
    brighter = ((1.0 - f / 220.0) / (1.0 - f / 100.0)) ** 2
    assert brighter > 1.15
    far = replace(own, stand_off_mm=220.0, preview_mm=50.0)
    assert peak(far) == pytest.approx(brighter * near, rel=0.01)
    mine = peak(own)
    assert peak(replace(own, lean_deg=-25.0)) == pytest.approx(mine * math.cos(math.radians(25.0)), rel=0.02)
    assert peak(replace(own, exposure_s=0.5 * own.exposure_s)) == pytest.approx(0.5 * mine, rel=0.01)
    arcs = [with_design(setup, d).arc.radiance_e for d in (replace(own, stand_off_mm=100.0), far)]
    assert arcs[1] / arcs[0] == pytest.approx(brighter, rel=1e-9)


def test_a_refocused_lens_images_as_large_as_a_thin_lens_does() -> None:
    setup = steel_groove()
    own, f = design_of(setup), setup.camera.focal_length_mm
    # The pixel's width, known from where the lens stands now: the image lies f Z / (Z - f) behind it.
    pixel_mm = f * own.stand_off_mm / (own.stand_off_mm - f) / setup.camera.fx
    floors = [speckle_floor_px(setup, 1.0)]
    for stand_off_mm in (100.0, 250.0):
        made = with_design(setup, replace(own, stand_off_mm=stand_off_mm))
        points = np.array([[0.0, 0.0, stand_off_mm], [3.0, 2.0, stand_off_mm]])
        magnified = f / (stand_off_mm - f) * (points[1, :2] - points[0, :2]) / pixel_mm
        np.testing.assert_allclose(np.diff(made.camera.project(points), axis=0)[0], magnified, rtol=1e-9)
        floors.append(speckle_floor_px(made, 1.0))
    # The pixel stays as large, so speckle in it goes with N (1 + m) and the share it averages.
    assert floors[1] > floors[0] > floors[2]


def test_a_filters_share_of_the_arc_is_its_integral_and_the_laser_drops_off_axis() -> None:
    wide, narrow = Filter(690.0, 10.0, 1.8), Filter(690.0, 4.0, 1.8)
    theta = math.radians(9.0)
    bare = ArcSpectrum(line_width_nm=0.0)
    laser, arc = filter_gains(wide, narrow, 690.0, bare, np.array([0.0, theta]))
    fine = np.linspace(640.0, 740.0, 200001)
    planck = fine**-5.0 / np.expm1(h * c / (fine * 1e-9 * k * 12000.0))

    def passed(fwhm: float, shift: float) -> float:
        return float(np.sum(planck * 2.0 ** -(((fine / shift - 690.0) / (0.5 * fwhm)) ** 2)))

    shift = math.sqrt(1.0 - (math.sin(theta) / 1.8) ** 2)
    assert arc[0] == pytest.approx(passed(4.0, 1.0) / passed(10.0, 1.0), rel=1e-6)
    assert arc[1] == pytest.approx(passed(4.0, shift) / passed(10.0, 1.0), rel=1e-3)
    assert laser[0] == pytest.approx(1.0)
    assert laser[1] == pytest.approx(2.0 ** -(((690.0 / shift - 690.0) / 2.0) ** 2), rel=0.02)
    # With lines 6 nm beside the laser a wide filter passes more than its share of continuum.
    assert filter_gains(wide, narrow, 690.0, ArcSpectrum(), 0.0)[1] < arc[0]


@pytest.mark.parametrize("fwhm_nm", [5.0, 10.0, 20.0])
def test_lines_that_an_effect_adds_are_not_added_again(fwhm_nm: float) -> None:
    leak = {"argon_line_leak": {"line_width_nm": 30.0}, "filter_shift": {"shift_share": 1.0}}
    setup = replace(steel_groove(), effects=leak)
    made = with_design(setup, replace(design_of(setup), filter_fwhm_nm=fwhm_nm))
    continuum = ArcSpectrum(line_width_nm=0.0)
    passed = filter_gains(setup.filter, made.filter, 690.0, continuum, 0.0)[1]
    assert made.arc.radiance_e == pytest.approx(setup.arc.radiance_e * passed)
    frame = expected_e(made, np.eye(4), arc=1.0)
    for of, optics in ((setup, made.filter), (made, None)):
        light = stripe_light(of, np.eye(4), stripe_level_e(of))
        arc_e = expected_pixels(light, of, Surroundings(), optics).arc_e[:, NODES // 2]
        camera = invert(make_scene(of, np.eye(4)).T_joint_camera)
        image = np.rint(of.camera.project(transform(camera, light.points))).astype(int)
        # Towards the rim, where the lines differ most, and clear of the groove's edges.
        level = light.seen & (np.abs(light.points[:, 1]) > 5.0)
        ratio = arc_e[level] / frame[image[level, 1], image[level, 0]]
        np.testing.assert_allclose(ratio, 1.0, atol=0.01)


def test_a_measured_curve_is_kept_at_its_own_width_and_else_replaced() -> None:
    wavelength = np.linspace(670.0, 710.0, 401)
    curve = FilterCurve(wavelength, 0.8 * np.exp2(-(((wavelength - 691.0) / 4.0) ** 2)), 1.8)
    setup = replace(steel_groove(), filter=curve)
    own = design_of(setup)
    assert own.filter_fwhm_nm == pytest.approx(8.0, abs=0.05)
    assert filter_of(setup, own.filter_fwhm_nm) is curve
    other = filter_of(setup, 5.0)
    assert isinstance(other, Filter)
    assert (other.fwhm_nm, other.center_nm) == (5.0, pytest.approx(691.0, abs=0.05))
    assert with_design(setup, replace(own, filter_fwhm_nm=5.0)).filter == other


def test_a_filter_passes_the_laser_if_it_is_wide_enough() -> None:
    setup = steel_groove()
    far_red = replace(setup, laser=replace(setup.laser, wavelength_nm=676.0))
    assert [passes_laser(far_red, fwhm) for fwhm in (5.0, 10.0, 20.0)] == [False, True, True]


@given(DESIGNS, st.floats(1.0, 30.0))
@settings(max_examples=100, deadline=None)
def test_the_torch_is_where_the_axis_comes_near_it(design: SensorDesign, radius: float) -> None:
    tilt, azimuth = math.radians(design.tilt_deg), math.radians(design.azimuth_deg)
    up = np.array([math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)])
    walk = np.array([design.preview_mm, 0.0, 0.0]) + np.linspace(0, design.stand_off_mm, 20001)[:, None] * up
    nearest = float(np.hypot(*walk[walk[:, 2] > 10.0, :2].T).min())
    if abs(nearest - radius) > 0.05:
        assert clears_torch(design, radius) == (nearest > radius)
    assert clears_torch(design, 0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tilt_deg": 86.0}, "tilt"),
        ({"lean_deg": -90.0}, "lean"),
        ({"stand_off_mm": 0.0}, "stand_off_mm"),
        ({"exposure_s": math.nan}, "exposure_s"),
        ({"preview_mm": math.inf}, "preview_mm"),
    ],
)
def test_a_design_that_cannot_be_is_refused(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(design_of(steel_groove()), **changes)


def test_setups_without_a_design_are_refused() -> None:
    setup = steel_groove()
    along = replace(setup, laser=replace(setup.laser, plane_in_tool=(0.0, 1.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="along the seam"):
        design_of(along)
    upward = setup.camera.T_tool_camera.copy()
    upward[:3, 1:3] *= -1.0
    with pytest.raises(ValueError, match="look down"):
        design_of(replace(setup, camera=replace(setup.camera, T_tool_camera=upward)))
    assert stripe_reference(setup) > 0.0
