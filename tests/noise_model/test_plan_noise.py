"""The light along the stripe and its bounds, held against whole rendered frames, pixel by pixel."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from plan_setups import SETUPS, expected_e, plan_setup, steel_groove
from scipy.spatial.transform import Rotation

from noise_model.arc.scene import make_scene
from noise_model.effects import checked
from noise_model.instrument.sensor import variance_e2
from noise_model.plan.cramer_rao import POSITION, stripe_sigmas
from noise_model.plan.design import design_of, with_design
from noise_model.plan.light import REACH_MM, SampledStripe, stripe_level_e, stripe_light
from noise_model.plan.noise import (
    EDGE_LINES,
    MIN_LINES,
    Surroundings,
    expected_pixels,
    line_bounds,
    longest_exposure,
    saturation_e,
    seam_noise,
    speckle_floor_px,
)
from noise_model.setup import Setup
from noise_model.surface.joint import Joint, SeamLine
from noise_model.transforms import invert, transform
from tracker.stripe.edge import MIN_SIGMA

Float64 = NDArray[np.float64]
SILENT = Surroundings(speckle_contrast=0.0)


def tool(x: float = 7.0, z: float = 1.0, tilt: tuple[float, float] = (2.0, -3.0)) -> Float64:
    T_base_tool = np.eye(4)
    T_base_tool[:3, :3] = Rotation.from_euler("xy", tilt, degrees=True).as_matrix()
    T_base_tool[:3, 3] = x, 0.4, z
    return T_base_tool


def lit(setup: Setup, T_base_tool: Float64) -> SampledStripe:
    return stripe_light(setup, T_base_tool, stripe_level_e(setup))


def image_points(setup: Setup, T_base_tool: Float64, light: SampledStripe) -> Float64:
    scene = make_scene(setup, T_base_tool)
    return setup.camera.project(transform(invert(scene.T_joint_camera), light.points))


def clear(light: SampledStripe) -> NDArray[np.bool_]:
    """Rays whose neighbours are seen too and lie on the same face, no step between them."""
    alike = np.ones(len(light.points), dtype=bool)
    for shift in (-2, -1, 1, 2):
        alike &= np.abs(np.roll(light.normals, shift, axis=0) - light.normals).max(axis=1) < 0.05
        alike &= np.abs((np.roll(light.points, shift, axis=0) - light.points)[:, 2]) < 1.2
        alike &= np.roll(light.seen, shift)
    alike[:2] = alike[-2:] = False
    return alike & light.seen


@pytest.mark.parametrize("name", SETUPS)
def test_stripe_and_arc_are_those_of_a_rendered_frame(name: str) -> None:
    setup, T_base_tool = SETUPS[name], tool()
    light = lit(setup, T_base_tool)
    stripe, arc = expected_e(setup, T_base_tool, laser=1.0), expected_e(setup, T_base_tool, arc=1.0)
    image = image_points(setup, T_base_tool, light)
    rows = np.arange(setup.camera.height)
    checked = 0
    for i in np.flatnonzero(clear(light)):
        # The nearest column is at most half a pixel aside: where the stripe slants its centre is another.
        line = stripe[:, round(image[i, 0])]
        window = np.abs(rows - image[i, 1]) < 5.0 * light.width_px[i]
        charge = line[window].sum()
        centre = (line[window] @ rows[window]) / charge
        width = math.sqrt(line[window] @ (rows[window] - centre) ** 2 / charge)
        assert light.stripe_e[i] == pytest.approx(line[window].max(), rel=0.02)
        assert light.width_px[i] == pytest.approx(width, rel=0.02)
        assert image[i, 1] == pytest.approx(centre, abs=0.6)
        at_centre = arc[round(image[i, 1]), round(image[i, 0])]
        assert light.arc_e[i, 2] == pytest.approx(at_centre, rel=0.03, abs=5.0)
        checked += 1
    assert checked > 25


@pytest.mark.parametrize("name", SETUPS)
def test_a_displaced_joint_moves_the_stripe_as_the_gradient_says(name: str) -> None:
    setup, T_base_tool = SETUPS[name], tool()
    light = lit(setup, T_base_tool)
    image = image_points(setup, T_base_tool, light)
    gradient = light.normals[:, 1:] / np.sum(light.normals * light.moves, axis=1)[:, None]
    rows = np.arange(setup.camera.height)

    def centres(seam: SeamLine) -> Float64:
        frame = expected_e(setup, T_base_tool, laser=1.0, seam=seam)
        columns = frame[:, np.round(image[:, 0]).astype(int).clip(0, setup.camera.width - 1)]
        near = np.abs(rows[:, None] - image[:, 1]) < 4.0 * light.width_px
        columns = np.where(near, columns, 0.0)
        with np.errstate(invalid="ignore"):
            return (columns * rows[:, None]).sum(axis=0) / columns.sum(axis=0)

    good = clear(light)
    for axis, moved in enumerate((SeamLine(y_mm=0.1), SeamLine(z_mm=0.1))):
        back = SeamLine(y_mm=-moved.y_mm, z_mm=-moved.z_mm)
        found = (centres(moved) - centres(back))[good] / 0.2
        # The corrugation stays where it is along the seam while it moves, as the bound has it.
        np.testing.assert_allclose(found, gradient[good, axis], rtol=0.04, atol=0.12)


def test_rays_beyond_the_fan_are_left_out() -> None:
    setup = SETUPS["v_groove"]
    narrow = replace(setup, laser=replace(setup.laser, fan_half_angle_deg=2.0))
    every, some = lit(setup, tool()), lit(narrow, tool())
    origin = every.source
    lit_mm = (every.points - origin) @ np.asarray(tool()[:3, 1])
    depth_mm = (origin - every.points) @ np.asarray(tool()[:3, 2])
    inside = np.abs(lit_mm) <= math.tan(math.radians(2.0)) * depth_mm
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(some.points, every.points[inside])
    np.testing.assert_array_equal(some.stripe_e, every.stripe_e[inside])


def test_lines_are_counted_once() -> None:
    setup, T_base_tool = steel_groove(), tool(tilt=(0.0, 0.0))
    light = lit(setup, T_base_tool)
    columns = image_points(setup, T_base_tool, light)[:, 0]
    spanned = columns.max() - columns.min()
    assert light.lines.sum() == pytest.approx(spanned * len(columns) / (len(columns) - 1), rel=0.01)
    assert light.length_mm.sum() > 2 * REACH_MM
    assert np.abs(light.points[:, 1]).max() <= REACH_MM


@pytest.mark.parametrize("contrast", [0.0, 1.0])
def test_a_lines_bound_is_that_of_its_pixels(contrast: float) -> None:
    setup, T_base_tool = plan_setup("v_groove", "mild_steel"), tool()
    light = lit(setup, T_base_tool)
    floor = speckle_floor_px(setup, contrast)
    assert (floor == 0.0) == (contrast == 0.0)
    bounds = line_bounds(light, expected_pixels(light, setup, SILENT), setup.sensor, floor)
    frame = expected_e(setup, T_base_tool, laser=1.0, arc=1.0)
    image, rows = image_points(setup, T_base_tool, light), np.arange(setup.camera.height)
    for i in np.flatnonzero(clear(light))[::5]:
        window = np.abs(rows - image[i, 1]) < 4.0 * light.width_px[i]
        variance = variance_e2(frame[window, round(image[i, 0])], setup.sensor)
        offsets = rows[window] - image[i, 1]
        pixels = stripe_sigmas(
            offsets[None], light.stripe_e[i : i + 1], light.width_px[i : i + 1], variance[None]
        )
        assert bounds.sigma_px[i] == pytest.approx(math.hypot(pixels[0, POSITION], floor), rel=0.03)
    assert bounds.readable.all()


def test_a_filter_and_an_exposure_are_the_setup_that_they_make() -> None:
    setup, T_base_tool = steel_groove(), tool()
    design = replace(design_of(setup), filter_fwhm_nm=5.0, exposure_s=0.008)
    made = with_design(setup, design)
    light, other = lit(setup, T_base_tool), lit(made, T_base_tool)
    one = line_bounds(light, expected_pixels(light, setup, SILENT, made.filter), setup.sensor, 0.1, 1.6)
    two = line_bounds(other, expected_pixels(other, made, SILENT), setup.sensor, 0.1)
    np.testing.assert_allclose(one.sigma_px, two.sigma_px, rtol=1e-6)
    np.testing.assert_allclose(one.arc_over_stripe, two.arc_over_stripe, rtol=1e-6)


def test_what_stands_aside_hides_the_near_bevel() -> None:
    setup = steel_groove()
    aside = with_design(setup, replace(design_of(setup), azimuth_deg=90.0, tilt_deg=45.0))
    light = lit(aside, tool(tilt=(0.0, 0.0)))
    y = light.points[:, 1]
    # The camera stands at y > 0: the bevel on its own side is steeper than its view, and hides the root.
    left, right = (y > 0.6) & (y < 2.6), (y < -0.6) & (y > -2.6)
    assert not light.seen[left].any()
    assert light.seen[right & (y < -1.5)].all()
    noise = seam_noise(
        light, line_bounds(light, expected_pixels(light, aside, SILENT), aside.sensor, 0.0), aside.joint
    )
    assert math.isnan(noise.sigma_mm)
    assert light.lines[left].sum() > MIN_LINES


def test_too_much_arc_light_saturates_and_a_shorter_exposure_helps() -> None:
    setup = plan_setup("v_groove", "mild_steel", radiance_e=3e9)
    light = lit(setup, tool())
    pixels = expected_pixels(light, setup, SILENT)
    as_is = line_bounds(light, pixels, setup.sensor, 0.0)
    assert as_is.saturated.any()
    assert np.isnan(as_is.sigma_px[as_is.saturated]).all()
    exposure = longest_exposure(float(pixels.mean_e.max()), setup.sensor)
    assert exposure < 1.0
    brightest = exposure * pixels.mean_e.max()
    full = saturation_e(setup.sensor)
    assert brightest + 4.0 * math.sqrt(variance_e2(brightest, setup.sensor)) <= full
    assert brightest > 0.9 * full
    shorter = line_bounds(light, pixels, setup.sensor, 0.0, exposure)
    assert not shorter.saturated.any()
    noise = seam_noise(light, shorter, setup.joint)
    assert noise.blind_share < seam_noise(light, as_is, setup.joint).blind_share
    assert (
        noise.sigma_mm
        > seam_noise(
            *(light, line_bounds(light, pixels, setup.sensor, 0.0, 1.0001 * exposure)), setup.joint
        ).sigma_mm
    )


def test_a_stripe_that_drowns_is_not_read() -> None:
    setup = plan_setup("lap", "zn_coated", radiance_e=1e7)
    faint = replace(setup, laser=replace(setup.laser, peak_e=20.0))
    light = lit(faint, tool())
    noise = seam_noise(
        light, line_bounds(light, expected_pixels(light, faint, SILENT), faint.sensor, 0.0), faint.joint
    )
    assert noise.blind_share == 1.0
    assert math.isnan(noise.sigma_mm)
    assert math.isnan(noise.sigma_px)
    assert noise.arc_over_stripe > 2.0


def test_a_laps_edge_lies_within_its_scan_line() -> None:
    setup = plan_setup("lap", "zn_coated", radiance_e=1e7)
    light = lit(setup, tool(tilt=(0.0, 0.0)))
    bounds = line_bounds(light, expected_pixels(light, setup, SILENT), setup.sensor, 0.0)
    noise = seam_noise(light, bounds, setup.joint)
    distance = 145.0
    mm_per_column = distance / setup.camera.fx
    assert noise.sigma_y_mm == pytest.approx(0.1 * mm_per_column, rel=0.03)
    assert EDGE_LINES == MIN_SIGMA
    # Half a millimetre beside the edge that is not read leaves it anywhere there.
    torn = bounds.sigma_px.copy()
    torn[(light.points[:, 1] > 0.0) & (light.points[:, 1] < 0.5)] = np.nan
    blinded = replace(bounds, sigma_px=torn, readable=np.isfinite(torn))
    assert seam_noise(light, blinded, setup.joint).sigma_y_mm == pytest.approx(0.5 / math.sqrt(12), rel=0.5)


def test_what_shines_from_the_upright_side_itself_blurs_the_edge() -> None:
    """Laser and camera on the lower side, y > 0: the edge's side stands before a strip of the lower sheet."""
    setup = plan_setup("lap", "zn_coated", radiance_e=1e7)
    setup = replace(setup, laser=replace(setup.laser, origin_in_tool_mm=(35.0, 60.0, 140.0)))
    lit_side = with_design(setup, replace(design_of(setup), azimuth_deg=45.0, tilt_deg=30.0))
    light = lit(lit_side, tool(tilt=(0.0, 0.0)))
    bounds = line_bounds(light, expected_pixels(light, lit_side, SILENT), lit_side.sensor, 0.0)
    noise = seam_noise(light, bounds, lit_side.joint)
    # The tool is 0.4 mm beside the seam and 1 mm over the lower sheet, the upper one 2 mm.
    beside, over = 145.0 * math.sin(math.radians(30.0)) * math.sqrt(0.5), 145.0 * math.cos(math.radians(30.0))
    strip = (beside + 0.4) / (over - 1.0) * 2.0
    assert noise.sigma_y_mm == pytest.approx(strip / math.sqrt(12.0), rel=0.01)
    # From the other side the laser leaves that side dark.
    dark = replace(light, source=light.source * [1.0, -1.0, 1.0])
    assert seam_noise(dark, bounds, lit_side.joint).sigma_y_mm < 0.1 * noise.sigma_y_mm


def test_a_slots_edges_are_placed_within_their_scan_lines() -> None:
    """Two edges, each to a tenth of a line: the middle is known to a tenth of the spacing over sqrt(2)."""
    setup = plan_setup("lap", "zn_coated", radiance_e=1e7)
    slot = Joint("butt", {"thickness_mm": 3.0, "gap_mm": 1.0}, setup.joint.seam_in_base_mm)
    setup = replace(setup, joint=slot)
    light = lit(setup, tool(z=0.0, tilt=(0.0, 0.0)))
    bounds = line_bounds(light, expected_pixels(light, setup, SILENT), setup.sensor, 0.0)
    on_plate = replace(bounds, sigma_px=np.where(np.abs(light.points[:, 1]) > 0.5, bounds.sigma_px, np.nan))
    spacing = 145.0 / setup.camera.fx
    assert seam_noise(light, on_plate, slot).sigma_y_mm == pytest.approx(
        0.1 * spacing / math.sqrt(2.0), rel=0.1
    )


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_filters_shift_acts_once(share: float) -> None:
    """As a filter with n_eff over the root of the share; the whole shift is what a plan takes anyway."""
    setup, T_base_tool = steel_groove(), tool()
    shifted = replace(setup, effects=checked({"filter_shift": {"shift_share": share}}))
    index = setup.filter.effective_index / math.sqrt(share)
    other = replace(setup, filter=replace(setup.filter, effective_index=index))
    for fwhm in (4.0, 10.0):
        got, want = (
            expected_pixels(lit(of, T_base_tool), of, SILENT, replace(of.filter, fwhm_nm=fwhm))
            for of in (shifted, other)
        )
        np.testing.assert_allclose(got.stripe_e, want.stripe_e, rtol=1e-3)
        np.testing.assert_allclose(got.arc_e, want.arc_e, rtol=1e-3)


def test_a_contrast_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="contrast"):
        Surroundings(speckle_contrast=1.5)


def test_known_effects_act_on_the_light() -> None:
    """Vignetting by hand where the points lie in the image; glow adds to the arc's light alone."""
    setup, T_base_tool = steel_groove(), tool()
    effects = checked({"vignetting": {"loss": 0.8}, "hot_metal_glow": {"peak_e": 3e4}})
    plain, seen = lit(setup, T_base_tool), lit(replace(setup, effects=effects), T_base_tool)
    u, v = image_points(setup, T_base_tool, plain).T
    half = 0.5 * math.hypot(400.0, 300.0)
    factor = 1.0 - 0.8 * ((u - 199.5) ** 2 + (v - 149.5) ** 2) / half**2
    good = plain.seen
    np.testing.assert_allclose(seen.stripe_e[good], (plain.stripe_e * factor)[good], rtol=1e-4)
    middle = plain.arc_e[good][:, plain.arc_e.shape[1] // 2] * factor[good]
    assert (seen.arc_e[good][:, plain.arc_e.shape[1] // 2] > middle).all()
