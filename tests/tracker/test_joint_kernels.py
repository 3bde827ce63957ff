"""Parts that the joints' fits share, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracker.joint.common_mode import BIAS_SHARE, COMMON_MODE_PX, NEAR_MM, common_mode_mm
from tracker.joint.evidence import loss
from tracker.joint.lap import ROLL_BY, SEARCH_STEP_MM, placed
from tracker.joint.measured import section_at, shift_of
from tracker.joint.section_fit import BISQUARE_WIDTH
from tracker.state import BIAS_PX, DY_MM, DZ_MM, N_ROWS, Y_MM

seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(0, 200), st.booleans())
def test_a_sections_height_and_slope_are_its_corners(seed: int, n: int, is_upright: bool) -> None:
    rng = np.random.default_rng(seed)
    y, z = np.sort(rng.uniform(-10.0, 10.0, 6)), rng.normal(size=6)
    if is_upright:
        y[3] = y[2]
    places = rng.uniform(-12.0, 12.0, n)
    height_mm, slope = section_at(np.column_stack([y, z]), places)
    face = np.clip(np.searchsorted(y, places, side="right") - 1, 0, 4)
    width = np.diff(y)[face]
    steepness = np.divide(np.diff(z)[face], width, out=np.zeros(n), where=width > 0.0)
    np.testing.assert_allclose(slope, steepness, rtol=1e-12)
    np.testing.assert_allclose(height_mm, z[face] + steepness * (places - y[face]), rtol=1e-12, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(1, 300), st.booleans())
def test_common_mode_error_is_the_median_of_the_correction(seed: int, n: int, has_bias: bool) -> None:
    rng = np.random.default_rng(seed)
    y, bias = np.sort(rng.uniform(-12.0, 12.0, n)), rng.normal(size=n)
    dy, dz = rng.normal(size=(2, n))
    near = np.abs(y - 0.7) < NEAR_MM
    off_px = COMMON_MODE_PX
    if has_bias and near.any():
        off_px = float(np.hypot(off_px, BIAS_SHARE * np.median(np.abs(bias[near]))))
    points = np.zeros((N_ROWS, n))
    points[Y_MM], points[DY_MM], points[DZ_MM], points[BIAS_PX] = y, dy, dz, bias if has_bias else 0.0
    found = common_mode_mm(points, 0.7)
    assert found == pytest.approx((off_px * np.median(dy), off_px * np.median(dz)), rel=1e-5)


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(0, 300))
def test_the_loss_is_tukeys(seed: int, n: int) -> None:
    off = np.random.default_rng(seed).normal(0.0, 4.0, n)
    weights = np.maximum(1.0 - (off / BISQUARE_WIDTH) ** 2, 0.0) ** 2
    assert loss(off, np.ones(n), 0.3) == pytest.approx(BISQUARE_WIDTH**2 / 6.0 * np.sum(1.0 - weights**1.5))


@settings(deadline=None, max_examples=20)
@given(seeds, st.floats(-0.3, 0.3), st.floats(-2.0, 2.0))
def test_a_rolled_lap_is_placed_as_a_level_one(seed: int, roll: float, edge_mm: float) -> None:
    rng = np.random.default_rng(seed)
    corners = np.array([[-20.0, 2.0], [0.0, 2.0], [0.0, 0.0], [20.0, 0.0]])
    y = np.linspace(-9.0, 9.0, 400)
    level = np.where(y < edge_mm, 2.0, 0.0) + 0.01 * rng.normal(size=400)
    found, *shift = placed(y, level + roll * y, 5.0, corners, 0.5)
    apart = len(y) // ROLL_BY
    slopes = (level[apart:] - level[:-apart]) / (y[apart:] - y[:-apart]) + roll
    assert found == pytest.approx(np.median(slopes), abs=1e-6)
    twin = shift_of(y, level + (roll - found) * y, 5.0, corners, 0.0, SEARCH_STEP_MM, 0.5)
    assert shift == pytest.approx(twin, abs=1e-6)
    assert shift[0] == pytest.approx(edge_mm, abs=SEARCH_STEP_MM)
