"""Sixteen numbers at once against NumPy's sixteen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from noise_model.compiled.arrays import Bool, Float32
from noise_model.compiled.kernel import kernel
from noise_model.compiled.lanes import (
    N_LANES,
    all_lanes,
    any_lane,
    bits_of,
    float_of,
    floor,
    greater,
    least,
    lesser,
    load,
    root,
    spread,
    store,
    total,
    transpose,
    where,
)

seeds = st.integers(0, 2**32 - 1)


@kernel
def arithmetic(a: Float32, b: Float32, number: float, out: Float32) -> None:
    """Write, from the second number on: sum, difference ... least and greatest."""
    x, y = load(a, 1), load(b, 1)
    store(out[0], 1, x + y)
    store(out[1], 1, x - y)
    store(out[2], 1, x * y)
    store(out[3], 1, x / y)
    store(out[4], 1, root(y))
    store(out[5], 1, spread(number))
    x += y
    x *= y
    x -= y
    x /= y
    store(out[6], 1, x)
    store(out[7], 1, floor(load(a, 1)))
    store(out[8], 1, lesser(load(a, 1), y))
    store(out[9], 1, greater(load(a, 1), y))


@kernel
def comparisons(a: Float32, b: Float32, out: Float32, answers: Bool, alike: Bool) -> None:
    """Write 1 where a < b, <=, >, >=, ==, both or either; whether one is so, or all; and chosen masks."""
    x, y, no, yes = load(a, 0), load(b, 0), spread(0.0), spread(1.0)
    masks = (x < y, x <= y, x > y, x >= y, x == y, (x < y) & (x < no), (x < y) | (x < no))
    for k in range(len(masks)):
        store(out[k], 0, where(masks[k], yes, no))
        answers[k], alike[k] = any_lane(masks[k]), all_lanes(masks[k])
    store(out[7], 0, where(where(x < no, x < y, x > y), yes, no))


@kernel
def across(a: Float32) -> tuple[float, float]:
    return total(load(a, 0)), least(load(a, 0))


@kernel
def turned(rows: Float32, first: int, into: Float32) -> None:
    transpose(rows, first, into)


@kernel
def there_and_back(value: float) -> float:
    return float_of(bits_of(np.float32(value)))


@settings(deadline=None, max_examples=40)
@given(seeds, st.floats(-1e6, 1e6))
def test_each_lane_computes_as_a_single_number_does(seed: int, number: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0.0, 10.0, (2, N_LANES + 2)).astype(np.float32)
    b = np.abs(b) + np.float32(0.1)
    out = np.full((10, N_LANES + 2), np.nan, np.float32)
    arithmetic(a, b, number, out)
    twins = [a + b, a - b, a * b, a / b, np.sqrt(b), np.full_like(a, number), ((a + b) * b - b) / b]
    twins += [np.floor(a), np.minimum(a, b), np.maximum(a, b)]
    # A product may be joined with a sum.
    np.testing.assert_allclose(out[:, 1:-1], np.array(twins)[:, 1:-1], rtol=1e-5, atol=1e-5)
    # Nothing is written beyond.
    assert np.isnan(out[:, [0, -1]]).all()


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_each_lane_is_compared_by_itself(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.integers(-2, 3, (2, N_LANES)).astype(np.float32)
    a[rng.random(N_LANES) < 0.2], b[rng.random(N_LANES) < 0.2] = np.nan, np.nan
    if seed % 4 == 0:
        a, b = np.full_like(a, -2.0), np.full_like(b, 3.0)
    out, answers, alike = np.empty((8, N_LANES), np.float32), np.empty(7, np.bool_), np.empty(7, np.bool_)
    comparisons(a, b, out, answers, alike)
    twins = [a < b, a <= b, a > b, a >= b, a == b, (a < b) & (a < 0.0), (a < b) | (a < 0.0)]
    np.testing.assert_array_equal(out[:7] == 1.0, twins)
    np.testing.assert_array_equal(answers, np.any(twins, axis=1))
    np.testing.assert_array_equal(alike, np.all(twins, axis=1))
    np.testing.assert_array_equal(out[7] == 1.0, np.where(a < 0.0, a < b, a > b))


@settings(deadline=None, max_examples=20)
@given(seeds)
def test_sums_and_the_least_go_across_all_lanes(seed: int) -> None:
    a = np.random.default_rng(seed).normal(size=N_LANES).astype(np.float32)
    added, lowest = across(a)
    assert added == pytest.approx(a.sum(dtype=np.float64), abs=1e-5)
    assert lowest == a.min()


@pytest.mark.parametrize("first", [0, N_LANES, 5])
def test_each_row_becomes_a_lane(first: int) -> None:
    rows = np.arange(N_LANES * 40, dtype=np.float32).reshape(N_LANES, 40)
    into = np.full(40 * N_LANES, -1.0, np.float32)
    turned(rows, first, into)
    vectors, taken = into.reshape(40, N_LANES), slice(first, first + N_LANES)
    np.testing.assert_array_equal(vectors[taken], rows[:, taken].T)
    # Nothing is written beside.
    vectors[taken] = -1.0
    assert (into == -1.0).all()


@settings(deadline=None)
@given(st.floats(width=32, allow_nan=False))
def test_a_number_is_its_bits(value: float) -> None:
    assert there_and_back(value) == value
