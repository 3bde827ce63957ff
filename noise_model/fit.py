"""Parameters with units, priors and bounds; robust least squares; what the data can and cannot tell.

One implementation for reflectance, arc, calibration and diagnosis. The estimate minimises

    sum_i rho(r_i^2) + sum_j ((x_j - mean_j) / prior_sigma_j)^2,

r_i whitened residuals, rho Huber's loss: the maximum a posteriori under independent Gaussian priors. The
covariance is the inverse of J^T W J + P at the solution, W the weights rho', P the priors' precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from noise_model.frames import Float64

NOT_LEARNED = 0.9
"""A parameter whose 1 sigma is more than this share of its prior's has not been learned from the data."""

ALIKE = 0.98
"""Two parameters with a larger correlation cannot be told apart."""


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
        if not self.lower <= self.start <= self.upper:
            raise ValueError(f"{self.name}: it starts at {self.start}, outside {self.lower} to {self.upper}")
        if not self.prior_sigma > 0:
            raise ValueError(f"{self.name}: a prior's sigma must be > 0")


@dataclass(frozen=True)
class Fit:
    """The result of a fit over parameters (p,) and residuals (n,).

    `values`, `sigmas` (p,), `covariance` (p, p); `chi2` of the data per degree of freedom (robust weights);
    `condition` of the information matrix scaled to a unit diagonal; `converged` by the optimiser's word.
    """

    parameters: tuple[Parameter, ...]
    values: Float64
    covariance: Float64
    chi2: float
    n_residuals: int
    condition: float
    converged: bool

    @property
    def sigmas(self) -> Float64:
        """The parameters' 1 sigma (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Float64:
        """The parameters' correlations (p, p)."""
        return np.asarray(self.covariance / np.outer(self.sigmas, self.sigmas))

    def value(self, name: str) -> float:
        """Return one parameter's value; KeyError if it was not fitted."""
        return float(self.values[self._index(name)])

    def sigma(self, name: str) -> float:
        """Return one parameter's 1 sigma; KeyError if it was not fitted."""
        return float(self.sigmas[self._index(name)])

    @property
    def at_bounds(self) -> tuple[str, ...]:
        """The parameters that lie on a bound (within a millionth of the distance between the bounds)."""
        on_bound = []
        for parameter, value in zip(self.parameters, self.values, strict=True):
            room = parameter.upper - parameter.lower
            margin = 1e-6 * room if math.isfinite(room) else 1e-9
            if value - parameter.lower < margin or parameter.upper - value < margin:
                on_bound.append(parameter.name)
        return tuple(on_bound)

    @property
    def not_learned(self) -> tuple[str, ...]:
        """The parameters about which the data say little beyond the prior."""
        return tuple(
            parameter.name
            for parameter, sigma in zip(self.parameters, self.sigmas, strict=True)
            if not sigma < NOT_LEARNED * parameter.prior_sigma
        )

    @property
    def alike(self) -> tuple[tuple[str, str], ...]:
        """The pairs of parameters that these data cannot tell apart."""
        correlation = np.abs(self.correlation)
        return tuple(
            (self.parameters[i].name, self.parameters[j].name)
            for i in range(len(self.parameters))
            for j in range(i + 1, len(self.parameters))
            if correlation[i, j] > ALIKE
        )

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
) -> Fit:
    """Fit parameters (p,) to whitened residuals (n,), a function of them.

    `huber` is the residual, in sigmas, beyond which it pulls no harder; inf is plain least squares. Raises
    ValueError if there are fewer residuals and priors than parameters or a residual is not finite at the
    start.
    """
    parameters = tuple(parameters)
    start = np.array([p.start for p in parameters])
    prior_sigma = np.array([p.prior_sigma for p in parameters])
    held = np.isfinite(prior_sigma)
    n_priors = int(held.sum())
    first = residuals(start)
    n = len(first)
    if n + n_priors < len(parameters):
        raise ValueError(f"{n} residuals and {n_priors} priors cannot determine {len(parameters)} parameters")
    if not np.isfinite(first).all():
        raise ValueError("a residual is not finite at the parameters' start")

    def with_priors(x: Float64) -> Float64:
        return np.concatenate([residuals(x), ((x - start) / prior_sigma)[held]])

    def jacobian(x: Float64) -> Float64:
        at = residuals(x)
        columns = []
        for i, parameter in enumerate(parameters):
            step = -parameter.step if x[i] + parameter.step > parameter.upper else parameter.step
            moved = x.copy()
            moved[i] += step
            columns.append((residuals(moved) - at) / step)
        return np.vstack([np.column_stack(columns), np.diag(1.0 / prior_sigma)[held]])

    def huber_loss(z: Float64) -> Float64:
        # SciPy asks for rho, rho', rho'' of squared residuals; the priors at the end stay quadratic.
        beyond = z > huber**2
        beyond[n:] = False
        root = np.sqrt(np.where(beyond, z, 1.0))
        value = np.where(beyond, 2.0 * huber * root - huber**2, z)
        slope = np.where(beyond, huber / root, 1.0)
        return np.stack([value, slope, np.where(beyond, -0.5 * slope / np.where(beyond, z, 1.0), 0.0)])

    solution = least_squares(
        with_priors,
        start,
        jac=jacobian,
        bounds=([p.lower for p in parameters], [p.upper for p in parameters]),
        x_scale="jac",
        loss="linear" if math.isinf(huber) else huber_loss,
        max_nfev=max_evaluations,
    )
    r, J = with_priors(solution.x), jacobian(solution.x)
    weight = np.ones(len(r))
    if math.isfinite(huber):
        weight[:n] = np.minimum(1.0, huber / np.maximum(np.abs(r[:n]), 1e-12))
    information = J.T @ (weight[:, None] * J)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    condition = float(np.linalg.cond(information / np.outer(scale, scale)))
    covariance = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
    freedom = max(n + n_priors - len(parameters), 1)
    chi2 = float(np.sum(weight * r**2) / freedom)
    return Fit(parameters, solution.x, covariance, chi2, n, condition, bool(solution.success))
