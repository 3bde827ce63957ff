"""The log evidence of linear hypotheses, against densities computed in full."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import simpson
from scipy.stats import multivariate_normal, norm

from sim_to_real.evidence.metric import Metric, compressed, log_evidence, robust_weights

N = 40


def drawn(seed, k=3, m=5):
    """Residuals, columns, the model's own error and weights."""
    draw = np.random.default_rng(seed)
    columns, floor = draw.standard_normal((N, k)), draw.standard_normal((N, m)).astype(np.float32)
    residuals = draw.standard_normal(N) + columns @ draw.standard_normal(k)
    return residuals, columns, floor, draw.uniform(0.3, 1.0, N).astype(np.float32)


def density(residuals, columns, floor, weights):
    """The log density of residuals in full, nats."""
    covariance = np.diag(1.0 / weights) + floor @ floor.T + columns @ columns.T
    return multivariate_normal(np.zeros(len(residuals)), covariance).logpdf(residuals)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_hypotheses_differ_by_what_their_densities_do(seed):
    residuals, columns, floor, weights = drawn(seed)
    metric = Metric.of(floor, weights)
    both, fewer = (metric.log_evidence(residuals, some) for some in (columns, columns[:, :1]))
    expected, of_fewer = (density(residuals, some, floor, weights) for some in (columns, columns[:, :1]))
    assert both - fewer == pytest.approx(expected - of_fewer, abs=2e-4)


def test_columns_that_the_model_s_own_error_has_gain_nothing():
    residuals, columns, floor, weights = drawn(1)
    wide = (30.0 * floor).astype(np.float32)
    metric = Metric.of(wide, weights)
    assert metric.log_evidence(residuals, floor[:, :2]) == pytest.approx(
        metric.log_evidence(residuals, 1e-9 * columns), abs=0.02
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("size", [2.0, 0.1, -2.0])
def test_a_bounded_size_has_a_half_normal_prior(side, size):
    draw = np.random.default_rng(3)
    column = draw.standard_normal(N)
    residuals = 0.7 * draw.standard_normal(N) - size * column
    metric = Metric(np.ones(N, dtype=np.float32), np.zeros((1, N)))

    z = side * np.linspace(0.0, 8.0, 400_001)
    squares = residuals @ residuals + 2.0 * z * (residuals @ column) + z**2 * (column @ column)
    ln = math.log(2.0) + norm.logpdf(z) - 0.5 * squares
    expected = ln.max() + math.log(float(simpson(np.exp(ln - ln.max()), dx=8.0 / 400_000)))
    bounded = metric.log_evidence(residuals, column[:, np.newaxis], np.array([side]))
    assert bounded == pytest.approx(expected, abs=1e-5)


def test_of_nothing_but_residuals_the_evidence_is_their_density():
    residuals = drawn(4)[0]
    products = np.array([[residuals @ residuals]])
    assert log_evidence(products, np.zeros(0)) == pytest.approx(-0.5 * residuals @ residuals)


def test_fewer_columns_have_the_same_covariance():
    floor = drawn(5, m=4)[2]
    repeated = np.hstack([floor, floor, 1e-3 * floor]).astype(np.float32)
    compact = compressed(repeated)
    assert compact.shape[1] == 4
    np.testing.assert_allclose(compact @ compact.T, repeated @ repeated.T, atol=1e-4)


def test_what_nothing_explains_has_little_weight():
    residuals, columns, _, _ = drawn(6)
    residuals[7] += 60.0
    weights = robust_weights(residuals, columns.astype(np.float32), 6.0)
    assert weights[7] < 0.02
    assert np.median(weights) > 0.9
    assert weights.max() <= 1.0
