"""Speckle, from what it leaves in two details."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sim_to_real.data.blocks import DETAIL_2X2, weighted_sums_in_bins
from sim_to_real.variance.haar_details import DETAIL_4X4, VarianceSizes
from sim_to_real.variance.speckle import LARGE_WEIGHTS, SMALL_WEIGHTS, fit_speckle, variance_kept

BIN_PX = 4
SURE = np.diag([1e-4, 1e-12, 1e-11, 1e-10])


@pytest.mark.parametrize("grain_px", [0.6, 1.0, 2.5])
def test_what_is_left_of_speckle_is_what_a_drawn_field_leaves(grain_px):
    """A white field behind a Gaussian, by scipy, its details counted."""
    field = gaussian_filter(np.random.default_rng(1).standard_normal((1600, 1600)), grain_px)
    field = (field / field.std()).astype(np.float32)
    # A sampled Gaussian is no Gaussian below a pixel: the correlation is the continuous one's.
    tolerance = 0.25 if grain_px < 1.0 else 0.06
    for weights, along in ((DETAIL_2X2, SMALL_WEIGHTS), (DETAIL_4X4, LARGE_WEIGHTS)):
        mean_square = variance_kept(grain_px, along)
        assert np.mean(weighted_sums_in_bins(field, weights, BIN_PX) ** 2) == pytest.approx(
            mean_square, rel=tolerance
        )
    means = field.reshape(400, BIN_PX, 400, BIN_PX).mean(axis=(1, 3))
    mean_square = variance_kept(grain_px, np.full(BIN_PX, 1.0 / BIN_PX))
    assert np.var(means) == pytest.approx(mean_square, rel=tolerance)


def of_speckle(contrast, grain_px):
    kept = [variance_kept(grain_px, weights) for weights in (SMALL_WEIGHTS, LARGE_WEIGHTS)]
    return VarianceSizes(0.0, 0.0, contrast**2 * kept[0], contrast**2 * kept[1], SURE, 0.0)


@pytest.mark.parametrize(("contrast", "grain_px"), [(0.06, 0.6), (0.1, 1.0), (0.3, 1.5)])
def test_contrast_and_grain_come_back(contrast, grain_px):
    speckle_fit = fit_speckle(of_speckle(contrast, grain_px), 1e-5, 1e-5, BIN_PX)
    assert speckle_fit.evidence > 20.0
    assert speckle_fit.contrast == pytest.approx(contrast, abs=2.0 * speckle_fit.sigmas[0])
    assert speckle_fit.grain_px == pytest.approx(grain_px, abs=2.0 * speckle_fit.sigmas[1])
    assert speckle_fit.sigmas[0] < 0.2 * contrast
    assert math.sqrt(speckle_fit.bin_variance_rel) < speckle_fit.contrast


def test_without_speckle_there_is_none():
    nothing = VarianceSizes(0.0, 0.0, 0.0, 0.0, SURE, 0.0)
    assert fit_speckle(nothing, 1e-5, 1e-5, BIN_PX).evidence < -1.0
    # White noise that goes with the laser as little as the model may be off.
    little = VarianceSizes(0.0, 0.0, 1e-5, 1e-5, SURE, 0.0)
    assert fit_speckle(little, 1e-5, 1e-5, BIN_PX).evidence < 0.0


def test_small_bins_tell_it_by_their_one_detail():
    speckle_fit = fit_speckle(of_speckle(0.2, 0.8), 1e-5, 1e-5, 2)
    assert speckle_fit.evidence > 20.0
    # Contrast and grain are not told apart: its sigma says so.
    assert speckle_fit.contrast == pytest.approx(0.2, abs=2.0 * speckle_fit.sigmas[0])
    assert speckle_fit.sigmas[0] > 0.02


def test_scatter_many_times_the_noise_is_speckle_however_badly_the_variance_fits():
    contrast, grain_px = 0.5, 0.9
    # The fitted variance is off by a half along the light. Without speckle it would be a hundredth of it.
    error = 0.5 * contrast**2
    speckle_fit = fit_speckle(of_speckle(contrast, grain_px), error, 0.01 * error, BIN_PX)
    assert speckle_fit.evidence > 20.0
    assert fit_speckle(of_speckle(contrast, grain_px), error, error, BIN_PX).evidence < 3.0
