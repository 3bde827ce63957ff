import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from noise_model.instrument.sensor import (
    Sensor,
    SensorResponse,
    cut_moments,
    dark_part_e2,
    electrons_per_dn,
    expose,
    linearise,
    respond,
    respond_moments,
    saturation_dn,
    variance_e2,
)

LINEAR = Sensor(
    bits=8, gain_e_per_dn=80.0, black_level_dn=8.0, read_noise_e=40.0, full_well_e=20000.0, gamma=1.0
)
RESPONSES = [
    pytest.param({"gamma": gamma, "bend": bend}, id=f"gamma {gamma:g}, bend {bend:g}")
    for gamma, bend in [(0.45, 0.0), (0.7, 0.0), (1.0, 0.0), (1.6, 0.0), (0.7, 0.3), (1.0, -0.3), (1.3, 0.45)]
]


@st.composite
def sensors(draw):
    return Sensor(
        bits=draw(st.integers(8, 16)),
        gain_e_per_dn=draw(st.floats(0.05, 200.0)),
        black_level_dn=draw(st.floats(0.0, 64.0)),
        read_noise_e=draw(st.floats(0.0, 100.0)),
        full_well_e=draw(st.floats(1e3, 2e5)),
        gamma=draw(st.floats(0.4, 2.5)),
        bend=draw(st.sampled_from([0.0, -0.45, -1e-9, 0.2, 0.45])),
    )


@pytest.mark.slow
@given(sensors(), st.floats(1e-3, 1.0), st.sampled_from([-1.0, 1.0]))
def test_linearise_undoes_respond(sensor, share, sign):
    # Below a thousandth of the well a steep gamma sinks in the rounding of the black level.
    electrons = sign * share * sensor.full_well_e
    assert linearise(respond(electrons, sensor), sensor) == pytest.approx(electrons, rel=1e-5)
    assert linearise(sensor.black_level_dn, sensor) == 0.0


@given(sensors())
def test_the_response_rises_from_the_black_level_to_the_full_well(sensor):
    electrons = np.linspace(-0.1, 1.0, 200) * sensor.full_well_e
    assert (np.diff(respond(electrons, sensor)) > 0).all()
    assert respond(0.0, sensor) == sensor.black_level_dn
    assert respond(sensor.full_well_e, sensor) == pytest.approx(
        sensor.black_level_dn + (1.0 - sensor.bend) * sensor.full_well_e / sensor.gain_e_per_dn
    )


@pytest.mark.parametrize("response", RESPONSES)
def test_negative_electrons_mirror_positive_ones_about_the_black_level(response):
    sensor = dataclasses.replace(LINEAR, **response)
    above = respond(300.0, sensor) - sensor.black_level_dn
    assert above > 0
    assert respond(-300.0, sensor) == pytest.approx(sensor.black_level_dn - above)
    assert linearise(respond(-300.0, sensor), sensor) == pytest.approx(-300.0)


@pytest.mark.parametrize("response", RESPONSES)
def test_electrons_per_dn_is_the_slope(response):
    sensor = dataclasses.replace(LINEAR, **response)
    for electrons in (100.0, 3000.0, 15000.0):
        rise = respond(electrons + 0.5, sensor) - respond(electrons - 0.5, sensor)
        assert electrons_per_dn(electrons, sensor) == pytest.approx(1.0 / rise, rel=1e-4)
    assert np.isfinite(electrons_per_dn(0.0, sensor))


@pytest.mark.parametrize("response", RESPONSES)
@pytest.mark.parametrize("mean_e", [600.0, 4000.0, 12000.0])
def test_the_variance_is_that_of_drawn_frames(response, mean_e):
    sensor = dataclasses.replace(LINEAR, bits=12, gain_e_per_dn=20.0, black_level_dn=100.0, **response)
    count = 200_000
    # Spread over three codes: a code wider than the noise is a twelfth only on average over its width.
    width = 3.0 * electrons_per_dn(mean_e, sensor)
    means = mean_e + width * np.random.default_rng(19).uniform(-0.5, 0.5, count)
    residual = linearise(expose(means, sensor, np.random.default_rng(20)), sensor) - means
    predicted = float(np.mean(variance_e2(means, sensor)))
    # Normal draws scatter by sqrt(2 / count) in variance: 5 sigma. A curved response adds terms of the order
    # of the relative variance, which the prediction leaves out.
    bound = 5.0 * np.sqrt(2.0 / count) + (0.0 if sensor.is_linear else 3.0 * predicted / mean_e**2)
    assert residual.var() == pytest.approx(predicted, rel=bound)
    # The curve shifts the mean by about half the variance times f'' / f', (gamma - 1) / (2 e) of it.
    assert abs(residual.mean()) < 5.0 * np.sqrt(predicted / count) + 0.1 * predicted / mean_e


@pytest.mark.parametrize(("gamma", "bend"), [(1.0, 0.0), (0.6, 0.1), (2.0, -0.2)])
def test_what_is_not_the_lights_is_the_rest_of_the_variance(gamma, bend):
    sensor = dataclasses.replace(LINEAR, gamma=gamma, bend=bend)
    for mean_e in (0.0, 5.0, 700.0, 0.5 * sensor.full_well_e, 1.1 * sensor.full_well_e):
        want = float(variance_e2(mean_e, sensor)) - mean_e
        assert dark_part_e2(mean_e, SensorResponse.of(sensor)) == pytest.approx(want, abs=1e-9 * mean_e)


def test_coarse_steps_add_their_twelfth():
    sensor = dataclasses.replace(LINEAR, read_noise_e=30.0)
    mean_e = np.random.default_rng(1).uniform(5.0, 15.0, 200_000) * sensor.gain_e_per_dn
    residual = linearise(expose(mean_e, sensor, np.random.default_rng(2)), sensor) - mean_e
    predicted = float(np.mean(variance_e2(mean_e, sensor)))
    assert sensor.gain_e_per_dn**2 / 12.0 > 0.2 * predicted
    assert residual.var() == pytest.approx(predicted, rel=0.02)


def test_the_variance_of_darkness_is_read_noise_and_steps():
    expected = 40.0**2 + 80.0**2 / 12.0
    assert variance_e2(0.0, LINEAR) == pytest.approx(expected)
    assert variance_e2(-50.0, LINEAR) == pytest.approx(expected)
    frame = expose(np.zeros(200_000), LINEAR, np.random.default_rng(3))
    assert frame.mean() == pytest.approx(LINEAR.black_level_dn, abs=0.01)
    assert linearise(frame, LINEAR).min() < 0.0


FINE = Sensor(16, gain_e_per_dn=0.5, black_level_dn=100.0, read_noise_e=45.0, full_well_e=20000.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gamma", "bend"), [(0.5, 0.0), (0.8, 0.0), (1.0, 0.0), (1.8, 0.0), (0.8, 0.3), (1.0, -0.4)]
)
@pytest.mark.parametrize("black_level_dn", [0.0, 100.0, 3000.0])
@pytest.mark.parametrize("mean_e", [0.0, 20.0, 100.0, 270.0, 400.0, 3000.0, 19500.0, 20000.0, 20300.0])
def test_readings_have_their_moments_near_black_and_near_full_well(gamma, bend, black_level_dn, mean_e):
    """Eq. 20 of drawn charges, cut and not rounded; a variance scatters by their own fourth moment."""
    sensor = dataclasses.replace(FINE, gamma=gamma, bend=bend, black_level_dn=black_level_dn)
    count = 400_000
    rng = np.random.default_rng(31)
    e = np.minimum(rng.poisson(mean_e, count) + rng.normal(0.0, 45.0, count), 20000.0)
    y = (np.abs(e) / 20000.0) ** gamma
    drawn = np.clip(black_level_dn + 40000.0 * np.sign(e) * (y - bend * y**2), 0.0, 65535.0)
    mean, variance = respond_moments(mean_e, mean_e + sensor.read_noise_e**2, sensor)
    departure = drawn - drawn.mean()
    error = np.std(departure**2) / np.sqrt(count)
    # A Poisson charge is not quite normal: a few thousandths.
    assert mean == pytest.approx(drawn.mean(), abs=5.0 * drawn.std() / np.sqrt(count) + 2e-3 * drawn.std())
    assert variance - 1.0 / 12.0 == pytest.approx(drawn.var(), abs=5.0 * error + 5e-3 * drawn.var())


@pytest.mark.parametrize(("gamma", "bend"), [(0.6, 0.0), (1.0, 0.0), (1.7, 0.0), (1.7, 0.4)])
def test_a_whole_image_of_moments_is_that_of_its_pixels(gamma, bend):
    """Charges and sigmas of all sizes at once: what is tabled together agrees with what stands alone."""
    sensor = dataclasses.replace(FINE, gamma=gamma, bend=bend)
    rng = np.random.default_rng(12)
    mean = rng.choice([0.0, 30.0, 500.0, 5000.0, 20000.0], (6, 5)) * rng.uniform(0.5, 1.0, (6, 5))
    variance = (mean + 45.0**2) * rng.uniform(1.0, 20.0, (6, 5))
    together = respond_moments(mean, variance, sensor)
    assert together[0].shape == (6, 5)
    for at in np.ndindex(6, 5):
        alone = respond_moments(mean[at], variance[at], sensor)
        sigma = float(np.sqrt(alone[1]))
        assert together[0][at] == pytest.approx(float(alone[0]), abs=2e-3 * sigma)
        assert together[1][at] == pytest.approx(float(alone[1]), rel=1e-3)


@pytest.mark.slow
@given(
    st.floats(-50.0, 150.0),
    st.floats(0.5, 40.0),
    st.floats(0.0, 40.0),
    st.floats(60.0, 100.0),
)
def test_the_moments_of_a_cut_normal_variable_are_its_integrals(mean, sigma, low, high):
    got_mean, got_variance = cut_moments(np.array(mean), np.array(sigma**2), low, high)
    below, above = norm.cdf(low, mean, sigma), norm.sf(high, mean, sigma)

    def integral(of):
        inside = quad(lambda x: of(x) * norm.pdf(x, mean, sigma), low, high, limit=200, epsabs=1e-12)[0]
        return of(low) * below + inside + of(high) * above

    wanted = integral(lambda x: x)
    assert got_mean == pytest.approx(wanted, abs=1e-6)
    assert got_variance == pytest.approx(integral(lambda x: (x - wanted) ** 2), abs=1e-5 * sigma**2)


@pytest.mark.parametrize("response", RESPONSES)
def test_moments_without_any_noise_are_the_response(response):
    sensor = dataclasses.replace(LINEAR, read_noise_e=0.0, **response)
    e = np.array([0.0, 10.0, 5000.0, 19999.0, 30000.0])
    mean, variance = respond_moments(e, np.zeros(5), sensor)
    np.testing.assert_allclose(mean, np.minimum(respond(e, sensor), 255.0), atol=1e-5)
    np.testing.assert_allclose(variance, 1.0 / 12.0, atol=1e-4)


@given(sensors())
def test_saturation_is_the_code_of_a_full_pixel_and_of_no_lesser_one(sensor):
    full = expose(np.array([1e3 * sensor.full_well_e]), sensor, np.random.default_rng(0))[0]
    assert saturation_dn(sensor) == full
    edge_dn = saturation_dn(sensor) - 1
    if edge_dn >= respond(0.0, sensor):
        assert linearise(edge_dn, sensor) < sensor.full_well_e


@pytest.mark.parametrize(
    ("black_level_dn", "full_well_e", "expected"),
    [(8.0, 16000.0, 208), (8.7, 16000.0, 209), (8.0, 40000.0, 255)],
)
def test_saturation_by_the_well_or_by_the_code(black_level_dn, full_well_e, expected):
    sensor = dataclasses.replace(LINEAR, black_level_dn=black_level_dn, full_well_e=full_well_e)
    assert saturation_dn(sensor) == expected


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (16, np.uint16)])
def test_frames_have_the_sensors_depth(bits, dtype):
    sensor = dataclasses.replace(LINEAR, bits=bits, gain_e_per_dn=0.1)
    frame = expose(np.full((3, 4), 1e9), sensor, np.random.default_rng(0))
    assert frame.dtype == dtype
    assert frame.shape == (3, 4)
    assert (frame == 2**bits - 1).all()


def test_the_same_seed_draws_the_same_frame():
    mean_e = np.linspace(0.0, 1e4, 100)
    first, second = (expose(mean_e, LINEAR, np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("gamma", 0.0),
        ("gamma", -1.0),
        ("gamma", np.nan),
        ("gain_e_per_dn", 0.0),
        ("full_well_e", -1.0),
        ("read_noise_e", -0.1),
        ("bits", 7),
        ("bits", 17),
    ],
)
def test_an_impossible_sensor_is_refused(key, value):
    with pytest.raises(ValueError, match=key):
        dataclasses.replace(LINEAR, **{key: value})
