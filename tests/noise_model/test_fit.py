import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm, t

from noise_model.fit import Fit, Parameter, correlation, fit, student_t, within_bounds

Float64 = NDArray[np.float64]

X = np.linspace(-1.0, 1.0, 40)


def line(noise: Float64, sigma: float = 1.0, **priors: float) -> Fit:
    """Fit a line to 2 + 3 x with noise in sigmas of 0.1."""
    y = 2.0 + 3.0 * X + 0.1 * noise
    parameters = [
        Parameter("offset", "mm", 0.0, prior_sigma=priors.get("offset", math.inf)),
        Parameter("slope", "", 0.0, prior_sigma=priors.get("slope", math.inf)),
    ]
    return fit(parameters, lambda p: (y - p[0] - p[1] * X) / (0.1 * sigma))


def test_a_line_is_weighted_least_squares() -> None:
    noise = np.random.default_rng(1).normal(size=X.size)
    found = line(noise)
    A = np.column_stack([np.ones_like(X), X]) / 0.1
    covariance = np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(found.values, [2.0, 3.0] + covariance @ A.T @ noise, rtol=1e-7)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found.sigmas, np.sqrt(np.diag(covariance)), rtol=1e-7)
    assert found.value("slope") == found.values[1]
    assert found.sigma("offset") == found.sigmas[0]
    assert found.freedom == pytest.approx(X.size - 2)
    residual = noise - A @ covariance @ A.T @ noise
    assert found.chi2 == pytest.approx(residual @ residual / (X.size - 2), rel=1e-6)
    np.testing.assert_allclose(found.residuals, residual, atol=1e-6)
    np.testing.assert_allclose(found.leverage, np.diag(A @ covariance @ A.T), rtol=1e-6)
    assert found.n_residuals == X.size
    assert found.converged
    assert (found.undetermined, found.not_learned, found.at_bounds) == ((), (), ())


def test_derivatives_that_are_told_are_not_taken_numerically() -> None:
    y, told = np.exp(0.7 * X) + 0.01 * np.random.default_rng(3).normal(size=X.size), []

    def derivatives(p: Float64) -> Float64:
        told.append(float(p[0]))
        return (X * np.exp(p[0] * X))[:, np.newaxis] / 0.01

    rate = Parameter("rate", "", 0.0, prior_sigma=1.0)
    for bound in (math.inf, 2.0):
        numerical = fit([rate], lambda p: (np.exp(p[0] * X) - y) / 0.01, bound)
        found = fit([rate], lambda p: (np.exp(p[0] * X) - y) / 0.01, bound, derivatives=derivatives)
        assert found.values == pytest.approx(numerical.values, rel=1e-6)
        assert found.sigmas == pytest.approx(numerical.sigmas, rel=1e-3)
    assert told[-1] == found.values[0]


def test_a_prior_is_one_more_reading() -> None:
    noise = np.random.default_rng(2).normal(size=X.size)
    found = line(noise, offset=0.02)
    A = np.vstack([np.column_stack([np.ones_like(X), X]) / 0.1, [1.0 / 0.02, 0.0]])
    y = np.append((2.0 + 3.0 * X + 0.1 * noise) / 0.1, 0.0)
    covariance = np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(found.values, covariance @ A.T @ y, rtol=1e-7)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-7, atol=1e-12)


def test_what_a_prior_holds_costs_no_freedom() -> None:
    found = line(np.zeros(X.size), slope=1e-6)
    assert found.not_learned == ("slope",)
    assert found.freedom == pytest.approx(X.size - 1, abs=1e-6)


@pytest.mark.slow
def test_chi2_is_one_on_average_with_the_truth_drawn_from_the_prior() -> None:
    rng = np.random.default_rng(3)
    chi2 = []
    for _ in range(400):
        y = 0.05 * rng.normal() + 3.0 * X[:8] + 0.1 * rng.normal(size=8)
        parameters = [Parameter("offset", "", 0.0, prior_sigma=0.05), Parameter("slope", "", 0.0)]
        chi2.append(fit(parameters, lambda p, y=y: (y - p[0] - p[1] * X[:8]) / 0.1).chi2)
    assert np.mean(chi2) == pytest.approx(1.0, abs=4.0 * np.std(chi2) / 20.0)


def decay(p: Float64) -> Float64:
    return np.asarray(p[0] * np.exp(-p[1] * np.linspace(0.0, 3.0, 25)))


@pytest.mark.slow
def test_a_curve_comes_back_with_its_covariance() -> None:
    rng = np.random.default_rng(4)
    parameters = [Parameter("height", "e-", 1.0, lower=0.0), Parameter("rate", "1/s", 0.5, lower=0.0)]
    truth = np.array([5.0, 1.3])
    readings = decay(truth) + 0.05 * rng.normal(size=(300, 25))
    fits = [fit(parameters, lambda p, y=y: (y - decay(p)) / 0.05) for y in readings]
    pulls = np.array([(f.values - truth) / f.sigmas for f in fits])
    assert np.abs(pulls.mean(axis=0)).max() < 4.0 / math.sqrt(300)
    assert np.abs(pulls.std(axis=0) - 1.0).max() < 4.0 / math.sqrt(600)
    assert np.corrcoef(pulls.T)[0, 1] == pytest.approx(fits[0].correlation[0, 1], abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.1], ids=["clean", "outliers"])
def test_hubers_covariance_holds_with_and_without_outliers(share: float) -> None:
    rng = np.random.default_rng(5)
    x = np.linspace(-1.0, 1.0, 200)
    parameters = [Parameter("offset", "", 0.0), Parameter("slope", "", 0.0)]
    fits = []
    for _ in range(300):
        noise = rng.normal(size=x.size)
        out = rng.random(x.size) < share
        noise[out] += rng.choice([-30.0, 30.0], out.sum())
        fits.append(fit(parameters, lambda p, y=1.0 + x + noise: y - p[0] - p[1] * x, huber=1.345))
    pulls = np.array([(f.values - 1.0) / f.sigmas for f in fits])
    assert np.abs(pulls.std(axis=0) - 1.0).max() < 4.0 / math.sqrt(600)
    chi2 = np.mean([f.chi2 for f in fits])
    assert chi2 == pytest.approx(1.0, abs=0.05) if share == 0.0 else 1.0 < chi2 < 1.6


def test_a_wide_huber_bound_is_least_squares() -> None:
    y = 2.0 + 0.1 * np.random.default_rng(6).normal(size=30)
    parameters = [Parameter("offset", "", 0.0)]
    plain, wide = (fit(parameters, lambda p: (y - p[0]) / 0.1, huber=bound) for bound in (math.inf, 8.0))
    np.testing.assert_allclose(wide.values, plain.values, rtol=1e-9)
    np.testing.assert_allclose(wide.covariance, plain.covariance, rtol=1e-6)
    assert wide.chi2 == pytest.approx(plain.chi2)


def test_priors_are_not_bent_by_hubers_loss() -> None:
    parameters = [Parameter("offset", "", 0.0, prior_sigma=0.01)]
    y = np.full(4, 1.0)
    found = fit(parameters, lambda p: y - p[0], huber=1.345)
    assert found.value("offset") == pytest.approx(4.0 / (4.0 + 1e4), rel=1e-6)


def test_two_parameters_that_do_the_same_are_undetermined_not_well_known() -> None:
    parameters = [Parameter("a", "", 0.0), Parameter("b", "", 0.0), Parameter("slope", "", 0.0)]
    found = fit(parameters, lambda p: (2.0 + X - p[0] - p[1] - p[2] * X) / 0.1)
    assert found.undetermined == ("a", "b")
    assert np.isinf(found.sigmas[:2]).all()
    assert found.sigma("slope") == pytest.approx(0.1 / math.sqrt(np.sum(X**2)))
    assert found.not_learned == ("a", "b")
    assert np.isnan(found.correlation[0, 1])
    assert found.condition > 1e9
    assert found.interval("a") == (-math.inf, math.inf)


def test_a_prior_settles_what_the_data_leave_open() -> None:
    parameters = [Parameter("a", "", 0.0, prior_sigma=0.5), Parameter("b", "", 0.0)]
    found = fit(parameters, lambda p: (2.0 - p[0] - p[1] + 0.0 * X) / 1e-3)
    assert found.undetermined == ()
    assert found.not_learned == ("a",)
    np.testing.assert_allclose(found.sigmas, 0.5, rtol=1e-3)
    assert found.correlation[0, 1] == pytest.approx(-1.0, abs=1e-3)


def test_a_parameter_without_effect_is_undetermined() -> None:
    found = fit([Parameter("offset", "", 0.0), Parameter("idle", "", 0.0)], lambda p: 1.0 - p[0] + 0.0 * X)
    assert found.undetermined == ("idle",)
    assert math.isinf(found.sigma("idle"))
    assert found.sigma("offset") == pytest.approx(1.0 / math.sqrt(X.size))


def test_units_do_not_decide_what_is_determined() -> None:
    parameters = [Parameter("a", "m", 0.0, step=1e-10), Parameter("b", "1/m", 0.0, step=1e2)]
    found = fit(parameters, lambda p: np.concatenate([1.0 - 1e6 * p[0] * X, 1.0 - 1e-6 * p[1] * X**2]))
    assert found.undetermined == ()
    assert found.condition == pytest.approx(1.0, abs=1e-3)


def test_a_value_on_its_bound_is_named() -> None:
    parameters = [Parameter("kappa", "", 0.5, lower=0.0, upper=1.0), Parameter("slope", "", 0.0)]
    y = -0.2 + X
    found = fit(parameters, lambda p: (y - p[0] - p[1] * X) / 0.1)
    assert found.at_bounds == ("kappa",)
    assert found.interval("kappa")[0] == 0.0
    assert found.interval("kappa")[1] > 0.0


def test_bounds_hold_where_the_derivative_is_taken() -> None:
    seen: list[float] = []

    def residuals(p: Float64) -> Float64:
        seen.append(float(p[0]))
        return np.asarray(2.0 - p[0] + 0.0 * X)

    found = fit([Parameter("rho", "", 1.0, lower=0.0, upper=1.0, step=0.01)], residuals)
    assert min(seen) >= 0.0
    assert max(seen) <= 1.0
    assert found.at_bounds == ("rho",)


def test_the_start_can_be_elsewhere_than_the_prior() -> None:
    parameters = [Parameter("phase", "rad", 0.0, prior_sigma=100.0)]

    def residuals(p: Float64) -> Float64:
        return np.asarray((np.cos(2.0 + 5.0 * X) - np.cos(p[0] + 5.0 * X)) / 0.01)

    far = fit(parameters, residuals, start=np.array([8.0]))
    assert far.value("phase") == pytest.approx(2.0 + 2.0 * math.pi, abs=1e-3)


def test_scatter_replaces_a_wrong_whitening() -> None:
    noise = np.random.default_rng(7).normal(size=X.size)
    right, wrong = line(noise).scaled_by_scatter(), line(noise, sigma=5.0).scaled_by_scatter()
    np.testing.assert_allclose(right.covariance, wrong.covariance, rtol=1e-6, atol=1e-12)
    half = right.interval("slope")[1] - right.value("slope")
    assert half == pytest.approx(t.ppf(0.975, X.size - 2) * right.sigma("slope"), rel=1e-6)
    with pytest.raises(ValueError, match="priors"):
        line(noise, slope=1.0).scaled_by_scatter()
    with pytest.raises(ValueError, match="no degree of freedom"):
        fit([Parameter("offset", "", 0.0)], lambda p: 1.0 - p).scaled_by_scatter()


@pytest.mark.parametrize("freedom", [1.0, 3.0, 40.0])
def test_students_quantiles(freedom: float) -> None:
    assert student_t(0.95, freedom) == pytest.approx(t.ppf(0.975, freedom))
    assert student_t(0.68, math.inf) == pytest.approx(norm.ppf(0.84))


def test_correlation_has_a_unit_diagonal() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    np.testing.assert_allclose(correlation(covariance), [[1.0, 1.0 / 6.0], [1.0 / 6.0, 1.0]])


@given(st.lists(st.floats(0.1, 10.0), min_size=2, max_size=2), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
@settings(max_examples=30)
def test_the_estimate_follows_its_units(scale: list[float], offset: float, slope: float) -> None:
    y = offset + slope * X

    def fitted(units: list[float]) -> Fit:
        parameters = [Parameter("offset", "", 0.0), Parameter("slope", "", 0.0)]
        return fit(parameters, lambda p: (y - units[0] * p[0] - units[1] * p[1] * X) / 0.1)

    plain, scaled = fitted([1.0, 1.0]), fitted(scale)
    np.testing.assert_allclose(scaled.values * scale, plain.values, atol=1e-6)
    np.testing.assert_allclose(scaled.sigmas * scale, plain.sigmas, rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lower": 1.0, "upper": 1.0}, "leave no room"),
        ({"start": 2.0, "upper": 1.0}, "starts at 2.0, outside"),
        ({"start": math.nan}, "starts at nan"),
        ({"prior_sigma": 0.0}, "prior's sigma"),
        ({"prior_sigma": math.nan}, "prior's sigma"),
        ({"step": 0.0}, "step of 0.0"),
        ({"step": 0.6, "lower": 0.0, "upper": 1.0}, "step of 0.6"),
        ({"step": math.inf}, "step of inf"),
    ],
)
def test_a_parameter_that_makes_no_sense_is_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(Parameter("c2", "", 0.5), **change)


def test_a_problem_that_cannot_be_posed_is_refused() -> None:
    two = [Parameter("a", "", 0.0), Parameter("b", "", 0.0)]
    with pytest.raises(ValueError, match="1 residuals and 0 priors cannot determine 2 parameters"):
        fit(two, lambda p: p[:1])
    with pytest.raises(ValueError, match="not finite where the fit starts"):
        fit(two, lambda p: p + np.nan)
    with pytest.raises(ValueError, match="b: a residual's derivative is not finite"):
        fit(two, lambda p: np.array([p[0], math.inf if p[1] != 0.0 else 0.0]))
    with pytest.raises(ValueError, match="huber"):
        fit(two, lambda p: p, huber=0.0)
    with pytest.raises(KeyError):
        fit(two, lambda p: p).value("c")


def test_values_outside_their_bounds_are_put_on_them() -> None:
    parameters = [Parameter("free", "", 0.0), Parameter("share", "", 0.5, lower=0.0, upper=1.0)]
    np.testing.assert_array_equal(within_bounds(parameters, np.array([-7.0, -1e-18])), [-7.0, 0.0])
    np.testing.assert_array_equal(within_bounds(parameters, np.array([7.0, 1.5])), [7.0, 1.0])
    np.testing.assert_array_equal(within_bounds(parameters, np.array([7.0, 0.3])), [7.0, 0.3])
