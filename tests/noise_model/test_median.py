from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noise_model.compiled.median import close_up, known_median, median, median_of, numbers_for

numbers = st.floats(-1e9, 1e9)


@given(st.lists(numbers, min_size=1, max_size=40))
def test_the_median_is_numpys_bit_for_bit(values):
    assert median(values) == np.median(values)
    assert median(np.array([values, values]).T[:, 1]) == np.median(values)


alike = st.integers(-3, 3).map(lambda n: 1.0 + 1e-12 * n) | st.sampled_from([0.0, 1e-300, 1e300, np.inf])


@given(st.lists(alike, min_size=1, max_size=200))
def test_values_that_round_to_the_same_are_told_apart(values):
    assert median(values) == np.median(values)


@given(st.lists(numbers | st.just(float("nan")), min_size=1, max_size=40))
def test_the_known_median_is_numpys(values):
    known = [value for value in values if value == value]
    if known:
        assert known_median(values) == np.nanmedian(values)
        assert len(known) == len(values) or np.isnan(median(values))
    else:
        assert np.isnan(known_median(values))


@pytest.mark.parametrize("middle", [median, known_median])
def test_of_nothing_the_median_is_not_known(middle):
    assert np.isnan(middle([]))


@given(st.lists(st.floats(-(2.0**100), 2.0**100, width=32), max_size=200), st.booleans())
def test_the_median_by_counting_is_that_by_sorting(values, are_rounded):
    drawn = np.array(values, np.float32)
    drawn = np.rint(drawn) if are_rounded else drawn
    room = np.full(numbers_for(len(drawn)), np.nan, np.float32)
    room[: len(drawn)] = drawn
    expected = np.median(drawn.astype(np.float64)) if len(drawn) else np.nan
    np.testing.assert_array_equal(median_of(room, len(drawn)), expected)


@given(st.lists(st.floats(width=32), max_size=200))
def test_what_is_finite_moves_to_the_front(values):
    drawn = np.array(values, np.float32)
    room = np.append(drawn, np.float32(7.0))
    finite = drawn[np.isfinite(drawn)]
    assert close_up(room, len(drawn)) == len(finite)
    np.testing.assert_array_equal(room[: len(finite)], finite)
    assert room[-1] == 7.0
