from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from stills import DrawnStripe

from calibration.sensor.still import calibrate_still
from noise_model.instrument.sensor import Sensor

STATED = Sensor(bits=8, gain_e_per_dn=20.0, black_level_dn=7.0, read_noise_e=25.0, full_well_e=4000.0)

Frames = list[np.ndarray]


@pytest.mark.slow
def test_a_still_stripe_tells_sensor_and_speckle() -> None:
    drawn = DrawnStripe()
    result = calibrate_still(drawn.frames(30, np.random.default_rng(1)), STATED)
    true = {"gain_e_per_dn": drawn.gain, "black_level_dn": drawn.black, "read_noise_e": drawn.read}
    for name, value in true.items():
        assert abs(result[name].value - value) < 3.5 * result[name].sigma < 0.3 * value, name
    assert result.speckle is not None
    assert abs(result.speckle.contrast - drawn.contrast) < 3.5 * result.speckle.contrast_sigma
    assert abs(result.speckle.grain_px - drawn.grain) < 3.5 * result.speckle.grain_sigma_px
    # 207 DN are stated to be saturated, and are.
    swing = 207.0 - result.sensor.black_level_dn
    assert result.sensor.full_well_e == pytest.approx(result.sensor.gain_e_per_dn * swing)


@pytest.mark.slow
def test_a_laser_whose_power_wanders_is_no_noise() -> None:
    draw = np.random.default_rng(2)
    result = calibrate_still(DrawnStripe(power_rel=0.05).frames(30, draw), STATED)
    assert abs(result["gain_e_per_dn"].value - 12.0) < 3.5 * result["gain_e_per_dn"].sigma
    assert np.std(result.statistics.brightness) == pytest.approx(0.05, rel=0.4)


@pytest.mark.slow
def test_a_gamma_that_is_stated_is_honoured() -> None:
    draw = np.random.default_rng(3)
    gamma, full = 0.6, 4000.0
    frames = []
    y, x = np.mgrid[0:240, 0:96].astype(float)
    light = 1800.0 * np.exp(-0.5 * ((x - 48.0) / 6.0) ** 2) * (1.0 + 0.2 * np.sin(y / 7.0))
    for _ in range(24):
        charge = draw.poisson(light) + draw.normal(0.0, 15.0, light.shape)
        dn = 30.0 + 220.0 * np.sign(charge) * (np.abs(charge) / full) ** gamma
        frames.append(np.clip(np.rint(dn), 0, 255).astype(np.uint8))
    stated = Sensor(8, 10.0, 30.0, 20.0, 2250.0, gamma=gamma)
    result = calibrate_still(frames, stated)
    # At the last code the well holds less than the drawn one: gain is charge over swing there.
    true = full * (225.0 / 220.0) ** (1.0 / gamma) / 225.0
    assert abs(result["gain_e_per_dn"].value - true) < 3.5 * result["gain_e_per_dn"].sigma
    assert abs(result["read_noise_e"].value - 15.0) < 4.0 * result["read_noise_e"].sigma


def moving() -> Frames:
    draw = np.random.default_rng(1)
    frames = DrawnStripe().frames(24, draw)
    frames[7] = np.roll(frames[7], 1, axis=1)
    return list(frames)


def brighter() -> Frames:
    draw = np.random.default_rng(1)
    frames = DrawnStripe().frames(24, draw)
    frames[3] = np.minimum(9 + 1.5 * (frames[3].astype(float) - 9), 255).clip(0).astype(np.uint8)
    return list(frames)


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        (
            lambda: DrawnStripe().frames(19, np.random.default_rng(1)),
            "19 frames show the stripe alone, 20 are needed",
        ),
        (moving, r"the stripe does not stand still: in frame 7 it is shifted by 0\.\d+ px"),
        (brighter, r"the light is not steady: frame 3 is \+4\d % off the others"),
        (
            lambda: replace(DrawnStripe(), peak_e=20.0, contrast=0.01).frames(20, np.random.default_rng(1)),
            "too few pixels|shot noise does not show",
        ),
    ],
)
def test_what_cannot_be_told_is_refused(frames: Callable[[], Frames], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        calibrate_still(frames(), STATED)


def test_a_saturated_stripe_tells_no_speckle() -> None:
    result = calibrate_still(DrawnStripe(peak_e=2600.0).frames(24, np.random.default_rng(1)), STATED)
    assert result.speckle is None


def test_read_noise_that_rounding_hides_is_told_within_what_it_may_be() -> None:
    drawn = DrawnStripe(gain=30.0, read=3.0, peak_e=4000.0)
    result = calibrate_still(drawn.frames(40, np.random.default_rng(1)), STATED)
    assert result.is_read_noise_hidden
    assert abs(result["gain_e_per_dn"].value - 30.0) < 3.5 * result["gain_e_per_dn"].sigma < 6.0
    assert result["read_noise_e"].low < drawn.read < result["read_noise_e"].high


def test_a_stripe_with_a_corner_tells_the_sensor_but_no_speckle() -> None:
    frames = DrawnStripe(shape=(240, 192)).frames(24, np.random.default_rng(1))
    bent = [np.stack([np.roll(row, abs(n - 120) // 2) for n, row in enumerate(frame)]) for frame in frames]
    result = calibrate_still(bent, STATED)
    assert abs(result["gain_e_per_dn"].value - 12.0) < 3.5 * result["gain_e_per_dn"].sigma
    assert result.speckle is None
