"""The noise that frames show, held against noise that was put there."""

import numpy as np
import pytest

from sim_to_real.data.binned import photon_transfer

H, W, BIN_PX = 240, 320, 4


def frames(rng, response, n=16):
    """Draw frames of a slope from dark to bright, shot noise of 80 e-/DN and read noise of 45 e-."""
    slope_e = np.linspace(0.0, 16_000.0, W) * np.ones((H, 1))
    drawn = [rng.poisson(slope_e) + 45.0 * rng.standard_normal((H, W)) for _ in range(n)]
    return [np.clip(np.rint(response(e) + 16.0), 0, 255).astype(np.uint8) for e in drawn]


def linear(e):
    return e / 80.0


def bent(e):
    return np.sign(e) * (np.abs(e) / 20_000.0) ** 0.6 * 250.0


@pytest.fixture
def usable():
    return np.ones((H // BIN_PX, W // BIN_PX), dtype=bool)


def test_a_stated_sensor_shows_its_stated_noise(usable):
    images = frames(np.random.default_rng(1), linear)
    curve = photon_transfer(images, [usable] * len(images), BIN_PX)
    for e in (1000.0, 4000.0, 15_000.0):
        wanted = (e + 45.0**2) / 80.0**2 + 1.0 / 12.0
        assert curve.variance_at(np.array(16.0 + e / 80.0)) == pytest.approx(wanted, rel=0.07)


def test_a_bent_response_scatters_otherwise(usable):
    """Shot and read noise go through its slope; near black it is steep."""
    images = frames(np.random.default_rng(2), bent)
    curve = photon_transfer(images, [usable] * len(images), BIN_PX)
    for e in (3000.0, 12_000.0):
        slope = 0.6 * 250.0 / 20_000.0 * (e / 20_000.0) ** -0.4
        wanted = (e + 45.0**2) * slope**2 + 1.0 / 12.0
        assert curve.variance_at(np.array(16.0 + bent(e))) == pytest.approx(wanted, rel=0.07)
    assert curve.variance_at(np.array(18.0)) > 2.0 * 45.0**2 / 80.0**2


def test_smooth_light_stripes_and_what_is_not_usable_are_no_noise(usable):
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:H, :W]
    light = 60.0 + 0.2 * u + 0.1 * v + 0.002 * (v - 100.0) ** 2
    stripe = 80.0 * np.exp(-0.5 * ((v - 150.0 - 0.1 * u) / 4.0) ** 2)
    image = np.rint(light + stripe + 2.0 * rng.standard_normal((H, W))).clip(0, 255).astype(np.uint8)
    image[:40, :40] = rng.integers(0, 255, (40, 40))
    mean_square = usable.copy()
    mean_square[:10, :10] = False
    curve = photon_transfer([image] * 2, [mean_square] * 2, BIN_PX)
    assert np.median(curve.variances_dn2) == pytest.approx(4.0 + 1.0 / 12.0, rel=0.04)
    assert curve.variances_dn2.max() < 1.3 * 4.0


@pytest.mark.parametrize("bin_px", [2, 3, 5, 8])
def test_bins_of_any_width_do(bin_px):
    image = np.rint(100.0 + 3.0 * np.random.default_rng(4).standard_normal((H, W))).astype(np.uint8)
    use = np.ones((H // bin_px, W // bin_px), dtype=bool)
    assert np.mean(photon_transfer([image], [use], bin_px).variances_dn2) == pytest.approx(9.08, rel=0.04)


def test_where_hardly_anything_is_usable_nothing_is_known(usable):
    curve = photon_transfer([np.zeros((H, W), dtype=np.uint8)], [np.zeros_like(usable)], BIN_PX)
    np.testing.assert_array_equal(curve.variance_at(np.array([0.0, 100.0])), 0.0)
