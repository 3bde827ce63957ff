"""Details of pixels, and what scatters in them."""

from dataclasses import replace

import numpy as np
import pytest

from sim_to_real.data.blocks import DETAIL_2X2, weighted_sums_in_bins
from sim_to_real.variance import haar_details as of_details
from sim_to_real.variance.haar_details import (
    DETAIL_4X4,
    SECOND_DIFFERENCE,
    HaarDetails,
    fit_sizes,
    fixed_pattern,
    haar_details,
)
from tests.sim_to_real.scattered import BIN_PX, Scattering, recorded


@pytest.mark.parametrize("weights", [DETAIL_2X2, DETAIL_4X4, SECOND_DIFFERENCE])
def test_details_do_not_see_a_plane_and_have_the_variance_of_white_noise(weights):
    row, column = np.mgrid[:40, :60].astype(np.float32)
    assert np.abs(weighted_sums_in_bins(3.0 * row - 2.0 * column, weights, BIN_PX)).max() < 1e-4
    noise = np.random.default_rng(2).normal(0.0, 1.5, (1200, 1200)).astype(np.float32)
    result = weighted_sums_in_bins(noise, weights, BIN_PX)
    assert result.shape == (300, 300, (BIN_PX // len(weights)) ** 2)
    assert np.mean(result**2) == pytest.approx(1.5**2, rel=0.02)


def test_a_bin_of_two_pixels_has_no_large_details():
    image = np.zeros((40, 60), dtype=np.float32)
    assert weighted_sums_in_bins(image, DETAIL_2X2, 2).shape == (20, 30, 1)
    assert weighted_sums_in_bins(image, DETAIL_4X4, 2).shape == (20, 30, 0)


def test_light_that_twists_and_bends_leaves_no_details():
    expected, fitted = recorded(np.random.default_rng(0), n_frames=3)
    frame, light = expected.observed.frames[2], fitted.lights[2]
    row, column = np.indices(frame.image_dn.shape) - 100.0
    smooth = 100.0 + 0.004 * row * column + 0.003 * column**2
    binned = smooth.reshape(60, 4, 80, 4).mean(axis=(1, 3)).astype(np.float32)
    inner = np.zeros_like(frame.keep)
    inner[2:-2, 2:-2] = frame.keep[2:-2, 2:-2]
    exact = replace(frame, image_dn=smooth, binned_dn=binned)
    details = haar_details(exact, light, BIN_PX)
    chosen = inner[frame.keep]
    for values in (details.small, details.large, details.across):
        assert np.abs(values[chosen]).max() < 2e-3


def made(rng, n, *, ratio=1.0, gain=0.0, speckle=(0.0, 0.0)):
    """Bins of light 20 to 200 DN, half of them without laser, whose variances are known."""
    light, laser = rng.uniform(20.0, 200.0, n), rng.uniform(0.0, 80.0, n) * (np.arange(n) % 2)
    read, stated = np.full(n, 0.3), 0.3 + 0.01 * light + 0.08
    white = stated + (ratio**2 - 1.0) * read + (gain * light) ** 2
    small, large = (white + (values * laser) ** 2 for values in speckle)
    return HaarDetails(
        rng.normal(0.0, np.sqrt(small)[:, np.newaxis], (n, 4)),
        rng.normal(0.0, np.sqrt(large)[:, np.newaxis], (n, 1)),
        rng.normal(0.0, np.sqrt(white)[:, np.newaxis], (n, 1)),
        stated,
        read,
        light**2,
        laser**2,
    )


@pytest.mark.parametrize(
    ("ratio", "gain", "speckle"),
    [
        (1.0, 0.0, (0.0, 0.0)),
        (2.5, 0.0, (0.0, 0.0)),
        (1.0, 0.02, (0.0, 0.0)),
        (0.7, 0.0, (0.0, 0.0)),
        (1.5, 0.01, (0.02, 0.06)),
    ],
)
def test_sizes_come_back_within_their_sigmas(ratio, gain, speckle):
    rng = np.random.default_rng(3)
    fit = fit_sizes([made(rng, 10_000, ratio=ratio, gain=gain, speckle=speckle) for _ in range(4)])
    result = np.array([fit.read, fit.light, fit.laser_small, fit.laser_large])
    true = np.array([ratio**2 - 1.0, gain**2, speckle[0] ** 2, speckle[1] ** 2])
    assert (np.abs(result - true) < 4.0 * np.sqrt(np.diag(fit.covariance))).all()
    assert fit.error_rel < 0.01


def test_the_sigmas_of_sizes_are_their_scatter():
    drawn, stated = [], []
    for seed in range(60):
        fit = fit_sizes(
            [made(np.random.default_rng(seed), 2_000, ratio=1.4, gain=0.02, speckle=(0.02, 0.05))]
        )
        drawn.append([fit.read, fit.light, fit.laser_small, fit.laser_large])
        stated.append(np.sqrt(np.diag(fit.covariance)))
    assert np.std(drawn, axis=0) / np.mean(stated, axis=0) == pytest.approx(np.ones(4), abs=0.3)


def test_a_variance_of_another_shape_is_off():
    rng = np.random.default_rng(6)
    frame = made(rng, 20_000)
    # As a bent response makes it: much where it is dark, little where it is bright.
    more = 1.0 + 3.0 * np.exp(-np.sqrt(frame.light) / 30.0)
    bent = HaarDetails(
        *(values * np.sqrt(more)[:, np.newaxis] for values in (frame.small, frame.large, frame.across)),
        frame.stated,
        frame.read,
        frame.light,
        frame.laser,
    )
    assert fit_sizes([bent]).error_rel > 0.1


@pytest.mark.parametrize(("pixels", "columns"), [(0.0, 0.0), (0.03, 0.0), (0.02, 0.015)])
def test_what_stays_with_pixels_and_with_columns_comes_back(pixels, columns):
    expected, fitted = recorded(np.random.default_rng(8), Scattering(pixels=pixels, columns=columns))
    frames = expected.observed.frames
    values = [haar_details(f, light, BIN_PX) for f, light in zip(frames, fitted.lights, strict=True)]
    result = fixed_pattern(values, [frame.keep for frame in frames], fit_sizes(values), range(len(frames)))
    assert result.pixels == pytest.approx(pixels**2, rel=0.1, abs=4.0 * result.pixels_sigma)
    assert result.columns == pytest.approx(columns**2, abs=4.0 * result.columns_sigma)
    assert result.pixels_sigma < 0.003**2


def test_what_the_part_shows_again_in_a_place_is_no_pattern_of_pixels():
    expected, fitted = recorded(np.random.default_rng(8), Scattering(pixels=0.03))
    frames = expected.observed.frames
    values = [haar_details(f, light, BIN_PX) for f, light in zip(frames, fitted.lights, strict=True)]
    keeps, fit = [frame.keep for frame in frames], fit_sizes(values)
    assert fixed_pattern(values, keeps, fit, [0] * len(frames)).pixels_sigma == np.inf
    # Two places tell less than one for each frame, and the same.
    two = fixed_pattern(values, keeps, fit, [n % 2 for n in range(len(frames))])
    assert two.pixels == pytest.approx(0.03**2, rel=0.2)
    assert two.pixels_sigma > fixed_pattern(values, keeps, fit, range(len(frames))).pixels_sigma


def test_fresh_noise_that_goes_with_light_does_not_come_back():
    rng, keep = np.random.default_rng(4), np.ones((40, 50), dtype=bool)
    values = [made(rng, 2_000, gain=0.03) for _ in range(10)]
    fit = fit_sizes(values)
    result = fixed_pattern(values, [keep] * 10, fit, range(10))
    assert fit.light == pytest.approx(0.03**2, rel=0.1)
    assert abs(result.pixels) < 4.0 * result.pixels_sigma < 0.1 * fit.light
    assert np.sum(SECOND_DIFFERENCE.sum(axis=0) ** 2) == of_details.COLUMN_GAIN
