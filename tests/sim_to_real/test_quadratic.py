"""The cost of a fit as a quadratic, and the loss that it comes from."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from noise_model.fit import Parameter
from sim_to_real.evidence.metric import Metric, MetricLoss
from sim_to_real.fit.loss import N_EFFECTIVE, HuberLoss
from sim_to_real.fit.quadratic import Quadratic

N = 120
STARTS, SIGMA = np.array([0.0, 0.1, 0.2]), 2.0


def problem(seed, bounds=(-np.inf, np.inf)):
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((N, 3))
    r = rng.standard_normal(N) + J @ [0.5, -1.0, 2.0]
    parameters = tuple(Parameter(f"p{i}", "", start, SIGMA, *bounds) for i, start in enumerate(STARTS))
    return parameters, STARTS, r, J


def of_squares(parameters, x, r, J, prior_weight=1.0):
    """The quadratic of plain least squares."""
    return Quadratic(parameters, x, J.T @ J, -J.T @ r, r @ r, prior_weight)


@pytest.mark.parametrize("bounds", [(-np.inf, np.inf), (-0.4, 0.9)])
@pytest.mark.parametrize("prior_weight", [1.0, 30.0])
def test_the_minimum_is_that_of_plain_least_squares(bounds, prior_weight):
    parameters, x, r, J = problem(1, bounds)

    def residuals(value):
        return np.concatenate([r + J @ (value - x), np.sqrt(prior_weight) * (value - STARTS) / SIGMA])

    expected = least_squares(residuals, np.clip(x, *bounds), bounds=bounds, xtol=1e-14, ftol=1e-14)
    quadratic = of_squares(parameters, x, r, J, prior_weight)
    result = quadratic.solve()
    np.testing.assert_allclose(result, expected.x, atol=1e-6)
    assert quadratic.total(result) == pytest.approx(2.0 * expected.cost)


def test_a_direction_that_nothing_sees_stays_where_it_is():
    parameters, x, r, J = problem(3)
    free = tuple(Parameter(p.name, "", p.start) for p in parameters)
    J[:, 2] = 0.0
    result = of_squares(free, x, r, J).solve()
    assert result[2] == x[2]
    assert np.isfinite(result).all()


def test_no_parameter_ends_beyond_its_bounds_even_by_rounding():
    low, high = -1.0 / 30.0, 0.7 / 3.0
    for seed in range(200):
        parameters, x, r, J = problem(seed, (low, high))
        inside = np.clip(x + np.random.default_rng(seed).uniform(-0.3, 0.9, 3), low, high)
        result = of_squares(parameters, inside, r, J).solve()
        assert (result >= low).all()
        assert (result <= high).all()


def test_hubers_loss_has_the_slope_that_its_quadratic_has():
    parameters, x, r, J = problem(5)
    r[:5] += 40.0
    loss = HuberLoss.about(r)
    quadratic, step = loss.quadratic(parameters, x, r, J), 1e-6
    for i, direction in enumerate(np.eye(3)):
        ahead, back = (loss.cost(r + sign * step * J @ direction) for sign in (1.0, -1.0))
        assert (ahead - back) / (2.0 * step) == pytest.approx(-2.0 * quadratic.gradient[i], rel=1e-5)


def test_what_is_known_before_counts_the_more_the_more_is_left():
    """Residuals of ten times the size, the model off by as much: priors keep the parameters nearer."""
    r = problem(4)[2]
    near, far = (HuberLoss.about(scale * r).prior_weight for scale in (3.0, 30.0))
    assert far == pytest.approx(100.0 * near)
    assert near == pytest.approx(9.0 * r @ r / min(N, N_EFFECTIVE), rel=0.2)


def test_a_metric_s_cost_is_that_of_the_whole_covariance():
    """Twice what residuals take from the log density."""
    parameters, x, r, J = problem(6)
    draw = np.random.default_rng(6)
    floor, weights = draw.standard_normal((N, 4)).astype(np.float32), draw.uniform(0.3, 1.0, N)
    loss = MetricLoss(Metric.of(floor, weights.astype(np.float32)))
    inverse = np.linalg.inv(np.diag(1.0 / weights) + floor @ floor.T)
    assert loss.cost(r) == pytest.approx(r @ inverse @ r, rel=1e-4)
    quadratic = loss.quadratic(parameters, x, r, J)
    np.testing.assert_allclose(quadratic.information, J.T @ inverse @ J, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(quadratic.gradient, -J.T @ inverse @ r, rtol=1e-4, atol=1e-3)
    assert quadratic.chi2 == pytest.approx(loss.cost(r))
