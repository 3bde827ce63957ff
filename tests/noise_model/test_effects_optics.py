"""Optics against formulas written out here."""

import dataclasses
import math

import numpy as np
import pytest
import scenes
from effect_scenes import CONDITIONS, affected, charge, cos4, light_of, nominal, passed, rays

from noise_model.effects.light import Light
from noise_model.forward import predict
from noise_model.instrument.spectrum import FilterCurve

BRIGHT = np.random.default_rng(2).uniform(100.0, 5000.0, (60, 80))


def sharp(**changes):
    return dataclasses.replace(nominal("flat", psf_sigma_px=0.0), **changes)


def field_angle(setup):
    return np.arccos(1.0 / np.linalg.norm(rays(setup.camera), axis=-1))


def test_vignetting_dims_with_the_square_of_the_radius():
    """At the image's corners, 1 half diagonal out, by `loss` and `corner_loss`."""
    setup = affected(sharp(), vignetting={"loss": 0.3, "corner_loss": 0.2})
    got = passed(setup, light_of(BRIGHT, 2.0 * BRIGHT))
    for row, column in ((0, 0), (59, 79), (30, 40), (12, 70)):
        rho2 = ((column - 39.5) ** 2 + (row - 29.5) ** 2) / 50.0**2
        factor = 1.0 - 0.3 * rho2 - 0.2 * rho2**2
        assert got.arc[row, column] == pytest.approx(factor * BRIGHT[row, column], rel=1e-5)
        assert got.laser[row, column] == pytest.approx(2.0 * factor * BRIGHT[row, column], rel=1e-5)


def test_vignetting_goes_round_the_optical_axis():
    """As cos^4 does, wherever it meets the chip; where nothing would be left it is dark."""
    setup = sharp()
    setup = dataclasses.replace(setup, camera=dataclasses.replace(setup.camera, cx=10.0, cy=50.0))
    got = passed(affected(setup, vignetting={"loss": 0.9}), light_of(np.ones((60, 80)))).arc
    assert got[50, 10] == 1.0
    assert got.argmax() == 50 * 80 + 10
    assert got[0, 79] == 0.0


def test_a_dirty_window_by_hand():
    values = {
        "u_1": -0.3, "v_1": 0.2, "radius_1": 0.15, "dimming_1": 0.5, "scatter_1": 0.1,
        "u_3": 0.5, "v_3": -0.1, "radius_3": 0.3, "dimming_3": 0.8, "scatter_3": 0.3,
    }  # fmt: skip
    got = passed(affected(sharp(), dirty_window=values), light_of(BRIGHT)).arc
    for row, column in ((39, 25), (25, 64), (30, 40), (59, 0)):
        u, v = (column - 39.5) / 50.0, (row - 29.5) / 50.0
        patch = [math.exp(-((u + 0.3) ** 2 + (v - 0.2) ** 2) / (2.0 * 0.15**2))]
        patch.append(math.exp(-((u - 0.5) ** 2 + (v + 0.1) ** 2) / (2.0 * 0.3**2)))
        through = (1.0 - 0.5 * patch[0]) * (1.0 - 0.8 * patch[1]) * BRIGHT[row, column]
        scattered = (0.1 * patch[0] + 0.3 * patch[1]) * BRIGHT.mean()
        assert got[row, column] == pytest.approx(through + scattered, rel=1e-4)


def test_a_defocused_line_has_the_sum_of_the_variances():
    line = np.zeros((60, 80))
    line[30] = 1000.0
    rows = np.arange(60.0)
    for sigma_px in (0.3, 1.0, 4.0):
        setup = affected(nominal("flat", psf_sigma_px=0.7), defocus={"sigma_px": sigma_px})
        across = passed(setup, light_of(line)).arc[:, 40].astype(np.float64)
        assert across.sum() == pytest.approx(1000.0, rel=1e-4)
        second = np.sum((rows - 30.0) ** 2 * across) / across.sum()
        assert second == pytest.approx(0.49 + sigma_px**2, rel=0.01)


def test_a_blur_disc_of_radius_c_has_the_variance_c2_over_4():
    """What `sigma_px` means for a lens: the disc's moment about a diameter, by counting points."""
    grid = np.linspace(-1.0, 1.0, 1001)
    x, y = np.meshgrid(grid, grid)
    inside = x**2 + y**2 <= 1.0
    assert np.mean(x[inside] ** 2) == pytest.approx(0.25, rel=1e-3)


def test_glare_keeps_all_light_and_spreads_its_share():
    laser = np.zeros((60, 80))
    laser[20:23] = 4000.0
    got = passed(affected(sharp(), veiling_glare={"share": 0.2}), light_of(BRIGHT, laser))
    for image, before in ((got.arc, BRIGHT), (got.laser, laser)):
        assert image.sum(dtype=np.float64) == pytest.approx(before.sum(), rel=1e-5)
        np.testing.assert_allclose(image, 0.8 * before + 0.2 * before.mean(), rtol=1e-4)


@pytest.mark.parametrize("spread", [0.2, 0.5, 1.5])
def test_glare_that_falls_off_is_a_gaussian_about_its_source(spread):
    """Against the whole convolution, pixel by pixel, of the image continued by its mirror images."""
    image = np.zeros((60, 80))
    image[12, 20], image[40:43, 50:70] = 1e5, 5e3
    got = passed(affected(sharp(), veiling_glare={"share": 0.3, "spread": spread}), light_of(image)).arc
    sigma = spread * 50.0
    wanted = np.zeros_like(image)
    v, u = np.mgrid[:60, :80]
    for row, column in zip(*np.nonzero(image), strict=True):
        along = sum(
            np.exp(-0.5 * ((u - x) / sigma) ** 2)
            for turn in range(-4, 5)
            for x in (column + 160 * turn, -1 - column + 160 * turn)
        )
        down = sum(
            np.exp(-0.5 * ((v - y) / sigma) ** 2)
            for turn in range(-5, 6)
            for y in (row + 120 * turn, -1 - row + 120 * turn)
        )
        wanted += image[row, column] * along * down / (2.0 * np.pi * sigma**2)
    dark = image == 0.0
    np.testing.assert_allclose(got[dark], 0.3 * wanted[dark], rtol=0.01, atol=0.006 * wanted.max())
    assert got.sum(dtype=np.float64) == pytest.approx(image.sum(), rel=0.005)


def test_what_scatters_is_dimmed_with_the_square():
    """Vignetting, window, glare and fume, one after the other, on a variance that came before them."""
    setup = affected(
        sharp(),
        fume={"extinction_per_m": 2.0, "scatter": 0.0},
        dirty_window={"dimming_1": 0.5, "scatter_1": 0.2},
        vignetting={"loss": 0.3},
        filter_shift={"shift_share": 1.0},
        veiling_glare={"share": 0.1},
    )
    dark = np.zeros((60, 80), dtype=np.float32)
    twice = dataclasses.replace(CONDITIONS["both"], exposure_s=0.01)
    light = Light(dark, dark, dark, np.full((60, 80), 100.0, dtype=np.float32))
    got = passed(setup, light, twice).variance_e2
    # An even light of neither source, from which the glare's and the window's own spread is taken away.
    even = passed(setup, Light(dark, dark, dark + 1.0, dark), twice).other
    less = passed(setup, Light(dark, dark, dark + 1.0, dark), twice)
    v, u = np.mgrid[:60, :80]
    checker = ((u + v) % 2).astype(np.float32) * 2.0 - 1.0
    # A checkerboard has no mean: what is left of it is what passed straight through, nearly.
    straight = passed(setup, Light(dark, dark, checker, dark), twice).other * checker
    np.testing.assert_allclose(got, 100.0 * straight**2, rtol=5e-3)
    assert (even > straight).all()
    np.testing.assert_array_equal(less.other, even)


@pytest.mark.parametrize("share", [0.3, 1.0, 4.0])
def test_a_shifted_gaussian_filter_dims_the_laser_by_hand(share):
    """T = exp(-4 ln 2 (x / FWHM)^2) at the wavelength that the shift brings to the laser's."""
    for laser_nm in (690.0, 688.0):
        setup = sharp(laser=dataclasses.replace(nominal().laser, wavelength_nm=laser_nm))
        ones = np.ones((60, 80))
        got = passed(affected(setup, filter_shift={"shift_share": share}), light_of(ones, ones))
        s = np.sqrt(1.0 - share * (np.sin(field_angle(setup)) / 1.8) ** 2)

        def T(nm):
            return np.exp(-4.0 * math.log(2.0) * ((nm - 690.0) / 10.0) ** 2)

        np.testing.assert_allclose(got.laser, T(laser_nm / s) / T(laser_nm), rtol=1e-4)
        # The continuum changes with the band's width and with the black body's slope, by some per cent.
        photon = 14_387_768.8 / (690.0 * 12_000.0)
        black_body = s**-5.0 * np.expm1(photon) / np.expm1(photon / s)
        np.testing.assert_allclose(got.arc, s * black_body, rtol=1e-3)
        assert (np.abs(got.laser - 1.0) > 0.02).any()


@pytest.mark.parametrize(("right_deg", "down_deg"), [(4.0, 0.0), (-3.0, 5.0)])
def test_a_leaning_filter_is_met_at_the_angle_to_its_normal(right_deg, down_deg):
    """The axis keeps its light; elsewhere the shift is that of the angle between ray and leant normal."""
    setup, ones = sharp(), np.ones((60, 80))
    values = {"shift_share": 1.0, "tilt_right_deg": right_deg, "tilt_down_deg": down_deg}
    got = passed(affected(setup, filter_shift=values), light_of(ones, ones))
    normal = np.array([math.tan(math.radians(right_deg)), math.tan(math.radians(down_deg)), 1.0])
    normal /= np.linalg.norm(normal)
    xyz = rays(setup.camera)

    def laser(unit):
        sin2 = 1.0 - (unit @ normal) ** 2
        return np.exp(-4.0 * math.log(2.0) * (69.0 * (1.0 / np.sqrt(1.0 - sin2 / 1.8**2) - 1.0)) ** 2)

    want = laser(xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)) / laser(np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(got.laser, want, rtol=2e-4)
    assert np.ptp(want) > 0.1


def test_a_whole_shift_is_that_of_a_measured_filter():
    """A curve with the Gaussian's transmission dims as the Gaussian does, at any share."""
    wavelength = np.linspace(660.0, 720.0, 241)
    curve = FilterCurve(wavelength, np.exp2(-(((wavelength - 690.0) / 5.0) ** 2)), 1.8)
    for share in (0.5, 1.0, 3.0):
        effects = {"filter_shift": {"shift_share": share}}
        ones = np.ones((60, 80))
        gaussian = passed(affected(sharp(), **effects), light_of(ones, ones))
        measured = passed(affected(sharp(filter=curve), **effects), light_of(ones, ones))
        np.testing.assert_allclose(measured.laser, gaussian.laser, rtol=2e-3)
        np.testing.assert_allclose(measured.arc, gaussian.arc, rtol=2e-3)


def test_a_filter_that_stops_the_laser_is_refused():
    setup = affected(
        sharp(laser=dataclasses.replace(nominal().laser, wavelength_nm=650.0)),
        filter_shift={"shift_share": 1.0},
    )
    with pytest.raises(ValueError, match="does not pass the laser's 650 nm"):
        predict(setup, scenes.pose(), CONDITIONS["both"])


def test_leak_and_shift_together_are_the_whole_arc_behind_the_filter():
    """(1 + lines / continuum) continuum / continuum on axis = all of it over the continuum on axis."""
    setup = sharp()
    ones = np.ones((60, 80))
    leak, shift = {"line_width_nm": 20.0}, {"shift_share": 1.0}
    alone = [
        passed(affected(setup, **effects), light_of(ones)).arc
        for effects in ({"argon_line_leak": leak}, {"filter_shift": shift})
    ]
    together = passed(affected(setup, argon_line_leak=leak, filter_shift=shift), light_of(ones)).arc
    np.testing.assert_allclose(together, alone[0] * alone[1], rtol=1e-5)


def test_the_lens_cos4_stays_what_it_is():
    """Vignetting comes on top of it: an even plate under an even light, arc alone."""
    setup = sharp()
    ratio = charge(affected(setup, vignetting={"loss": 0.4}), CONDITIONS["arc"]) / charge(
        setup, CONDITIONS["arc"]
    )
    v, u = np.mgrid[:60, :80]
    rho2 = ((u - 39.5) ** 2 + (v - 29.5) ** 2) / 50.0**2
    np.testing.assert_allclose(ratio, 1.0 - 0.4 * rho2, rtol=1e-4)
    assert cos4(setup.camera).min() < 0.97


def test_a_filter_that_lets_no_laser_through_on_the_axis_leaves_finite_light():
    values = {"shift_share": 6.0, "tilt_right_deg": 15.0, "tilt_down_deg": 15.0}
    got = passed(affected(sharp(), filter_shift=values), light_of(BRIGHT, BRIGHT))
    assert np.isfinite(got.laser).all()
    assert got.laser.min() >= 0.0
