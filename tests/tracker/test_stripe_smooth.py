"""Neighbours along the stripe: against the twin, and against what is true of traces that are drawn here."""

from __future__ import annotations

import numpy as np
import pytest
import smooth_twin
from hypothesis import given, settings
from hypothesis import strategies as st

from noise_model.compiled.arrays import Float64
from tracker.stripe import smooth as stripe_smooth
from tracker.stripe.smooth import LENGTHS, MIN_DRAWN, MIN_SURE_PX

N = 400
DRAWS = 300
CORNERS = (120.3, 200.0, 279.6)
seeds = st.integers(0, 2**32 - 1)


def smooth_stripe(y: Float64, sigma: Float64) -> tuple[Float64, Float64]:
    """Independent columns."""
    smooth, stated = np.empty((2, len(y)))
    room = stripe_smooth.SmoothRoom.empty(len(y))
    stripe_smooth.smooth_stripe(y, sigma, sigma, room, smooth, stated)
    return smooth, stated


def groove(slope: float) -> Float64:
    """A V-groove's trace (N,) in a slightly curved plate: straight, down, up and straight, px."""
    x = np.arange(N, dtype=np.float64)
    left, root, right = CORNERS
    bends = np.maximum(x - left, 0.0) - 2.0 * np.maximum(x - root, 0.0) + np.maximum(x - right, 0.0)
    return 250.0 + slope * bends + 1e-6 * (x - 200.0) ** 2


def drawn(true: Float64, sigma: Float64, seed: int, draws: int = DRAWS) -> tuple[Float64, Float64]:
    """Errors over the columns' own sigmas and over the stated ones (draws, N)."""
    rng = np.random.default_rng(seed)
    found = [smooth_stripe(true + sigma * rng.normal(0.0, 1.0, len(true)), sigma) for _ in range(draws)]
    error = np.array([smooth - true for smooth, _ in found])
    return error / sigma, error / np.array([stated for _, stated in found])


def off_corners() -> Float64:
    return np.asarray(np.abs(np.arange(N)[:, np.newaxis] - CORNERS).min(axis=1))


@pytest.mark.slow
@settings(deadline=None, max_examples=15)
@given(seeds)
def test_the_smoothed_stripe_is_its_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 150))
    sigma = rng.uniform(0.02, 0.9) * rng.uniform(0.7, 1.4, n)
    x = np.arange(n)
    true = 200.0 + rng.normal(0.0, 0.3) * np.abs(x - rng.uniform(0, n)) + rng.normal(0.0, 5.0) * (x > n / 3)
    y = true + sigma * rng.normal(0.0, 1.0, n)
    y[rng.random(n) < 0.03] += 10.0
    y[rng.random(n) < 0.03] = np.nan
    y[n // 2 : n // 2 + int(rng.integers(0, 12))] = np.nan
    sigma[np.isnan(y)] = np.nan
    smooth, stated = smooth_stripe(y, sigma)
    expected, expected_sigma = smooth_twin.smooth_stripe(y, sigma)
    np.testing.assert_allclose(smooth, expected, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(stated, expected_sigma, rtol=1e-6)


@pytest.mark.parametrize("sigma", [0.03, 0.1, 0.25, 0.4])
def test_faces_are_surer_by_their_neighbours_and_say_so(sigma: float) -> None:
    own, stated = drawn(groove(0.7), np.full(N, sigma), 1)
    x = np.arange(N)
    face = (off_corners() > MIN_DRAWN) & (np.minimum(x, N - 1 - x) >= MIN_DRAWN)
    # Of 1 / sqrt(33) in the middle of a face.
    assert 1.4826 * np.median(np.abs(own[:, face])) < 0.3
    assert np.sqrt(np.mean(own[:, face] ** 2)) < 0.35
    assert 0.9 <= np.mean(stated[:, face] ** 2) <= 1.1
    assert abs(np.mean(own[:, face])) < 0.02


@pytest.mark.parametrize("sigma", [0.03, 0.1, 0.25, 0.4])
def test_corners_are_not_cut(sigma: float) -> None:
    """At no column is the mean error above a quarter of the column's own bound, nor chi2 dishonest."""
    own, stated = drawn(groove(0.7), np.full(N, sigma), 2)
    near = off_corners() <= 12.0
    assert np.abs(own[:, near].mean(axis=0)).max() < 0.25
    assert 0.9 <= np.mean(stated[:, near] ** 2) <= 1.1
    beside = off_corners() <= 2.0
    assert 0.9 <= np.mean(stated[:, beside] ** 2) <= 1.15


def test_a_bend_too_weak_to_see_moves_a_line_by_less_than_the_columns_own_sigma() -> None:
    for slope in (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2):
        own, _ = drawn(groove(slope), np.full(N, 0.25), 3, draws=100)
        assert np.abs(own.mean(axis=0)).max() < 0.6, slope


def test_a_step_is_kept() -> None:
    true = np.where(np.arange(N) < 200, 250.0, 253.0)
    own, stated = drawn(true, np.full(N, 0.1), 4)
    assert np.abs(own.mean(axis=0)).max() < 0.25
    assert 0.9 <= np.mean(stated**2) <= 1.1


def test_unequal_columns_are_weighed() -> None:
    sigma = np.where(np.arange(N) % 2 == 0, 0.05, 0.5)
    _, stated = drawn(np.full(N, 100.0), sigma, 5)
    assert 0.9 <= np.mean(stated**2) <= 1.1


def test_an_outlier_is_flagged_and_moves_no_neighbour() -> None:
    rng = np.random.default_rng(6)
    sigma = np.full(N, 0.1)
    for i in (0, 40, 200, 201, N - 1):
        y = groove(0.7) + sigma * rng.normal(0.0, 1.0, N)
        without = y.copy()
        without[i] = np.nan
        y[i] += 4.0
        smooth, stated = smooth_stripe(y, sigma)
        expected, expected_sigma = smooth_stripe(without, sigma)
        assert np.isnan(smooth[i]), i
        assert np.isnan(stated[i]), i
        np.testing.assert_allclose(smooth, expected, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(stated, expected_sigma, rtol=1e-9)


def test_no_corner_is_an_outlier() -> None:
    rng = np.random.default_rng(7)
    # A lens rounds a corner over a few columns.
    bell = np.exp(-0.5 * (np.arange(-4, 5) / 1.2) ** 2)
    rounded = np.convolve(np.pad(groove(0.7), 4, mode="edge"), bell / bell.sum(), "valid")
    for sigma in (0.01, 0.03, 0.1, 0.3):
        y = rounded + sigma * rng.normal(0.0, 1.0, N)
        assert np.isfinite(smooth_stripe(y, np.full(N, sigma))[0]).all()


def test_without_neighbours_a_column_keeps_its_own_centre() -> None:
    y, sigma = np.full(N, np.nan), np.full(N, np.nan)
    y[[50, 100, 150]], sigma[[50, 100, 150]] = (250.0, 251.0, 252.0), (0.1, 0.2, 2.0 * MIN_SURE_PX)
    smooth, stated = smooth_stripe(y, sigma)
    np.testing.assert_allclose(smooth[[50, 100]], [250.0, 251.0])
    np.testing.assert_allclose(stated[[50, 100]], [0.1, 0.2])
    assert np.isnan(smooth[150])
    assert np.isfinite(smooth).sum() == 2
    for n in (0, 1, LENGTHS[0], LENGTHS[-1]):
        assert len(smooth_stripe(np.zeros(n), np.ones(n))[0]) == n
