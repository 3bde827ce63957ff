"""The log evidence of linear hypotheses, against densities computed in full."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import simpson
from scipy.stats import multivariate_normal, norm

from sim_to_real.evidence.metric import Metric, compress, log_evidence, robust_weights

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
    # Less than the errors are, so that these stay as stated.
    residuals = 0.3 * residuals
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


MANY = 10**9
"""What is left of so many residuals is less than the errors are: these stay as stated."""


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("size", [2.0, 0.1, -2.0, -9.0])
def test_a_bounded_size_has_a_half_normal_prior(side, size):
    draw = np.random.default_rng(3)
    column = draw.standard_normal(N)
    residuals = 0.7 * draw.standard_normal(N) - size * column
    z = side * np.linspace(0.0, 12.0, 600_001)
    squares = residuals @ residuals + 2.0 * z * (residuals @ column) + z**2 * (column @ column)
    ln = math.log(2.0) + norm.logpdf(z) - 0.5 * squares
    expected = ln.max() + math.log(float(simpson(np.exp(ln - ln.max()), dx=12.0 / 600_000)))
    both = np.column_stack([column, residuals])
    assert log_evidence(both.T @ both, np.array([side]), MANY) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("alike", [0.0, 0.7, 0.97])
@pytest.mark.parametrize("sizes", [(1.0, 2.0), (1.0, -1.5), (-1.0, -2.0), (-0.1, 0.2)])
def test_bounded_sizes_that_do_much_the_same_are_bounded_together(alike, sizes):
    """Against the integral over a grid of both."""
    draw = np.random.default_rng(4)
    first, other, noise = draw.standard_normal((3, N))
    second = alike * first + math.sqrt(1.0 - alike**2) * other
    residuals = 0.7 * noise - sizes[0] * first - sizes[1] * second
    z = np.linspace(0.0, 6.0, 2001)
    both = np.column_stack([first, second, residuals])
    P = both.T @ both
    x, y = np.meshgrid(z, z, indexing="ij")
    squares = P[2, 2] + 2.0 * (x * P[0, 2] + y * P[1, 2]) + x**2 * P[0, 0] + y**2 * P[1, 1]
    squares += 2.0 * x * y * P[0, 1]
    ln = 2.0 * math.log(2.0) + norm.logpdf(x) + norm.logpdf(y) - 0.5 * squares
    step = z[1]
    expected = ln.max() + math.log(simpson(simpson(np.exp(ln - ln.max()), dx=step), dx=step))
    # Each size's tail is taken by itself, which of two that do the same is off by a nat.
    assert log_evidence(P, np.ones(2), MANY) == pytest.approx(expected, abs=1.3 if alike > 0.9 else 0.5)


def test_a_size_that_is_pulled_beyond_its_bound_does_not_widen_the_errors_less():
    """What it leaves is what is left without it, and the errors are as much larger."""
    draw = np.random.default_rng(5)
    column = draw.standard_normal(N)
    residuals = draw.standard_normal(N) + 30.0 * column
    metric = Metric(np.ones(N, dtype=np.float32), np.zeros((1, N)))
    without = metric.log_evidence(residuals, 1e-9 * column[:, np.newaxis])
    bounded = metric.log_evidence(residuals, column[:, np.newaxis], np.ones(1))
    assert without - 6.0 < bounded < without


def test_of_nothing_but_residuals_the_evidence_is_their_density():
    residuals = drawn(4)[0]
    products = np.array([[residuals @ residuals]])
    assert log_evidence(products, np.zeros(0), MANY) == pytest.approx(-0.5 * residuals @ residuals)


def test_fewer_columns_have_the_same_covariance():
    floor = drawn(5, m=4)[2]
    repeated = np.hstack([floor, floor, 1e-3 * floor]).astype(np.float32)
    compact = compress(repeated)
    assert compact.shape[1] == 4
    np.testing.assert_allclose(compact @ compact.T, repeated @ repeated.T, atol=1e-4)


def test_what_nothing_explains_has_little_weight():
    residuals, columns, _, _ = drawn(6)
    residuals[7] += 60.0
    weights = robust_weights(residuals, columns.astype(np.float32), 6.0)
    assert weights[7] < 0.02
    assert np.median(weights) > 0.9
    assert weights.max() <= 1.0


@pytest.mark.parametrize("scale", [0.7, 1.0, 3.0, 12.0])
def test_errors_may_be_larger_than_stated_by_what_is_left(scale):
    """The evidence is the largest over one factor of all errors, at least 1."""
    residuals, columns, floor, weights = drawn(8)
    residuals = scale * residuals / np.sqrt(np.mean(residuals**2))
    metric = Metric.of(floor, weights)

    def at(variance):
        root = math.sqrt(variance)
        wide = Metric.of((root * floor).astype(np.float32), (weights / variance).astype(np.float32))
        both = np.column_stack([columns, residuals])
        products = wide.products(both, both)
        # What is left of so many is less than the errors are: nothing is rescaled.
        return log_evidence(products, np.zeros(3), MANY) - 0.5 * N * math.log(variance)

    best = max(at(variance) for variance in np.geomspace(1.0, 400.0, 400))
    assert metric.log_evidence(residuals, columns) == pytest.approx(best, abs=0.2)


def test_what_two_leave_counts_by_its_ratio():
    """Both leave far more than the errors are: doubling the errors changes nothing between them."""
    residuals, columns, floor, weights = drawn(9)
    metric = Metric.of(0.0 * floor, weights)
    apart = [
        metric.log_evidence(scale * 50.0 * residuals, 1e-9 * columns)
        - metric.log_evidence(scale * 100.0 * residuals, 1e-9 * columns)
        for scale in (1.0, 2.0)
    ]
    assert apart[0] == pytest.approx(N * math.log(2.0), rel=1e-3)
    assert apart[1] == pytest.approx(apart[0], rel=1e-3)
