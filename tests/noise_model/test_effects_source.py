"""Source and illumination against formulas written out here."""

import dataclasses
import math

import numpy as np
import pytest
import scenes
from effect_scenes import (
    CONDITIONS,
    EXPOSURE_S,
    affected,
    charge,
    cos4,
    draws,
    light_of,
    nominal,
    on_the_plate,
    passed,
)
from scipy.interpolate import LinearNDInterpolator

from noise_model.condition import Condition
from noise_model.effects import REGISTRY, apply_setup_effects
from noise_model.forward import Renderer, pass_on, predict
from noise_model.instrument.argon import AR_I, line_weights
from noise_model.instrument.spectrum import FilterCurve
from noise_model.plan.noise import expected_speckle
from noise_model.view import View
from validation.figures.hemisphere import Hemisphere, reflected_radiance_extended

ARC = CONDITIONS["arc"]


def density(wavelength_nm):
    """A power through a real 690/10 filter's 0.011 at 690 nm, 0.342 at 696 nm and 1.008 at 697 nm."""
    power = math.log(0.997 / 0.331) / math.log(7.0 / 6.0)
    return 0.011 + 0.331 * (np.abs(wavelength_nm - 690.0) / 6.0) ** power


SAMPLES_NM = np.linspace(680.0, 700.0, 81)
MEASURED = FilterCurve(SAMPLES_NM, 10.0 ** -density(SAMPLES_NM), 1.8)


@pytest.mark.parametrize(
    ("effects", "center_mm", "radius_mm"),
    [
        ({"arc_length": {"height_mm": 1.5}}, (0.0, 0.0, 1.5), 3.0),
        ({"arc_length": {"height_mm": -1.0}}, (0.0, 0.0, -1.0), 3.0),
        ({"arc_deflection": {"x_mm": 1.0, "y_mm": -2.0}}, (1.0, -2.0, 0.0), 3.0),
        ({"arc_radius": {"radius_ratio": 1.5}}, (0.0, 0.0, 0.0), 4.5),
        (
            {
                "arc_length": {"height_mm": 1.0},
                "arc_radius": {"radius_ratio": 0.5},
                "arc_deflection": {"y_mm": 1.0},
            },
            (0.0, 1.0, 1.0),
            1.5,
        ),
    ],
)
@pytest.mark.parametrize("material", ["mild_steel", "zn_coated"])
def test_the_arc_stands_and_is_as_large_as_said(effects, center_mm, radius_mm, material):
    setup = nominal("flat", material, psf_sigma_px=0.0)
    arc = Hemisphere(np.array(center_mm), radius_mm, np.array([0.0, 0.0, 1.0]))
    rng = np.random.default_rng(3)
    pixels = rng.choice(80 * 60, 40, replace=False)
    points, omega_r = (values.reshape(-1, 3)[pixels] for values in on_the_plate(setup.camera))
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    L = reflected_radiance_extended(points, up, omega_r, arc, setup.material, setup.arc.radiance_e, nodes=40)
    wanted = L * cos4(setup.camera).ravel()[pixels]
    got = charge(affected(setup, **effects), ARC).ravel()[pixels]
    np.testing.assert_allclose(got, wanted, rtol=2e-3, atol=0.05)


def test_an_arc_on_a_corrugation_goes_up_and_down_with_it_and_stands_higher():
    """The height adds to the surface's below the arc."""
    setup = affected(nominal("corrugation"), arc_length={"height_mm": 2.0})
    straight = dataclasses.replace(
        nominal("corrugation"),
        arc=dataclasses.replace(setup.arc, center_in_tool_mm=(0.0, 0.0, 3.5)),
    )
    np.testing.assert_array_equal(charge(setup, ARC), charge(straight, ARC))


def test_a_flickering_arc_is_one_mode_in_proportion_to_its_light():
    setup = nominal()
    flickering = affected(setup, arc_flicker={"sigma_rel": 0.2})
    for condition in CONDITIONS.values():
        steady, got = predict(setup, scenes.pose(), condition), predict(flickering, scenes.pose(), condition)
        np.testing.assert_array_equal(got.mean_e, steady.mean_e)
        np.testing.assert_array_equal(got.variance_e2, steady.variance_e2)
    arc = charge(setup, ARC)
    got = predict(flickering, scenes.pose(), CONDITIONS["both"])
    np.testing.assert_allclose(got.modes_e["arc_flicker"], 0.2 * arc, rtol=1e-5)


def test_the_filter_leaks_whatever_way_the_arcs_light_came():
    """What fume scatters goes through it as what a plate reflects does."""
    setup, fume = nominal("flat", psf_sigma_px=0.0), {"fume": {"extinction_per_m": 2.0, "scatter": 0.5}}
    leak = {"argon_line_leak": {"line_width_nm": 20.0}}

    def arc(level_e, **effects):
        return passed(affected(setup, **effects), light_of(np.full((60, 80), level_e)), ARC).arc

    leaks, scattered = arc(1.0, **leak), arc(0.0, **fume)
    assert scattered.min() > 10.0
    np.testing.assert_allclose(arc(0.0, **fume, **leak), leaks * scattered, rtol=1e-5)
    np.testing.assert_allclose(arc(100.0, **fume, **leak), leaks * arc(100.0, **fume), rtol=1e-5)


def test_the_mode_is_what_an_arc_of_another_output_adds():
    """Through all that acts on the light: fume, filter, glare, window, lens and exposure."""
    others = {
        name: REGISTRY[name].typical
        for name in ("argon_line_leak", "fume", "filter_shift", "veiling_glare", "dirty_window", "defocus")
    }
    setup = affected(nominal(), arc_flicker={"sigma_rel": 0.1}, exposure_drift={"rate_per_s": 0.2}, **others)
    got = predict(setup, scenes.pose(), CONDITIONS["both"])
    brighter = Condition(1.0, 1.1, EXPOSURE_S, CONDITIONS["both"].timestamp_s)
    more = predict(setup, scenes.pose(), brighter).mean_e - got.mean_e
    np.testing.assert_allclose(got.modes_e["arc_flicker"], more, rtol=2e-3, atol=0.05)


def test_many_arcs_flicker_by_the_stated_share():
    """The frames' level has mean 1 and the stated spread; what is left once it is known is noise."""
    deep = nominal(width=40, height=30, bits=12, gain_e_per_dn=20.0, full_well_e=80_000.0)
    setup, renderer = affected(deep, arc_flicker={"sigma_rel": 0.3}), Renderer()
    expected = predict(setup, scenes.pose(), ARC, renderer=renderer)
    frames = draws(setup, ARC, 300, renderer=renderer)
    mode = (expected.modes_e["arc_flicker"] / setup.sensor.gain_e_per_dn).astype(np.float64)
    weight = mode / expected.variance_dn2
    number = np.sum(weight * (frames - expected.mean_dn), axis=(1, 2)) / np.sum(weight * mode)
    assert abs(number.mean()) < 4.0 / math.sqrt(300)
    # Log-normal of a spread of 0.3: its fourth moment is 4.7, so variances scatter by sqrt(3.7 / n).
    assert number.var() == pytest.approx(1.0, abs=4.0 * math.sqrt(3.7 / 300))
    assert number.min() > -1.0 / 0.3
    rest = frames - expected.mean_dn - number[:, np.newaxis, np.newaxis] * mode
    # Shot noise goes with the level, whose mean is 1.
    assert np.mean(rest**2 / expected.variance_dn2) == pytest.approx(1.0, abs=0.03)


def test_the_line_that_leaks_through_a_gaussian_filter():
    """The lines' sum and a plain sum over the continuum, wavelengths shifted by hand."""
    setup = nominal("flat", psf_sigma_px=0.0)
    ones = np.ones((60, 80))
    got = passed(affected(setup, argon_line_leak={"line_width_nm": 20.0}), light_of(ones)).arc
    k, hc = 1.380649e-23, 6.62607015e-34 * 299792458.0
    wavelength = np.linspace(650.0, 730.0, 80001)

    def planck(nm):
        return nm**-5.0 / np.expm1(hc / (nm * 1e-9 * k * 12000.0))

    def gaussian(nm, theta):
        at_normal = nm / np.sqrt(1.0 - (np.sin(theta) / 1.8) ** 2)
        return np.exp(-4.0 * math.log(2.0) * ((at_normal - 690.0) / 10.0) ** 2)

    for row, column in ((30, 40), (0, 0), (59, 79), (30, 0)):
        ray = [(column - 39.5) / setup.camera.fx, (row - 29.5) / setup.camera.fy]
        theta = math.atan(math.hypot(*ray))
        continuum = np.sum(planck(wavelength) * gaussian(wavelength, theta)) * 0.001
        leak = 0.0
        for line in AR_I:
            boltzmann = math.exp(-hc * 100.0 * (line.E_k_per_cm - 107496.4166) / (k * 12000.0))
            weight = line.g_k * line.A_ki_per_s / line.wavelength_nm / (3 * 6.39e6 / 696.5431) * boltzmann
            leak += 20.0 * planck(696.5431) * weight * gaussian(line.wavelength_nm, theta)
        assert got[row, column] == pytest.approx(1.0 + leak / continuum, rel=1e-4)
    assert got[30, 40] > got[0, 0]


def test_an_edge_steeper_than_stated_lets_less_of_the_line_through_off_axis():
    """As a Gaussian with the real filter's slope: what is left falls by its densities from 696.54 nm on."""
    setup = nominal("flat", psf_sigma_px=0.0)
    ones = np.ones((60, 80))
    stated, steep = (
        passed(affected(setup, argon_line_leak={"line_width_nm": 20.0, **more}), light_of(ones)).arc - 1.0
        for more in ({}, {"edge_od_per_nm": 0.5})
    )
    theta = math.atan(math.hypot(39.5 / setup.camera.fx, 29.5 / setup.camera.fy))
    there_nm = 696.5431 / math.sqrt(1.0 - (math.sin(theta) / 1.8) ** 2)
    assert steep[0, 0] / stated[0, 0] == pytest.approx(10.0 ** (-0.5 * (there_nm - 696.5431)), rel=1e-3)
    assert steep[30, 40] / stated[30, 40] == pytest.approx(1.0, abs=1e-3)


def test_the_line_that_leaks_through_a_measured_filter():
    """The lines through the densities, shifted by hand, over a continuum taken at the band's middle.

    At the angle that brings 697 nm to the line it is the measured 1.008.
    """
    setup = dataclasses.replace(nominal("flat", psf_sigma_px=0.0), filter=MEASURED)
    width_nm = 30.0
    leaking = affected(setup, argon_line_leak={"line_width_nm": width_nm})
    ones = np.ones((60, 80))
    got = passed(leaking, light_of(ones)).arc.astype(np.float64) - 1.0
    assert density(np.array([690.0, 696.0, 697.0])) == pytest.approx([0.011, 0.342, 1.008])
    band_nm = float(np.sum(10.0 ** -density(np.arange(680.0, 700.0, 0.001))) * 0.001)

    def leak(theta, wavelengths_nm, weights):
        s = math.sqrt(1.0 - (math.sin(theta) / 1.8) ** 2)
        passing = 10.0 ** -density(np.array(wavelengths_nm) / s)
        photon = 14_387_768.8 / 12_000.0
        band = s * band_nm * (696.5431 / (690.0 * s)) ** 5.0
        band *= math.expm1(photon / 696.5431) / math.expm1(photon / (690.0 * s))
        return width_nm * float(np.sum(weights * passing)) / band

    weights = line_weights(AR_I, 12_000.0)
    for row, column in ((30, 40), (30, 0), (0, 0)):
        theta = math.atan(math.hypot((column - 39.5) / setup.camera.fx, (row - 29.5) / setup.camera.fy))
        wanted = leak(theta, [line.wavelength_nm for line in AR_I], weights)
        assert got[row, column] == pytest.approx(wanted, rel=5e-3)
    s = 696.5431 / 697.0
    theta = math.asin(1.8 * math.sqrt(1.0 - s**2))
    assert leak(theta, [696.5431], [1.0]) == pytest.approx(width_nm * 10.0**-1.008 / band_nm, rel=0.03)
    assert got[30, 40] > got[30, 0] > got[0, 0]


def test_a_drift_settles():
    """exp(rate t) at first, exp(rate settle) in the end, on the laser or on all charge."""
    for name, laser_alone in (("laser_power_drift", True), ("exposure_drift", False)):
        setup = affected(nominal(), **{name: {"rate_per_s": -0.02, "settle_s": 20.0}})
        for t, wanted in (
            (0.0, 1.0),
            (0.5, math.exp(-0.01)),
            (10.0, math.exp(-0.4 * (1 - math.exp(-0.5)))),
            (1e4, math.exp(-0.4)),
        ):
            ratio = [
                charge(setup, Condition(*on, EXPOSURE_S, t)).sum()
                / charge(nominal(), Condition(*on, EXPOSURE_S, t)).sum()
                for on in ((1.0, 0.0), (0.0, 1.0))
            ]
            assert ratio[0] == pytest.approx(wanted, rel=2e-3 if t == 0.5 else 1e-5)
            assert ratio[1] == pytest.approx(1.0 if laser_alone else ratio[0], rel=1e-5)


def test_a_drift_swings():
    """To and fro about its middle, at its frequency."""
    swing = {"swing_sin": 0.06, "swing_cos": -0.08, "swing_hz": 2.5}
    setup = affected(nominal(), laser_power_drift=swing)
    for t, wanted in ((0.0, -0.08), (0.1, 0.06), (0.2, 0.08), (0.3, -0.06), (0.4, -0.08)):
        on = Condition(1.0, 0.0, EXPOSURE_S, t)
        assert charge(setup, on).sum() / charge(nominal(), on).sum() == pytest.approx(
            math.exp(wanted), rel=1e-5
        )


def test_no_drift_runs_away():
    setup = affected(nominal(), exposure_drift={"rate_per_s": 1.0, "settle_s": 1000.0})
    hour = Condition(1.0, 1.0, EXPOSURE_S, 3600.0)
    assert charge(setup, hour).max() < 60.0 * charge(nominal(), hour).max()


def test_speckle_has_its_contrast_and_its_grain():
    """Log-normal draws: mean 1, the stated contrast, ln correlated as exp(-d^2 / 4 g^2)."""
    setup = affected(nominal(width=160, height=120), laser_speckle={"contrast": 0.4, "grain_px": 2.0})
    flat = np.full((120, 160), 1000.0)
    rng = np.random.default_rng(8)
    fields = np.array(
        [passed(setup, light_of(0.0 * flat, flat), rng=rng).laser / 1000.0 for _ in range(30)],
        dtype=np.float64,
    )
    # 30 fields of 120 x 160 px hold some 30 * 19200 / (4 pi 2^2) = 11 000 grains.
    assert fields.mean() == pytest.approx(1.0, abs=4.0 * 0.4 / math.sqrt(11000))
    assert fields.std() == pytest.approx(0.4, rel=0.05)
    assert fields.min() > 0.0
    ln = np.log(fields) - np.log(fields).mean()
    for lag in (1, 2, 3, 5):
        for axis in (1, 2):
            a = np.take(ln, np.arange(ln.shape[axis] - lag), axis=axis)
            b = np.take(ln, np.arange(lag, ln.shape[axis]), axis=axis)
            assert np.mean(a * b) / np.mean(ln**2) == pytest.approx(math.exp(-(lag**2) / 16.0), abs=0.03)
    # At the rim as in the middle.
    assert fields[:, :2].std() == pytest.approx(0.4, rel=0.15)


def speckle_at(T_base_tool, part_seed):
    """The speckle's pattern (60, 80) from a pose, and the part's points that the pixels show, base frame."""
    setup = affected(nominal("flat"), laser_speckle={"contrast": 0.4, "grain_px": 2.0})
    true = apply_setup_effects(setup)
    view = dataclasses.replace(View.of(true, T_base_tool), part_seed=part_seed)
    light = light_of(np.zeros((60, 80)), np.full((60, 80), 1000.0))
    pass_on(true, light, view, CONDITIONS["laser"], np.random.default_rng(1))
    return np.log(light.laser / 1000.0), view.surface[0]


@pytest.mark.slow
def test_speckle_lies_on_the_part_and_moves_with_it():
    still, points = speckle_at(scenes.pose(), 5)
    np.testing.assert_array_equal(speckle_at(scenes.pose(), 5)[0], still)
    another = speckle_at(scenes.pose(), 6)[0]
    assert abs(np.corrcoef(still.ravel(), another.ravel())[0, 1]) < 0.1
    # A level tool that has moved to the side and on sees the pattern where the part's points have gone.
    moved, there = speckle_at(scenes.pose((6.0, 3.5, 0.0)), 5)
    assert abs(np.corrcoef(still.ravel(), moved.ravel())[0, 1]) < 0.2
    of_part = LinearNDInterpolator(points[..., :2].reshape(-1, 2), still.ravel())
    expected = of_part(there[..., :2].reshape(-1, 2))
    seen = np.isfinite(expected)
    assert seen.mean() > 0.5
    assert np.corrcoef(expected[seen], moved.ravel()[seen])[0, 1] > 0.95


def test_the_optics_say_how_speckle_is():
    setup = nominal()
    camera = setup.camera
    fine, coarse = (
        expected_speckle(dataclasses.replace(setup, camera=dataclasses.replace(camera, f_number=f_number)))
        for f_number in (0.5, 2000.0)
    )
    # Grains much larger than a pixel are fully developed, 0.28 lambda N' of 1 sigma; small ones average out.
    assert coarse["contrast"] == pytest.approx(1.0, abs=0.01)
    assert coarse["grain_px"] > 5.0
    assert fine["contrast"] < 0.03
    assert fine["grain_px"] == pytest.approx(1.0 / math.sqrt(12.0), rel=0.01)


def test_speckle_scatters_the_laser_alone():
    setup = nominal(psf_sigma_px=1.0)
    got = predict(affected(setup, laser_speckle={"contrast": 0.3}), scenes.pose(), CONDITIONS["both"])
    before = predict(setup, scenes.pose(), CONDITIONS["both"])
    laser = charge(setup, CONDITIONS["laser"])
    np.testing.assert_allclose(got.variance_e2 - before.variance_e2, (0.3 * laser) ** 2, rtol=1e-3, atol=0.5)
    np.testing.assert_array_equal(got.mean_e, before.mean_e)
