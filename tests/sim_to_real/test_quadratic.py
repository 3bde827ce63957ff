"""The cost of a fit as a quadratic of each frame."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from noise_model.fit import Parameter
from sim_to_real.fit.quadratic import N_EFFECTIVE, Quadratic

COUNTS = np.array([30, 50, 40])


def problem(seed, bounds=(-np.inf, np.inf)):
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((COUNTS.sum(), 3))
    r = rng.standard_normal(COUNTS.sum()) + J @ [0.5, -1.0, 2.0]
    w = rng.uniform(0.2, 1.0, COUNTS.sum())
    parameters = tuple(Parameter(f"p{i}", "", 0.1 * i, 2.0, *bounds) for i in range(3))
    return parameters, np.array([0.0, 0.1, 0.2]), r, J, w


@pytest.mark.parametrize("bounds", [(-np.inf, np.inf), (-0.4, 0.9)])
def test_the_minimum_is_that_of_plain_least_squares(bounds):
    parameters, x, r, J, w = problem(1, bounds)
    chosen = np.array([True, False, True])
    rows = np.repeat(chosen, COUNTS)
    starts, sigmas = np.array([0.0, 0.1, 0.2]), 2.0

    # So many of all residuals are independent, and what is left is their variance.
    weight = (w @ r**2) / min(len(r), N_EFFECTIVE)

    def residuals(value):
        pulls = np.sqrt(weight) * (value - starts) / sigmas
        return np.concatenate([np.sqrt(w[rows]) * (r + J @ (value - x))[rows], pulls])

    expected = least_squares(residuals, np.clip(x, *bounds), bounds=bounds, xtol=1e-14, ftol=1e-14).x
    result = Quadratic.of(parameters, x, r, J, w, COUNTS).solve(chosen)
    np.testing.assert_allclose(result, expected, atol=1e-6)


def test_what_is_fixed_stays_and_the_others_are_best_beside_it():
    parameters, x, r, J, w = problem(5)
    result = Quadratic.of(parameters, x, r, J, w, COUNTS).solve(fixed=slice(1, 2))
    assert result[1] == x[1]
    others = [0, 2]
    weight = (w @ r**2) / min(len(r), N_EFFECTIVE)
    A = J[:, others].T @ (w[:, np.newaxis] * J[:, others]) + weight / 4.0 * np.eye(2)
    # x starts where the priors pull to.
    np.testing.assert_allclose(result[others] - x[others], np.linalg.solve(A, -J[:, others].T @ (w * r)))


def test_about_another_point_it_is_the_same():
    parameters, x, r, J, w = problem(8)
    here, there = Quadratic.of(parameters, x, r, J, w, COUNTS), np.array([0.4, -0.3, 1.0])
    moved = Quadratic.of(parameters, there, r + J @ (there - x), J, w, COUNTS)
    result = here.expanded_at(there)
    for name in ("x", "information", "gradient", "chi2"):
        np.testing.assert_allclose(getattr(result, name), getattr(moved, name))


def test_along_some_of_the_parameters_all_frames_at_once_it_is_the_same():
    parameters, x, r, J, w = problem(6, (-0.4, 0.9))
    whole, kept = Quadratic.of(parameters, x, r, J, w, COUNTS), np.array([0, 2])
    some = whole.summed().restricted_to(kept)
    np.testing.assert_allclose(some.solve(), whole.solve(fixed=slice(1, 2))[kept])
    value = np.array([0.3, x[1], -0.1])
    np.testing.assert_allclose(some.costs(value[kept]), whole.costs(value).sum())


def test_costs_are_the_weighted_squares_of_each_frame():
    parameters, x, r, J, w = problem(2)
    value = np.array([0.3, -0.2, 1.0])
    there = w * (r + J @ (value - x)) ** 2
    expected = [part.sum() for part in np.split(there, np.cumsum(COUNTS)[:-1])]
    np.testing.assert_allclose(Quadratic.of(parameters, x, r, J, w, COUNTS).costs(value), expected)


def test_what_is_known_before_counts_the_more_the_more_is_left():
    """Residuals of ten times the size, the model off by as much: priors keep the parameters nearer."""
    parameters, x, r, J, w = problem(4)
    J = 0.05 * J
    near, far = (Quadratic.of(parameters, x, scale * r, J, w, COUNTS) for scale in (1.0, 10.0))
    assert far.prior_weight == pytest.approx(100.0 * near.prior_weight)
    every = np.ones(3, dtype=bool)
    assert np.linalg.norm(far.solve(every) - x) < 3.0 * np.linalg.norm(near.solve(every) - x)


def test_a_direction_that_nothing_sees_stays_where_it_is():
    parameters, x, r, J, w = problem(3)
    free = tuple(Parameter(p.name, "", p.start) for p in parameters)
    J[:, 2] = 0.0
    result = Quadratic.of(free, x, r, J, w, COUNTS).solve(np.ones(3, dtype=bool))
    assert result[2] == x[2]
    assert np.isfinite(result).all()


def test_no_parameter_ends_beyond_its_bounds_even_by_rounding():
    low, high = -1.0 / 30.0, 0.7 / 3.0
    for seed in range(200):
        parameters, x, r, J, w = problem(seed, (low, high))
        inside = np.clip(x + np.random.default_rng(seed).uniform(-0.3, 0.9, 3), low, high)
        result = Quadratic.of(parameters, inside, r, J, w, COUNTS).solve()
        assert (result >= low).all()
        assert (result <= high).all()
