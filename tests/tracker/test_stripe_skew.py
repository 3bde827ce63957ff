"""What a step of brightness that runs skewed does to centres: against moments, and a plain twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from noise_model.compiled.arrays import Float64
from tracker.profile import MIN_CONTRAST, MIN_HELD, STEP_LINES, STEP_SIGMAS, skewed_sigma_px

N_LINES, WIDTH_PX, PSF_PX, STEP = 60, 2.2, 0.7, 30.4
SCANS = np.arange(float(N_LINES))


def plain_skewed_sigma_px(amplitude: Float64, width: Float64, contrast: float, lines: float) -> Float64:
    """The module's formula, line by line."""
    sigma = np.zeros(len(amplitude))
    for s in range(len(amplitude)):
        before = [math.log(a) for a in amplitude[max(s - STEP_LINES, 0) : s] if a > 0.0]
        behind = [math.log(a) for a in amplitude[s + 1 : s + 1 + STEP_LINES] if a > 0.0]
        if min(len(before), len(behind)) < MIN_HELD:
            continue
        scatter = max(contrast, MIN_CONTRAST) * math.sqrt(1.0 / len(before) + 1.0 / len(behind))
        if abs(np.mean(behind) - np.mean(before)) > STEP_SIGMAS * scatter and not math.isnan(width[s]):
            sigma[s] = width[s] * lines * 0.5 * abs(behind[0] - before[-1])
    return sigma


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.5), st.floats(0.0, 0.6))
def test_the_kernel_is_its_twin(seed: int, contrast: float, lost: float) -> None:
    rng = np.random.default_rng(seed)
    amplitude = np.exp(rng.normal(0.0, 0.2, N_LINES)) * np.where(SCANS < STEP, 5000.0, 900.0)
    width = rng.uniform(1.5, 3.0, N_LINES)
    gone = rng.random(N_LINES) < lost
    amplitude[gone], width[gone] = np.nan, np.nan
    np.testing.assert_allclose(
        skewed_sigma_px(amplitude, width, contrast, 0.3),
        plain_skewed_sigma_px(amplitude, width, contrast, 0.3),
        atol=1e-12,
    )


@pytest.mark.parametrize("slope", [0.03, -0.08])
@pytest.mark.parametrize("dark", [0.15, 0.5])
def test_it_is_how_far_moments_move(slope: float, dark: float) -> None:
    """Light is drawn pixel by pixel, the step moving by `slope` lines a pixel; dim lines lie beyond it."""
    across = np.linspace(-8.0 * WIDTH_PX, 8.0 * WIDTH_PX, 4001)
    bell = np.exp(-0.5 * (across / WIDTH_PX) ** 2)
    share = ndtr((SCANS[:, None] + slope * across - STEP) / PSF_PX)
    light = bell * (1.0 + (dark - 1.0) * share)
    moved = np.abs(light @ across / light.sum(axis=1))
    told = skewed_sigma_px(light.max(axis=1), np.full(N_LINES, WIDTH_PX), 0.0, abs(slope) * WIDTH_PX)
    worst = int(np.argmax(moved))
    assert moved[worst] > 0.03
    assert told[worst] == pytest.approx(moved[worst], rel=0.3)
    assert told[moved < 1e-3].max() < 0.02


def test_what_speckle_explains_counts_for_nothing() -> None:
    rng, contrast = np.random.default_rng(3), 0.3
    speckled = np.exp(contrast * rng.standard_normal(2000))
    told = skewed_sigma_px(speckled, np.full(2000, WIDTH_PX), contrast, 0.3)
    assert np.mean(told > 0.0) < 0.02
