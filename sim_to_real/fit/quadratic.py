"""A fit's cost about its optimum as a quadratic for each frame, so that any choice of frames can be fitted.

With r the whitened residuals, J their derivatives and w Huber's weights, all at x_0, a frame's cost at x is

    c - 2 b d + d A d,   A = J^T w J,   b = -J^T w r,   c = r^T w r,   d = x - x_0,

and a sum over frames, with the priors', is minimised within the bounds without predicting anything anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from noise_model.arrays import Bool, Float64, Int64
from noise_model.fit import Parameter, within_bounds

N_EFFECTIVE = 200.0
"""The effective number of independent residuals: neighbours share the model's error.

Of 50 recordings without any effect by another renderer the likeliest gains 6 nats more than it costs in one
and 3 at most in the others, about what the best of two dozen does by chance.
"""

MIN_PRIOR_WEIGHT = 1e-3
"""The smallest weight of priors, where residuals are tiny."""

RIDGE_REL = 1e-9
"""Relative ridge on the information's diagonal: directions that no residual constrains stay put."""


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Costs (n_frames,) of parameters (p,) about `x`: information (f, p, p), gradient (f, p), chi2 (f,).

    `counts` (f,) are the frames' numbers of residuals.
    """

    parameters: tuple[Parameter, ...]
    x: Float64
    information: Float64
    gradient: Float64
    chi2: Float64
    counts: Int64

    @classmethod
    def of(
        cls,
        parameters: Sequence[Parameter],
        x: Float64,
        residuals: Float64,
        jacobian: Float64,
        weights: Float64,
        counts: Int64,
    ) -> Quadratic:
        """Sum residuals (n,), their derivatives (n, p) and weights (n,) frame by frame."""
        p, ends = len(x), np.cumsum(counts)
        information = np.empty((len(counts), p, p))
        gradient, chi2 = np.empty((len(counts), p)), np.empty(len(counts))
        for f, (start, end) in enumerate(zip(ends - counts, ends, strict=True)):
            r, J, w = residuals[start:end], jacobian[start:end], weights[start:end]
            wJ = w[:, np.newaxis] * J
            information[f], gradient[f], chi2[f] = J.T @ wJ, -(wJ.T @ r), float(r @ (w * r))
        return cls(tuple(parameters), x, information, gradient, chi2, counts)

    @property
    def prior_weight(self) -> float:
        """The weight of the priors' cost, relative to independent residuals of unit variance.

        Only `N_EFFECTIVE` residuals count as independent, and their variance is that which is left. So where
        a model is still far off, the priors keep its parameters near.
        """
        n = float(self.counts.sum())
        return max(float(self.chi2.sum()) / min(n, N_EFFECTIVE), MIN_PRIOR_WEIGHT)

    def solve(
        self,
        frames: Bool | None = None,
        damping: float = 0.0,
        fixed: slice = slice(0),
    ) -> Float64:
        """Return the parameters (p,) of least cost, the priors' included, within their bounds.

        `frames` (n_frames,) are the chosen ones; without them all count. `damping` is relative to the
        information's diagonal (Levenberg and Marquardt). Parameters that are `fixed` stay as they are at x.
        """
        chosen = slice(None) if frames is None else frames
        A, b = self.information[chosen].sum(axis=0), self.gradient[chosen].sum(axis=0)
        prior = self.prior_weight / np.array([parameter.prior_sigma**2 for parameter in self.parameters])
        starts = np.array([parameter.start for parameter in self.parameters])
        A = A + np.diag(prior)
        b = b - prior * (self.x - starts)
        places = np.arange(len(b))[fixed]
        A[places], A[:, places], A[places, places], b[places] = 0.0, 0.0, 1.0, 0.0
        scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
        scaled = A / np.outer(scale, scale) + (RIDGE_REL + damping) * np.eye(len(b))
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

    def summed(self) -> Quadratic:
        """Return the sum over all frames, as one frame."""
        return replace(
            self,
            information=self.information.sum(axis=0, keepdims=True),
            gradient=self.gradient.sum(axis=0, keepdims=True),
            chi2=self.chi2.sum(keepdims=True),
            counts=self.counts.sum(keepdims=True),
        )

    def restricted_to(self, kept: Int64) -> Quadratic:
        """Return the cost along some of the parameters; the others stay at x."""
        return replace(
            self,
            parameters=tuple(self.parameters[i] for i in kept),
            x=self.x[kept],
            information=self.information[:, kept[:, np.newaxis], kept],
            gradient=self.gradient[:, kept],
        )

    def expanded_at(self, x: Float64) -> Quadratic:
        """Return the same quadratic expanded about other parameters (p,)."""
        return replace(
            self, x=x, gradient=self.gradient - self.information @ (x - self.x), chi2=self.costs(x)
        )

    def without_bounds(self, freed: Bool) -> Quadratic:
        """Return the same cost without bounds for some of the parameters (p,)."""
        free = [
            replace(parameter, lower=-np.inf, upper=np.inf) if is_free else parameter
            for parameter, is_free in zip(self.parameters, freed, strict=True)
        ]
        return replace(self, parameters=tuple(free))

    def mean_square(self, x: Float64) -> float:
        """Return the weighted mean square of all residuals at parameters (p,)."""
        return float(self.costs(x).sum() / self.counts.sum())

    def costs(self, x: Float64) -> Float64:
        """Return each frame's weighted sum of squares (n_frames,) at parameters (p,)."""
        d = x - self.x
        return np.asarray(
            self.chi2 - 2.0 * self.gradient @ d + np.einsum("i,fij,j->f", d, self.information, d)
        )
