import dataclasses

import numpy as np
import pytest
from scipy import constants, integrate

from noise_model.instrument.argon import AR_I, REFERENCE_NM, line_weights
from noise_model.instrument.spectrum import (
    ArcSpectrum,
    CurveError,
    Filter,
    FilterCurve,
    angle_shift,
    laser_transmission,
    line_to_continuum,
    passed_continuum,
    passed_lines,
    planck,
    transmission,
)

GAUSSIAN = Filter(690.0, 10.0, 1.8)

# Measured: 690, 696 and 697 nm of a 690/10 filter. The rest only gives it a left edge and two ends.
WAVELENGTH = np.array([670.0, 678.0, 681.0, 683.0, 684.0, 690.0, 696.0, 697.0, 699.0, 702.0, 710.0])
DENSITY = np.array([6.0, 5.0, 2.5, 1.008, 0.342, 0.011, 0.342, 1.008, 2.5, 5.0, 6.0])
MEASURED = FilterCurve(WAVELENGTH, 10.0**-DENSITY, 1.8)

BOTH = pytest.mark.parametrize("optics", [GAUSSIAN, MEASURED], ids=["gaussian", "measured"])
FIELD = np.radians(np.linspace(0.0, 20.0, 21))


def test_a_black_body_radiates_stefan_boltzmann_and_peaks_where_wien_says():
    for temperature_k in (3000.0, 12_000.0):
        power, _ = integrate.quad(
            lambda x, t=temperature_k: float(planck(np.exp(x), t) * np.exp(x)),
            np.log(20.0),
            np.log(1e7),
            limit=400,
        )
        assert np.pi * power == pytest.approx(constants.Stefan_Boltzmann * temperature_k**4, rel=1e-5)
        wavelength_nm = np.linspace(100.0, 2000.0, 190_001)
        peak_nm = wavelength_nm[planck(wavelength_nm, temperature_k).argmax()]
        assert peak_nm == pytest.approx(1e9 * constants.Wien / temperature_k, abs=0.02)


def test_a_black_body_far_in_the_blue_radiates_nothing():
    assert planck(1.0, 300.0) == 0.0


@pytest.mark.parametrize(
    ("wavelength_nm", "temperature_k"), [(0.0, 5000.0), (-690.0, 5000.0), (690.0, 0.0), (690.0, np.inf)]
)
def test_an_impossible_black_body_is_refused(wavelength_nm, temperature_k):
    with pytest.raises(ValueError, match=r"is > 0|must be > 0"):
        planck(wavelength_nm, temperature_k)


def test_the_lines_are_argons():
    # A line's wavelength in vacuum is 1 / (E_k - E_i): the two strong ones end on 4s[3/2]2, 93143.7600 1/cm.
    for line in AR_I:
        if line.wavelength_nm in (696.5431, 706.7218, 714.7042):
            in_vacuum = 1e7 / (line.E_k_per_cm - 93143.7600)
            assert in_vacuum / line.wavelength_nm == pytest.approx(1.000276, abs=2e-6)


def test_the_weights_follow_boltzmann():
    strong = next(line for line in AR_I if line.wavelength_nm == 706.7218)
    hot = (5 * 3.80e6 / 706.7218) / (3 * 6.39e6 / 696.5431)
    assert line_weights((strong,), 1e9)[0] == pytest.approx(hot, rel=1e-6)
    cold = hot * np.exp(constants.h * constants.c * 20671.65 / (constants.k * 2000.0))
    assert line_weights((strong,), 2000.0)[0] == pytest.approx(cold, rel=1e-5)
    weights = line_weights(AR_I, 12_000.0)
    assert np.count_nonzero(weights > 0.99) == 2
    with pytest.raises(ValueError, match="excitation"):
        line_weights(AR_I, 0.0)


def test_the_equivalent_width_of_argon_in_equilibrium():
    """Saha, Boltzmann and Kramers at one atmosphere: the numbers in ArcSpectrum's docstring."""
    k, h, wavelength_m = constants.k, constants.h, 1e-9 * REFERENCE_NM
    for temperature_k, width_nm in ((10_000.0, 47.0), (12_000.0, 24.0), (16_000.0, 10.0)):
        ion = 4.0 + 2.0 * np.exp(-1431.58 * 1.438777 / temperature_k)
        thermal = (2.0 * np.pi * constants.m_e * k * temperature_k / h**2) ** 1.5
        saha = 2.0 * ion * thermal * np.exp(-15.7596 * constants.e / (k * temperature_k))
        particles = constants.atm / (k * temperature_k)
        electrons = -saha + np.sqrt(saha**2 + saha * particles)
        atoms = particles - 2.0 * electrons
        excited = 3.0 * atoms * np.exp(-107496.4166 * 1.438777 / temperature_k)
        line = h * constants.c / (4.0 * np.pi * wavelength_m) * 6.39e6 * excited
        continuum = 1.632e-43 * 1.7 * electrons**2 / (wavelength_m**2 * np.sqrt(temperature_k))
        assert line / (1e-9 * continuum) == pytest.approx(width_nm, rel=0.02)


def test_a_filters_own_numbers():
    assert transmission(GAUSSIAN, 690.0) == 1.0
    np.testing.assert_allclose(transmission(GAUSSIAN, [685.0, 695.0]), 0.5)
    measured = transmission(MEASURED, [690.0, 696.0, 697.0])
    np.testing.assert_allclose(measured, 10.0 ** -np.array([0.011, 0.342, 1.008]), rtol=1e-12)
    between = transmission(MEASURED, np.linspace(690.0, 699.0, 200))
    assert (np.diff(between) < 0.0).all()
    assert 0.2 < transmission(MEASURED, REFERENCE_NM) < 0.26
    np.testing.assert_array_equal(transmission(MEASURED, [600.0, 669.99, 710.01]), 0.0)


def test_a_transmission_of_zero_blocks():
    opaque = 10.0**-DENSITY * (np.abs(WAVELENGTH - 690.0) < 10.0)
    assert transmission(FilterCurve(WAVELENGTH, opaque, 1.8), 705.0) == 0.0


def test_the_angle_shift():
    assert angle_shift(0.0, 1.8) == 1.0
    assert 690.0 * angle_shift(np.radians(10.0), 1.8) == pytest.approx(686.782, abs=1e-3)
    np.testing.assert_allclose(angle_shift([-0.2, 0.2], 2.0), np.sqrt(1.0 - np.sin(0.2) ** 2 / 4.0))
    with pytest.raises(ValueError, match="90 deg"):
        angle_shift(np.pi / 2.0, 1.8)


@BOTH
def test_every_feature_moves_by_the_angle_shift(optics):
    s = angle_shift(FIELD, 1.8)
    for feature_nm in (684.0, 690.0, 696.0):
        np.testing.assert_allclose(
            transmission(optics, feature_nm * s, FIELD), transmission(optics, feature_nm), rtol=1e-9
        )


@BOTH
def test_the_passed_continuum_against_a_plain_sum(optics):
    spectrum = ArcSpectrum()
    wavelength_nm = np.linspace(640.0, 730.0, 900_001)
    for theta in (0.0, 0.15, 0.3):
        product = planck(wavelength_nm, 12_000.0) * transmission(optics, wavelength_nm, theta)
        plain = np.trapezoid(product, wavelength_nm)
        assert passed_continuum(optics, spectrum, theta) == pytest.approx(plain, rel=1e-6)


@BOTH
def test_off_axis_the_laser_dims_and_the_continuum_hardly(optics):
    laser = laser_transmission(optics, 690.0, FIELD)
    assert laser[0] == 1.0
    assert (np.diff(laser) < 0.0).all()
    assert laser[-1] < 0.02
    continuum = passed_continuum(optics, ArcSpectrum(), FIELD)
    np.testing.assert_allclose(continuum / continuum[0], 1.0, atol=0.04)


@BOTH
def test_the_line_leaks_more_on_axis_than_off(optics):
    alone = ArcSpectrum(lines=tuple(line for line in AR_I if line.wavelength_nm == REFERENCE_NM))
    ratio = line_to_continuum(optics, alone, FIELD)
    assert (np.diff(ratio) < 0.0).all()
    equal_width = passed_continuum(optics, alone) / planck(REFERENCE_NM, 12_000.0)
    on_axis = 20.0 * transmission(optics, REFERENCE_NM) / equal_width
    assert ratio[0] == pytest.approx(on_axis)
    assert ratio[-1] < 0.05 * ratio[0]


def test_neighbours_come_into_the_band_as_the_line_leaves_it():
    spectrum = ArcSpectrum()
    whole = passed_lines(GAUSSIAN, spectrum, FIELD)
    alone = passed_lines(GAUSSIAN, dataclasses.replace(spectrum, lines=(AR_I[6],)), FIELD)
    assert whole[0] / alone[0] < 1.6
    assert whole[10] / alone[10] > 2.0


def test_no_line_no_leak():
    np.testing.assert_array_equal(line_to_continuum(GAUSSIAN, ArcSpectrum(line_width_nm=0.0), FIELD), 0.0)


def test_shapes_are_kept():
    theta = FIELD[:6].reshape(2, 3)
    for function in (passed_continuum, passed_lines, line_to_continuum):
        assert function(MEASURED, ArcSpectrum(), theta).shape == (2, 3)
        assert function(MEASURED, ArcSpectrum()).shape == ()
    assert transmission(GAUSSIAN, np.full((4, 1), 690.0), FIELD[:5]).shape == (4, 5)
    assert laser_transmission(MEASURED, 690.0, theta).shape == (2, 3)


def test_a_laser_beside_the_passband_is_refused():
    with pytest.raises(ValueError, match="658 nm"):
        laser_transmission(GAUSSIAN, 658.0, FIELD)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"center_nm": 0.0}, "center_nm"),
        ({"fwhm_nm": -1.0}, "fwhm_nm"),
        ({"effective_index": 0.9}, "effective_index"),
        ({"effective_index": np.nan}, "effective_index"),
    ],
)
def test_an_impossible_filter_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(GAUSSIAN, **change)


def test_a_passband_that_reaches_down_to_zero_has_no_continuum():
    with pytest.raises(ValueError, match="wavelength"):
        passed_continuum(Filter(690.0, 300.0, 1.8), ArcSpectrum())


def spoiled(wavelength=None, density=None):
    """The measured curve with samples {place: value} exchanged."""
    wavelength_nm, transmitted = WAVELENGTH.copy(), 10.0**-DENSITY
    for place, value in (wavelength or {}).items():
        wavelength_nm[place] = value
    for place, value in (density or {}).items():
        transmitted[place] = value
    return wavelength_nm, transmitted


@pytest.mark.parametrize(
    ("curve", "message", "sample"),
    [
        (spoiled(wavelength={4: 682.0}), "682 nm does not come after", 4),
        (spoiled(wavelength={4: 683.0}), "683 nm does not come after", 4),
        ((WAVELENGTH[::-1], 10.0**-DENSITY), "rise", 1),
        (spoiled(wavelength={0: -670.0}), "must be > 0", 0),
        (spoiled(wavelength={10: np.inf}), "must be > 0", 10),
        (spoiled(density={3: -1e-4}), "must be >= 0", 3),
        (spoiled(density={3: np.nan}), "must be >= 0", 3),
        (spoiled(density={5: 97.5}), "must be <= 1, an optical density >= 0", 5),
        ((WAVELENGTH[:-3], 10.0 ** -DENSITY[:-3]), "cover the band: at its end, 697 nm, 10 %", 7),
        ((WAVELENGTH[5:], 10.0 ** -DENSITY[5:]), "at its end, 690 nm, 1e.02 %", 0),
        ((WAVELENGTH, np.zeros(11)), "passes nothing", None),
        ((WAVELENGTH[:2], np.zeros(2)), "at least 3", None),
        ((WAVELENGTH, np.zeros(10)), "at least 3", None),
    ],
)
def test_a_curve_that_is_no_filters_is_refused(curve, message, sample):
    with pytest.raises(CurveError, match=message) as caught:
        FilterCurve(*curve, 1.8)
    assert caught.value.sample == sample
    with pytest.raises(ValueError, match="effective_index"):
        FilterCurve(WAVELENGTH, 10.0**-DENSITY, 0.5)


@pytest.mark.parametrize(
    "change",
    [{"continuum_temperature_k": 0.0}, {"excitation_temperature_k": np.nan}, {"line_width_nm": -1.0}],
)
def test_an_impossible_spectrum_is_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        ArcSpectrum(**change)
