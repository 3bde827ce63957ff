import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.goniometer import GreyResponse, Settings, average
from calibration.reading_noise import ReadingNoise, estimate_noise
from examples.make_goniometer import simulate
from noise_model.surface.brdf import MILD_STEEL, ZN_COATED, Material


def settings(*rows: tuple[float, float, float], source: float = 1.0) -> Settings:
    theta_i, theta_r, phi_r = np.array(rows, dtype=float).T
    return Settings(theta_i, theta_r, phi_r, np.full(len(rows), source))


@pytest.mark.slow
@given(st.floats(0.2, 3.0), st.floats(0.0, 1.0), st.floats(0.0, 60.0))
def test_the_response_comes_back(gamma: float, light: float, black_dn: float) -> None:
    response = GreyResponse(gamma, black_dn, 255.0)
    # Grey levels next to black have lost what a high gamma does to a faint light.
    assert response.light(response.gray_level(np.array(light))) ** gamma == pytest.approx(
        light**gamma, abs=1e-12
    )


def test_gray_levels_follow_eq_20() -> None:
    response = GreyResponse(0.45, 10.0, 210.0)
    np.testing.assert_allclose(
        response.gray_level(np.array([0.0, 0.5, 1.0])), [10.0, 10 + 200 * 0.5**0.45, 210]
    )
    assert response.light(np.array(0.0)) < 0.0


@pytest.mark.parametrize("source", [1.0, 2.5e-4])
def test_light_is_reflectance_times_irradiance(source: float) -> None:
    # Written out in angles: in the plane of incidence alpha = (theta_r - theta_i) / 2.
    sent = settings((40.0, 55.0, 0.0), source=source).light(ZN_COATED)
    lobe = 0.153 / math.cos(math.radians(55.0)) * math.exp(-8.331 * math.radians(7.5) ** 2)
    assert sent == pytest.approx((0.495 + lobe) * math.cos(math.radians(40.0)) * source)


def test_alpha_is_zero_in_the_mirror_direction_alone() -> None:
    stood = settings((30, 30, 0), (30, 50, 0), (30, -30, 0), (30, 30, 180), (45, 45, 90), (0, 0, 0))
    np.testing.assert_allclose(
        np.degrees(stood.alpha), [0, 10, 30, 30, math.degrees(math.atan(math.sqrt(0.5))), 0], atol=1e-6
    )
    assert stood.light(MILD_STEEL).argmax() in (0, 5)


def test_equal_settings_are_averaged_in_their_order() -> None:
    rows = [(60.0, 10.0, 0.0), (20.0, 30.0, 0.0), (60.0, 10.0, 0.0), (60.0, 10.0, 0.0), (20.0, 30.0, 5.0)]
    read = average(settings(*rows), np.array([10.0, 50.0, 11.0, 15.0, 70.0]))
    np.testing.assert_array_equal(read.settings.theta_i_deg, [60.0, 20.0, 20.0])
    np.testing.assert_array_equal(read.settings.phi_r_deg, [0.0, 0.0, 5.0])
    np.testing.assert_array_equal(read.gray_level, [12.0, 50.0, 70.0])
    np.testing.assert_array_equal(read.repeats, [3.0, 1.0, 1.0])
    np.testing.assert_array_equal(read.group, [0, 1, 0, 0, 2])
    np.testing.assert_allclose(read.variance, [7.0, np.nan, np.nan])
    np.testing.assert_allclose(read.standard_error, [math.sqrt(7.0 / 3.0), np.nan, np.nan])


def test_a_source_at_another_distance_is_another_setting() -> None:
    near, far = settings((40.0, 40.0, 0.0)), settings((40.0, 40.0, 0.0), source=0.25)
    both = Settings(*(np.append(getattr(near, f), getattr(far, f)) for f in vars(near)))
    assert len(average(both, np.array([200.0, 50.0])).settings) == 2


def test_simulated_readings_have_the_stated_mean_and_noise() -> None:
    stood = Settings.in_plane([20.0, 60.0], [10.0, 60.0])
    response, noise = GreyResponse(0.45, 10.0, 255.0), ReadingNoise(0.8, 0.02)
    rng = np.random.default_rng(1)
    read = average(*simulate(stood, ZN_COATED, 0.7, response, noise, 4000, rng))
    expected = response.gray_level(0.7 * stood.light(ZN_COATED))
    variance = noise.variance(expected - 10.0) + 1.0 / 12.0
    assert (np.abs(read.gray_level - expected) < 4.0 * np.sqrt(variance / 4000)).all()
    np.testing.assert_allclose(read.variance, variance, rtol=0.1)
    assert (read.repeats == 4000).all()


def test_simulated_readings_stay_on_the_scale() -> None:
    rng = np.random.default_rng(2)
    stood = Settings.in_plane([0.0], [0.0])
    noise, response = ReadingNoise(200.0, 0.0), GreyResponse()
    _, gray_level = simulate(stood, Material("m", 1.0, 0.0, 1.0), 0.5, response, noise, 200, rng)
    assert (gray_level.min(), gray_level.max()) == (0.0, 255.0)


@pytest.mark.parametrize("repeats", [2, 5, 20])
def test_noise_is_found_from_repeats(repeats: int) -> None:
    rng = np.random.default_rng(repeats)
    true = ReadingNoise(1.5, 0.02)
    signal = np.geomspace(5.0, 220.0, 4000)
    squares = true.variance(signal) * rng.chisquare(repeats - 1, signal.size) / (repeats - 1)
    found = estimate_noise(signal, squares, np.full(signal.size, repeats - 1.0))
    assert found.additive_dn == pytest.approx(1.5, rel=0.05)
    assert found.relative == pytest.approx(0.02, rel=0.05)


def test_noise_that_lacks_a_part_has_none_of_it() -> None:
    signal = np.linspace(10.0, 200.0, 50)
    ones = np.ones_like(signal)
    assert estimate_noise(signal, 4.0 * ones, 19 * ones).relative == pytest.approx(0.0, abs=1e-9)
    assert estimate_noise(signal, (0.01 * signal) ** 2, 19 * ones).additive_dn < 1e-3
    nothing = estimate_noise(signal, 0.0 * ones, 19 * ones)
    assert 0 < nothing.additive_dn < 1e-3


def test_a_reading_that_says_nothing_of_the_noise_is_left_out() -> None:
    signal, freedom = np.linspace(10.0, 200.0, 50), np.full(50, 19.0)
    squares = np.full(50, 4.0)
    squares[3], freedom[3] = 1e9, 0.0
    assert estimate_noise(signal, squares, freedom).additive_dn == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gamma": 0.0}, "gamma = 0.0: must be > 0"),
        ({"gamma": math.nan}, "gamma = nan: must be > 0"),
        ({"gamma": math.inf}, "gamma = inf"),
        ({"black_dn": 255.0}, "must be above black"),
        ({"saturation_dn": math.nan}, "must be above black"),
    ],
)
def test_a_response_that_makes_no_sense_is_refused(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GreyResponse(**arguments)


@pytest.mark.parametrize(
    ("row", "source", "message"),
    [
        ((90.0, 0.0, 0.0), 1.0, "theta_i_deg"),
        ((-1.0, 0.0, 0.0), 1.0, "theta_i_deg"),
        ((0.0, -90.0, 0.0), 1.0, "theta_r_deg"),
        ((0.0, math.nan, 0.0), 1.0, "theta_r_deg"),
        ((0.0, 0.0, math.inf), 1.0, "phi_r_deg"),
        ((0.0, 0.0, 0.0), 0.0, "intensity"),
    ],
)
def test_a_setting_that_cannot_be_is_refused(
    row: tuple[float, float, float], source: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        settings(row, source=source)


def test_readings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="one finite grey level"):
        average(settings((0.0, 0.0, 0.0)), np.array([math.nan]))
    with pytest.raises(ValueError, match="one finite grey level"):
        average(settings((0.0, 0.0, 0.0)), np.array([1.0, 2.0]))
    with pytest.raises(ValueError, match="both must be >= 0"):
        ReadingNoise(-1.0, 0.0)
