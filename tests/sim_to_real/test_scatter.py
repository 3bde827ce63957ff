"""What scatters from pixel to pixel, told by its variances."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sim_to_real import scatter
from sim_to_real.scatter import left_of_grain

BIN_PX = 4


@pytest.mark.parametrize("grain_px", [0.6, 1.0, 2.5])
def test_what_is_left_of_speckle_is_what_a_drawn_field_leaves(grain_px):
    """A white field behind a Gaussian, by scipy, its statistics counted."""
    field = gaussian_filter(np.random.default_rng(1).standard_normal((1600, 1600)), grain_px)
    field /= field.std()
    detail = scatter._details(field, BIN_PX)
    means = field.reshape(400, BIN_PX, 400, BIN_PX).mean(axis=(1, 3))
    change = (means[:, :-2] - 2.0 * means[:, 1:-1] + means[:, 2:]) / np.sqrt(6.0)
    within, between = left_of_grain(grain_px, BIN_PX)
    # A sampled Gaussian is no Gaussian below a pixel: the correlation is the continuous one's.
    tolerance = 0.25 if grain_px < 1.0 else 0.06
    assert np.mean(detail**2) == pytest.approx(within, rel=tolerance)
    assert np.mean(change**2) == pytest.approx(between, rel=tolerance)


def test_details_do_not_see_a_plane_and_have_the_variance_of_white_noise():
    row, column = np.mgrid[:40, :60]
    assert np.abs(scatter._details(3.0 * row - 2.0 * column, BIN_PX)).max() < 1e-4
    noise = np.random.default_rng(2).normal(0.0, 1.5, (800, 800))
    details = scatter._details(noise, BIN_PX)
    assert details.shape == (200, 200, 4)
    assert np.mean(details**2) == pytest.approx(1.5**2, rel=0.01)


def made(rng, n, *, ratio=1.0, gain=0.0, speckle=0.0):
    """A frame's bins of light 20 to 200 DN whose variance is known."""
    light, laser = rng.uniform(20.0, 200.0, n), rng.uniform(0.0, 80.0, n)
    read, predicted = np.full(n, 0.3), 0.3 + 0.01 * light + 0.08
    true = predicted + (ratio**2 - 1.0) * read + (gain * light) ** 2 + (speckle * laser) ** 2
    details = rng.normal(0.0, np.sqrt(true)[:, np.newaxis], (n, 4))
    return scatter._Frame(np.mean(details**2, axis=1), predicted, read, light**2, laser**2, details, light)


@pytest.mark.parametrize(
    ("ratio", "gain", "speckle"), [(1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (1.0, 0.02, 0.0), (1.5, 0.01, 0.05)]
)
def test_sizes_of_noise_gain_and_speckle_come_back(ratio, gain, speckle):
    rng = np.random.default_rng(3)
    seen = [made(rng, 20_000, ratio=ratio, gain=gain, speckle=speckle) for _ in range(4)]
    read, light, laser, sigma = scatter._sizes(seen)
    for found, true, error in zip(
        (read, light, laser), (ratio**2 - 1.0, gain**2, speckle**2), sigma, strict=True
    ):
        # The sigma is that of the stated variance; the true one is larger.
        assert found == pytest.approx(true, abs=25.0 * error)


class Lit:
    def __init__(self, shape):
        self.keep = np.ones(shape, dtype=bool)


def test_a_pattern_comes_back_and_fresh_noise_does_not():
    rng, shape, n_frames = np.random.default_rng(4), (60, 80), 10
    n = 60 * 80
    pattern = rng.standard_normal((n, 4))
    fixed, fresh = [], []
    for _ in range(n_frames):
        light = rng.uniform(50.0, 150.0, n)
        noise = rng.normal(0.0, 1.0, (n, 4))
        for into, gains in ((fixed, pattern), (fresh, rng.standard_normal((n, 4)))):
            details = noise + 0.02 * light[:, np.newaxis] * gains
            into.append(
                scatter._Frame(np.mean(details**2, axis=1), np.ones(n), *(np.ones(n),) * 3, details, light)
            )
    frames = [Lit(shape)] * n_frames
    assert scatter._comes_back(fixed, frames) == pytest.approx(0.02**2, rel=0.05)
    assert scatter._comes_back(fresh, frames) < 0.1 * 0.02**2
