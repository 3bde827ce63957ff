"""The band's kernels against their twins, and where a band is placed."""

from __future__ import annotations

import numpy as np
import pytest
import twins
from hypothesis import given, settings
from hypothesis import strategies as st

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Float64, Int64
from tracker.stripe.band import LightLevel, at_level, gather, median_background, place, weigh

seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None, max_examples=30)
@given(seeds, st.booleans(), st.sampled_from([np.uint8, np.uint16]), st.booleans())
def test_gather_is_its_twin(seed: int, along_rows: bool, dtype: type, is_view: bool) -> None:
    rng = np.random.default_rng(seed)
    height, width = rng.integers(3, 40, 2)
    codes = 256 if dtype is np.uint8 else 4096
    image = rng.integers(0, codes, (height, 2 * width if is_view else width)).astype(dtype)
    image = image[:, ::2] if is_view else image
    n_scan, n_pos = image.shape[::-1] if along_rows else image.shape
    depth = int(rng.integers(1, n_pos + 1))
    lows = rng.integers(0, n_pos - depth + 1, -(-n_scan // CELL))
    charge = rng.uniform(-10.0, 1e4, codes).astype(np.float32)
    band, censored = np.full((n_scan, depth), np.nan, np.float32), np.empty((n_scan, depth), bool)
    gather(image, along_rows, lows, charge, codes - 20, band, censored)
    twin = twins.gather(image, along_rows, lows, CELL, depth)
    np.testing.assert_array_equal(band, charge[twin])
    np.testing.assert_array_equal(censored, twin >= codes - 20)


def test_codes_beyond_the_sensors_bits_are_its_last_one() -> None:
    image = np.array([[0, 4095, 4096, 65535]], dtype=np.uint16)
    charge = np.arange(4096, dtype=np.float32)
    band, censored = np.empty((1, 4), np.float32), np.empty((1, 4), bool)
    gather(image, False, np.zeros(1, np.int64), charge, 4090, band, censored)
    np.testing.assert_array_equal(band[0], [0.0, 4095.0, 4095.0, 4095.0])
    np.testing.assert_array_equal(censored[0], [False, True, True, True])


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(seeds, st.integers(0, 12))
def test_the_running_median_is_its_twin(seed: int, half: int) -> None:
    rng = np.random.default_rng(seed)
    band = rng.normal(0.0, 100.0, (rng.integers(1, 6), rng.integers(1, 30))).astype(np.float32)
    background = np.full_like(band, np.nan)
    median_background(band, half, background)
    np.testing.assert_allclose(background, twins.running_median(band, half), rtol=1e-6)


@settings(deadline=None, max_examples=20)
@given(seeds, st.floats(0.0, 5.0), st.floats(-200.0, 200.0))
def test_light_at_its_level_is_its_twin(seed: int, level: float, black_e: float) -> None:
    light_e = np.random.default_rng(seed).uniform(0.0, 1e4, (7, 33)).astype(np.float32)
    light_e[2, 5] = np.nan
    background_e = light_e.copy()
    at_level(background_e, LightLevel(level, black_e))
    np.testing.assert_allclose(background_e, light_e * level + black_e, rtol=1e-6, atol=1e-3)


@settings(deadline=None, max_examples=20)
@given(seeds, st.floats(0.0, 2.0), st.floats(1.0, 1e4))
def test_weigh_is_its_twin(seed: int, shot: float, dark: float) -> None:
    rng = np.random.default_rng(seed)
    charge, background = rng.normal(200.0, 300.0, (2, *rng.integers(1, 30, 2))).astype(np.float32)
    background[rng.random(background.shape) < 0.1] = np.nan
    residual, variance = np.full((2, *charge.shape), np.inf, np.float32)
    for line in zip(charge, background, residual, variance, strict=True):
        weigh(*line[:2], shot, dark, *line[2:])
    np.testing.assert_array_equal(residual, charge - background)
    np.testing.assert_allclose(variance, shot * np.maximum(background, 0.0) + dark, rtol=1e-6)


def placed(center: Float64, n_pos: int, half: int) -> tuple[Int64, int]:
    """Where a band begins, and its depth."""
    lows = np.empty(-(-len(center) // CELL), np.int64)
    return lows, place(center, n_pos, half, lows)


@settings(deadline=None)
@given(seeds, st.integers(1, 60))
def test_a_band_is_placed_as_its_twin(seed: int, half: int) -> None:
    rng = np.random.default_rng(seed)
    n_pos = int(rng.integers(16, 300))
    center = rng.uniform(-20.0, n_pos + 20.0) + rng.normal(0.0, 4.0, rng.integers(1, 80)).cumsum()
    lows, depth = placed(center, n_pos, half)
    parts = [center[i : i + CELL] for i in range(0, len(center), CELL)]
    spread = max(float(np.ptp(part)) for part in parts)
    assert depth == min(n_pos, 2 * half + int(np.ceil(min(spread, half))) + 1)
    middles = np.array([0.5 * (part.min() + part.max()) for part in parts])
    np.testing.assert_array_equal(lows, np.clip(np.rint(middles - depth / 2.0), 0, n_pos - depth))


@settings(deadline=None)
@given(seeds, st.integers(1, 60))
def test_a_band_lies_in_the_image_and_holds_what_it_should(seed: int, half: int) -> None:
    rng = np.random.default_rng(seed)
    n_scan, n_pos = int(rng.integers(1, 80)), int(rng.integers(16, 300))
    slope = rng.uniform(-1.0, 1.0)
    center = rng.uniform(-50.0, n_pos + 50.0) + slope * np.arange(n_scan)
    lows, depth = placed(center, n_pos, half)
    assert lows.shape == (-(-n_scan // CELL),)
    assert depth <= n_pos
    assert (lows >= 0).all()
    assert (lows + depth <= n_pos).all()
    begin = np.repeat(lows, CELL)[:n_scan]
    # To a pixel; what reaches beyond the image, or hangs off a line steeper than the band, cannot be held.
    if 7 * abs(slope) <= half:
        assert (begin <= np.clip(center - half + 1.0, 0.0, n_pos)).all()
        assert (begin + depth - 1 >= np.clip(center + half - 1.0, 0.0, n_pos - 1)).all()


@pytest.mark.parametrize("at", [-1e6, 1e6])
def test_a_band_far_off_the_image_is_held_at_its_rim(at: float) -> None:
    lows, depth = placed(np.full(10, at), 100, 20)
    assert depth == 41
    assert (lows == (0 if at < 0.0 else 59)).all()
