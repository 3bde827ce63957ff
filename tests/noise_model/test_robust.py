import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from noise_model.compiled.arrays import Float64
from noise_model.robust import sigma_of, spread

VALUES = arrays(np.float64, st.integers(1, 30), elements=st.floats(-1e3, 1e3))


def test_wrong_values_hardly_move_it() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, 20_000)
    assert spread(values) == pytest.approx(2.0, rel=0.03)
    values[:1000] = 1e6
    assert spread(values) == pytest.approx(2.0, rel=0.1)


@given(VALUES, st.floats(-1e3, 1e3), st.floats(0.01, 100.0))
def test_it_goes_with_the_scale_and_not_with_the_place(values: Float64, place: float, scale: float) -> None:
    assert spread(place + scale * values) == pytest.approx(scale * spread(values), rel=1e-9, abs=1e-6)
    assert sigma_of(-scale * values) == pytest.approx(scale * sigma_of(values), rel=1e-9)


def test_of_none_it_is_0() -> None:
    assert spread(np.empty(0)) == 0.0
