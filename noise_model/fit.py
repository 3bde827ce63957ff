"""Parameters with units, priors and bounds; robust least squares; what the data can and cannot tell.

One implementation for reflectance, arc, calibration and diagnosis. The estimate minimises

    sum_i rho(r_i^2) + sum_j ((x_j - start_j) / prior_sigma_j)^2,

r_i whitened residuals, rho Huber's loss: the maximum a posteriori under independent Gaussian priors. With
psi = rho' r, J = dr/dx and P the priors' precision, its covariance is that of an M-estimate (Huber 1981,
section 7.6), the priors' pulls counted as data:

    A = m_1 J^T J + P,   B = m_2 J^T J + P,   covariance = A^-1 B A^-1,   m_1 = <psi'>,   m_2 = <psi^2>.

Without Huber's bound m_1 = m_2 = 1 and this is the inverse of J^T J + P: it trusts the whitening. With it,
the share of residuals beyond the bound is the one found, or a Gaussian's if that is larger; those within are
taken to be as large as the whitening says.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit

from noise_model.compiled.arrays import Bool, Float64

SINGULAR = 1e-10
"""An eigenvalue of the information, scaled to a unit diagonal, below which the data do not see a direction.

It stands above what numerical derivatives leave of a zero; the sigma there would be 1e5 times as large as
with the other parameters known.
"""


@dataclass(frozen=True)
class Parameter:
    """A quantity to be fitted: its start (the prior's mean), the prior's 1 sigma (inf for none) and bounds.

    `step` is the size of the change that the numerical derivative takes, in the parameter's unit.
    """

    name: str
    unit: str
    start: float
    prior_sigma: float = math.inf
    lower: float = -math.inf
    upper: float = math.inf
    step: float = 1e-4

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"{self.name}: its bounds {self.lower} and {self.upper} leave no room")
        if not (math.isfinite(self.start) and self.lower <= self.start <= self.upper):
            raise ValueError(f"{self.name}: it starts at {self.start}, outside {self.lower} to {self.upper}")
        if not self.prior_sigma > 0:
            raise ValueError(f"{self.name}: a prior's sigma must be > 0")
        if not 0 < self.step <= 0.5 * (self.upper - self.lower) or math.isinf(self.step):
            raise ValueError(f"{self.name}: a step of {self.step} does not fit between its bounds")


def within_bounds(parameters: Sequence[Parameter], x: Float64) -> Float64:
    """Return values (p,) of parameters, those outside their bounds put on them."""
    lower, upper = zip(*((p.lower, p.upper) for p in parameters), strict=True)
    return np.clip(x, lower, upper)


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit of parameters (p,) to residuals (n,).

    `values` (p,); `covariance` (p, p), inf and NaN where the data and priors do not determine a parameter;
    `chi2` of the data per degree of freedom, 1 if the whitening is right (Huber's proposal 2 if robust);
    `freedom` = n less the number of parameters that were learned: a parameter held by its prior costs none.
    `condition` is that of the information scaled to a unit diagonal, `converged` the optimiser's word.
    `undetermined` names the parameters in a combination that neither data nor priors see.
    `residuals` (n,) are those at the values, `leverage` (n,) the share, 0 to 1, of each that the fit takes
    up: r / sqrt(1 - leverage) has unit variance. `t_freedom` is Student's, inf as long as the whitening is
    trusted.
    """

    parameters: tuple[Parameter, ...]
    values: Float64
    covariance: Float64
    chi2: float
    freedom: float
    residuals: Float64
    leverage: Float64
    condition: float
    converged: bool
    undetermined: tuple[str, ...]
    t_freedom: float = math.inf

    @property
    def n_residuals(self) -> int:
        """The number of residuals n, priors not counted."""
        return len(self.residuals)

    @property
    def sigmas(self) -> Float64:
        """The parameters' 1 sigma (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Float64:
        """The parameters' correlations (p, p)."""
        return correlation(self.covariance)

    def value(self, name: str) -> float:
        """Return one parameter's value; KeyError if it was not fitted."""
        return float(self.values[self._index(name)])

    def sigma(self, name: str) -> float:
        """Return one parameter's 1 sigma; KeyError if it was not fitted."""
        return float(self.sigmas[self._index(name)])

    def interval(self, name: str, confidence: float = 0.95) -> tuple[float, float]:
        """Return the interval that holds a parameter with this confidence, cut at its bounds.

        value -+ t sigma, t the quantile of Student's distribution with `t_freedom` degrees of freedom.
        """
        parameter = self.parameters[self._index(name)]
        half = student_t(confidence, self.t_freedom) * self.sigma(name)
        value = self.value(name)
        return max(value - half, parameter.lower), min(value + half, parameter.upper)

    @property
    def at_bounds(self) -> tuple[str, ...]:
        """The parameters that lie on a bound (within a step): their sigma says nothing of the far side."""
        return tuple(
            parameter.name
            for parameter, value in zip(self.parameters, self.values, strict=True)
            if min(value - parameter.lower, parameter.upper - value) <= parameter.step
        )

    @property
    def not_learned(self) -> tuple[str, ...]:
        """The parameters about which the data say little beyond the prior."""
        # A parameter whose 1 sigma is more than this share of its prior's has not been learned from the data.
        return tuple(
            parameter.name
            for parameter, sigma in zip(self.parameters, self.sigmas, strict=True)
            if not sigma < 0.9 * parameter.prior_sigma
        )

    def scaled_by_scatter(self) -> Fit:
        """Return the fit with the size of the noise taken from the residuals, not from their whitening.

        The covariance times chi2, Student's t instead of the normal distribution. ValueError with priors,
        which would be scaled too, or without a degree of freedom.
        """
        if any(math.isfinite(parameter.prior_sigma) for parameter in self.parameters):
            raise ValueError("a fit with priors cannot be scaled by its scatter")
        if not self.freedom > 0.5:
            raise ValueError(f"{self.n_residuals} residuals leave no degree of freedom for their scatter")
        return replace(self, covariance=self.covariance * self.chi2, t_freedom=self.freedom)

    def _index(self, name: str) -> int:
        for i, parameter in enumerate(self.parameters):
            if parameter.name == name:
                return i
        raise KeyError(name)


def fit(
    parameters: Sequence[Parameter],
    residuals: Callable[[Float64], Float64],
    huber: float = math.inf,
    max_evaluations: int = 60,
    start: Float64 | None = None,
    derivatives: Callable[[Float64], Float64] | None = None,
    min_gain_rel: float = 1e-8,
) -> Fit:
    """Fit parameters (p,) to whitened residuals (n,), a function of them.

    `huber` is the residual, in sigmas, beyond which it pulls no harder; inf is plain least squares. `start`
    (p,) begins the search elsewhere than at the priors' means. `derivatives` gives those of the residuals
    (n, p); without it they are numerical. A step that lowers the squares by less than `min_gain_rel` is the
    last. Raises ValueError if there are fewer residuals and priors than parameters, if a residual or a
    derivative is not finite, and for huber <= 0.
    """
    problem = _FitProblem(tuple(parameters), residuals, huber, derivatives)
    x_start = problem.means if start is None else np.asarray(start, dtype=np.float64)
    n = problem.check(x_start)
    solution = least_squares(
        problem.residuals_and_pulls,
        x_start,
        jac=problem.jacobian,
        bounds=([p.lower for p in problem.parameters], [p.upper for p in problem.parameters]),
        x_scale="jac",
        loss="linear" if math.isinf(huber) else problem.loss(n),
        ftol=min_gain_rel,
        max_nfev=max_evaluations,
    )
    return _assess(problem, solution.x, n, bool(solution.success))


def correlation(covariance: Float64) -> Float64:
    """Return the correlations (p, p) of a covariance (p, p); NaN where a variance is 0 or inf."""
    sigmas = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(covariance / np.outer(sigmas, sigmas))


def student_t(confidence: float, freedom: float) -> float:
    """Return the half width, in sigmas, of the central interval of a confidence; freedom inf is normal."""
    return float(stdtrit(min(freedom, 1e9), 0.5 + 0.5 * confidence))


@dataclass(frozen=True)
class _FitProblem:
    parameters: tuple[Parameter, ...]
    residuals: Callable[[Float64], Float64]
    huber: float
    derivatives: Callable[[Float64], Float64] | None

    @property
    def means(self) -> Float64:
        return np.array([p.start for p in self.parameters])

    @property
    def precision(self) -> Float64:
        """The priors' 1 / sigma (p,), 0 for none."""
        return np.array([1.0 / p.prior_sigma for p in self.parameters])

    def check(self, x: Float64) -> int:
        """Return the number of residuals n; ValueError if the problem cannot be posed."""
        if not self.huber > 0:
            raise ValueError(f"huber = {self.huber}: the bound must be > 0 sigma")
        first = self.residuals(x)
        n, p, n_priors = len(first), len(self.parameters), int((self.precision > 0).sum())
        if n + n_priors < p:
            raise ValueError(f"{n} residuals and {n_priors} priors cannot determine {p} parameters")
        if not np.isfinite(first).all():
            raise ValueError("a residual is not finite where the fit starts")
        return n

    def residuals_and_pulls(self, x: Float64) -> Float64:
        """Return the residuals (n,) and behind them the priors' pulls (p,), 0 for none."""
        return np.concatenate([self.residuals(x), (x - self.means) * self.precision])

    def jacobian(self, x: Float64) -> Float64:
        """Return the derivatives (n + p, p) of both."""
        of_residuals = self._differences(x) if self.derivatives is None else self.derivatives(x)
        return np.vstack([of_residuals, np.diag(self.precision)])

    def _differences(self, x: Float64) -> Float64:
        """Return the residuals' derivatives (n, p) by forward differences, backward at an upper bound."""
        unmoved = self.residuals(x)
        columns = []
        for i, parameter in enumerate(self.parameters):
            step = -parameter.step if x[i] + parameter.step > parameter.upper else parameter.step
            moved = x.copy()
            moved[i] += step
            columns.append((self.residuals(moved) - unmoved) / (moved[i] - x[i]))
            if not np.isfinite(columns[-1]).all():
                raise ValueError(f"{parameter.name}: a residual's derivative is not finite at {x[i]:g}")
        return np.column_stack(columns)

    def loss(self, n: int) -> Callable[[Float64], Float64]:
        """Return Huber's rho, rho', rho'' (3, n + p) of squared residuals; the priors stay quadratic."""

        def rho(z: Float64) -> Float64:
            beyond = z > self.huber**2
            beyond[n:] = False
            z_beyond = np.where(beyond, z, 1.0)
            slope = np.where(beyond, self.huber / np.sqrt(z_beyond), 1.0)
            value = np.where(beyond, 2.0 * self.huber * np.sqrt(z_beyond) - self.huber**2, z)
            return np.stack([value, slope, np.where(beyond, -0.5 * slope / z_beyond, 0.0)])

        return rho


def _assess(problem: _FitProblem, x: Float64, n: int, converged: bool) -> Fit:
    r = problem.residuals_and_pulls(x)[:n]
    J = problem.jacobian(x)[:n]
    psi = np.clip(r, -problem.huber, problem.huber)
    share_within, square_within = _gaussian_moments(problem.huber)
    expected_psi2 = _psi2(problem.huber, share_within, square_within)
    m_1 = min(share_within, float(np.mean(np.abs(r) <= problem.huber)) if n else 1.0)
    m_2 = _psi2(problem.huber, m_1, square_within)

    P = np.diag(problem.precision**2)
    information = J.T @ J
    scale = np.sqrt(np.diag(m_1 * information + P))
    scale[scale == 0.0] = 1.0
    eigenvalues, vectors = np.linalg.eigh((m_1 * information + P) / np.outer(scale, scale))
    unseen = eigenvalues < SINGULAR
    in_unseen = np.sum(vectors[:, unseen] ** 2, axis=1) > 1e-6
    inverse = (vectors / np.maximum(eigenvalues, SINGULAR)) @ vectors.T / np.outer(scale, scale)
    covariance = inverse @ (m_2 * information + P) @ inverse
    names = [p.name for p in problem.parameters]
    leverage = m_1 * np.einsum("ij,jk,ik->i", J, inverse, J)
    freedom = n - float(leverage.sum())
    return Fit(
        parameters=problem.parameters,
        values=x,
        covariance=_unknown(covariance, in_unseen),
        chi2=float(np.sum(psi**2) / (expected_psi2 * freedom)) if freedom > 0.5 else math.nan,
        freedom=freedom,
        residuals=r,
        leverage=leverage,
        condition=float(eigenvalues[-1] / eigenvalues[0]) if eigenvalues[0] > 0 else math.inf,
        converged=converged,
        undetermined=tuple(name for name, is_in in zip(names, in_unseen, strict=True) if is_in),
    )


def _gaussian_moments(bound: float) -> tuple[float, float]:
    """Return the share of a standard normal z within the bound and the mean z^2 of that share."""
    if math.isinf(bound):
        return 1.0, 1.0
    share = math.erf(bound / math.sqrt(2.0))
    return share, 1.0 - 2.0 * bound * math.exp(-0.5 * bound**2) / math.sqrt(2.0 * math.pi) / share


def _psi2(bound: float, share_within: float, square_within: float) -> float:
    """Return <psi^2>: z^2 within the bound, the bound's square beyond."""
    return share_within * square_within + (1.0 - share_within) * (bound**2 if share_within < 1.0 else 0.0)


def _unknown(covariance: Float64, parameters: Bool) -> Float64:
    covariance = covariance.copy()
    covariance[parameters, :] = math.nan
    covariance[:, parameters] = math.nan
    covariance[parameters, parameters] = math.inf
    return covariance
