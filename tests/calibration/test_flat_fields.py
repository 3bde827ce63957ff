from collections.abc import Callable

import numpy as np
import pytest
from flats import DrawnSensor

from calibration.sensor.code_moments import code_moments
from calibration.sensor.flat_fields import SensorCalibration, calibrate_sensor
from calibration.sensor.levels import Level, level_from
from noise_model.instrument.sensor import Sensor, expose

EXPOSURES_MS = (1.0, 1.5, 2.5, 4.0, 6.0, 9.0, 30.0)


def levels_of(
    sensor: DrawnSensor, exposures_ms: tuple[float, ...] = EXPOSURES_MS, seed: int = 1
) -> list[Level]:
    draw = np.random.default_rng(seed)
    taken = [(1.0, False), *((ms, True) for ms in exposures_ms)]
    pairs = [sensor.pair(1400.0 * ms * is_lit, draw) for ms, is_lit in taken]
    return [
        level_from(pair, 1e-3 * ms, is_lit, sensor.bits)
        for pair, (ms, is_lit) in zip(pairs, taken, strict=True)
    ]


def sigmas_off(result: SensorCalibration, sensor: DrawnSensor) -> dict[str, float]:
    true = {
        "gain_e_per_dn": sensor.gain,
        "black_level_dn": sensor.black,
        "read_noise_e": sensor.read,
        "full_well_e": sensor.well,
        "gamma": sensor.gamma,
        "dsnu_e": sensor.dsnu,
        "prnu_rel": sensor.prnu,
    }
    return {name: (result[name].value - value) / result[name].sigma for name, value in true.items()}


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [1.0, 0.5])
def test_a_sensor_is_found_within_its_sigmas(gamma: float) -> None:
    sensor = DrawnSensor(gamma=gamma)
    result = calibrate_sensor(levels_of(sensor), sensor.bits)
    off = sigmas_off(result, sensor)
    assert max(abs(z) for z in off.values()) < 3.5, off
    assert result.well_is_seen
    assert result.top_dn == 840.0
    assert result["gain_e_per_dn"].sigma < 0.03 * sensor.gain
    assert result.left_out == ("flat frames of 30 ms",)
    assert result.chi2_is_likely


@pytest.mark.slow
def test_a_gamma_that_is_known_makes_the_gain_sharper() -> None:
    sensor = DrawnSensor()
    levels = levels_of(sensor)
    free, held = calibrate_sensor(levels, sensor.bits), calibrate_sensor(levels, sensor.bits, gamma=1.0)
    assert held["gamma"].sigma == 0.0
    assert held["gain_e_per_dn"].sigma < free["gain_e_per_dn"].sigma
    assert abs(held["gain_e_per_dn"].value - sensor.gain) < 3.5 * held["gain_e_per_dn"].sigma


@pytest.mark.slow
def test_defect_pixels_are_left_out_and_counted() -> None:
    sensor = DrawnSensor()
    draw = np.random.default_rng(1)
    levels = []
    for ms, is_lit in [(1.0, False), *((ms, True) for ms in EXPOSURES_MS[:-1])]:
        pair = sensor.pair(1400.0 * ms * is_lit, draw)
        for frame in pair:
            frame[40, 50] = 1023
        levels.append(level_from(pair, 1e-3 * ms, is_lit, sensor.bits))
    result = calibrate_sensor(levels, sensor.bits)
    assert result.levels.n_defects == 1
    assert not result.well_is_seen
    assert abs(sigmas_off(result, sensor)["dsnu_e"]) < 3.5


def test_moments_follow_codes_wider_than_the_noise() -> None:
    # 2e5 pixels of one charge: no pattern mixes the places between two codes.
    sensor = Sensor(8, 80.0, 10.3, 18.0, 16000.0)
    codes = expose(np.full(200_000, 130.0), sensor, np.random.default_rng(0)).astype(np.float64)
    moments = code_moments(np.array([130.0]), np.array([130.0]), sensor, np.array([False]))
    assert moments.mean_dn[0] == pytest.approx(codes.mean(), abs=3e-3)
    assert moments.variance_dn2[0] == pytest.approx(codes.var(), rel=0.02)
    assert moments.fourth_dn4[0] == pytest.approx(np.mean((codes - codes.mean()) ** 4), rel=0.03)
    # Rounding's twelfth alone would be a third too much here.
    shot_dn2 = (130.0 + 18.0**2) / 80.0**2
    assert moments.variance_dn2[0] < 0.9 * (shot_dn2 + 1.0 / 12.0)


def test_moments_where_many_codes_are_taken_together() -> None:
    sensor = Sensor(16, 0.5, 500.0, 8.0, 16000.0, gamma=0.6)
    codes = expose(np.full(200_000, 3000.0), sensor, np.random.default_rng(0)).astype(np.float64)
    moments = code_moments(np.array([3000.0]), np.array([3000.0]), sensor, np.array([False]))
    assert moments.variance_dn2[0] == pytest.approx(codes.var(), rel=0.02)
    assert moments.mean_dn[0] == pytest.approx(codes.mean(), abs=4.0 * codes.std() / 200_000**0.5)


def with_exposures(*exposures_ms: float) -> list[Level]:
    return levels_of(DrawnSensor(), exposures_ms)


def moved() -> list[Level]:
    sensor, draw = DrawnSensor(shading=0.0), np.random.default_rng(1)
    texture = 40.0 * np.sin(np.arange(96) / 4.0)
    still, pair = levels_of(sensor), sensor.pair(5600.0, draw)
    pair[1] = np.clip(pair[1] + np.rint(texture), 0, 1023).astype(np.uint16)
    return [
        *(level for level in still if level.exposure_s != 4e-3),
        level_from(pair, 4e-3, True, sensor.bits),
    ]


def flickering() -> list[Level]:
    sensor, draw = DrawnSensor(), np.random.default_rng(1)
    still = [level for level in levels_of(sensor) if level.exposure_s != 4e-3]
    return [*still, level_from(sensor.pair(5600.0, draw, second=1.03), 4e-3, True, sensor.bits)]


@pytest.mark.parametrize(
    ("levels", "reason"),
    [
        (
            lambda: [level for level in with_exposures(*EXPOSURES_MS) if level.is_lit],
            "there are no dark frames",
        ),
        (
            lambda: with_exposures(1.0, 2.0, 30.0, 40.0, 50.0, 60.0),
            "2 exposures of flat frames lie below saturation, 5 are needed.*from 30 ms on: take shorter ones",
        ),
        (lambda: with_exposures(4.0, 5.0, 6.0, 7.0, 8.0), "2.0 times the shortest.*down to 0.4 ms"),
        (flickering, "flat frames of 4 ms: one is 3.0 % brighter than another: the light flickers"),
        (moved, "flat frames of 4 ms: neighbouring pixels differ alike.*moved"),
        (lambda: levels_of(DrawnSensor(shading=0.49)), r"the light changes by \d+ % over the image"),
        (lambda: levels_of(DrawnSensor(gain=60.0, read=5.0, dsnu=0.0)), "rounding hides it"),
    ],
)
def test_what_cannot_be_determined_is_refused_by_name(levels: Callable[[], list[Level]], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        calibrate_sensor(levels(), 10)


def test_one_frame_of_an_exposure_is_refused() -> None:
    with pytest.raises(ValueError, match="flat frames of 2 ms: there is one"):
        level_from(DrawnSensor().pair(2800.0, np.random.default_rng(1))[:1], 2e-3, True, 10)


def test_frames_of_fewer_bits_than_the_sensors_are_refused() -> None:
    frames = np.random.default_rng(1).integers(0, 99, (2, 32, 32)).astype(np.uint8)
    with pytest.raises(ValueError, match=r"hold 8 bits, \[sensor\] bits = 12: record with all of them"):
        level_from([*frames], 0.002, True, 12)
