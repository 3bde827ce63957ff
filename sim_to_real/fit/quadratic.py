"""Quadratic model of a fit's cost about its optimum, which is minimised without new predictions.

With r the whitened residuals, J their derivatives and W their weights, all at x_0, the cost at x is

    c - 2 b d + d A d,   A = J^T W J,   b = -J^T W r,   c = r^T W r,   d = x - x_0,

and its sum with the priors' is minimised within the bounds.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from noise_model.compiled.arrays import Float64
from noise_model.fit import Parameter, within_bounds


@dataclass(frozen=True, eq=False)
class Quadratic:
    """The cost of parameters (p,) about `x`: information (p, p), gradient (p,) and chi2 of the residuals.

    The priors' cost counts `prior_weight` times.
    """

    parameters: tuple[Parameter, ...]
    x: Float64
    information: Float64
    gradient: Float64
    chi2: float
    prior_weight: float = 1.0

    @property
    def prior_starts(self) -> Float64:
        """The means (p,) of the parameters' priors."""
        return np.array([parameter.start for parameter in self.parameters])

    @property
    def prior_sigmas(self) -> Float64:
        """1 sigma (p,) of the parameters' priors."""
        return np.array([parameter.prior_sigma for parameter in self.parameters])

    def prior_cost(self, x: Float64) -> float:
        """Return the priors' cost at parameters (p,)."""
        return self.prior_weight * float(np.sum(((x - self.prior_starts) / self.prior_sigmas) ** 2))

    def total(self, x: Float64) -> float:
        """Return the residuals' cost and the priors' at parameters (p,)."""
        return self.cost(x) + self.prior_cost(x)

    def solve(self, damping: float = 0.0) -> Float64:
        """Return the parameters (p,) of least cost, the priors' included, within their bounds.

        `damping` is relative to the information's diagonal (Levenberg and Marquardt).
        """
        prior = self.prior_weight / self.prior_sigmas**2
        A = self.information + np.diag(prior)
        b = self.gradient - prior * (self.x - self.prior_starts)
        scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
        # The ridge keeps parameters in place that no residual constrains.
        scaled = A / np.outer(scale, scale) + (1e-9 + damping) * np.eye(len(b))
        factor = np.linalg.cholesky(scaled)
        lower = np.array([parameter.lower for parameter in self.parameters]) - self.x
        upper = np.array([parameter.upper for parameter in self.parameters]) - self.x
        target = np.linalg.solve(factor, b / scale)
        unbounded = np.linalg.solve(factor.T, target) / scale
        if (unbounded >= lower).all() and (unbounded <= upper).all():
            return within_bounds(self.parameters, self.x + unbounded)
        # Rounding may put x just beyond a bound that it lies on: the solver needs room.
        low = np.minimum(lower, 0.0) * scale
        high = np.maximum(np.maximum(upper, 0.0) * scale, low + 1e-12 * scale)
        solution = lsq_linear(factor.T, target, (low, high), method="bvls")
        # Rounding must not put a result beyond its bound: effects refuse such values.
        return within_bounds(self.parameters, self.x + solution.x / scale)

    def cost(self, x: Float64) -> float:
        """Return the residuals' sum of squares at parameters (p,)."""
        d = x - self.x
        return float(self.chi2 - 2.0 * self.gradient @ d + d @ self.information @ d)
