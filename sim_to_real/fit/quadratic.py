"""A fit's cost about its optimum as a quadratic of each frame: what any choice of frames would have found.

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
"""How many residuals say something of their own: neighbours share the model's error.

Of 50 recordings without any effect by another renderer the likeliest gains 6 nats more than it costs in one
and 3 at most in the others, about what the best of two dozen does by chance.
"""

LEAST_WEIGHT = 1e-3
"""The least weight of priors, where hardly anything is left."""

RIDGE = 1e-9
"""What is added to the information's diagonal, relative: directions that nothing sees stay where they are."""


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
        """By how much priors count more than beside residuals that are independent and of unit variance.

        As if `N_EFFECTIVE` of them were independent and their scale that which is left: where a model is
        still far off, what is known before keeps the parameters near.
        """
        n = float(self.counts.sum())
        return max(float(self.chi2.sum()) / min(n, N_EFFECTIVE), LEAST_WEIGHT)

    def solve(
        self,
        frames: Bool | None = None,
        damping: float = 0.0,
        fixed: slice = slice(0),
    ) -> Float64:
        """Return the parameters (p,) that frames and the priors like best.

        `frames` (n_frames,) are the chosen ones, all without them. `damping` adds so much of the
        information's diagonal (Levenberg and Marquardt). Those that are `fixed` stay as they are at x.
        """
        chosen = slice(None) if frames is None else frames
        A, b = self.information[chosen].sum(axis=0), self.gradient[chosen].sum(axis=0)
        prior = self.prior_weight / np.array([parameter.prior_sigma**2 for parameter in self.parameters])
        starts = np.array([parameter.start for parameter in self.parameters])
        A = A + np.diag(prior)
        b = b - prior * (self.x - starts)
        at = np.arange(len(b))[fixed]
        A[at], A[:, at], A[at, at], b[at] = 0.0, 0.0, 1.0, 0.0
        scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
        scaled = A / np.outer(scale, scale) + (RIDGE + damping) * np.eye(len(b))
        factor = np.linalg.cholesky(scaled)
        lower = np.array([parameter.lower for parameter in self.parameters]) - self.x
        upper = np.array([parameter.upper for parameter in self.parameters]) - self.x
        target = np.linalg.solve(factor, b / scale)
        free = np.linalg.solve(factor.T, target) / scale
        if (free >= lower).all() and (free <= upper).all():
            return within_bounds(self.parameters, self.x + free)
        # A bound that x lies on may be missed by rounding: the solver wants room.
        low = np.minimum(lower, 0.0) * scale
        high = np.maximum(np.maximum(upper, 0.0) * scale, low + 1e-12 * scale)
        found = lsq_linear(factor.T, target, (low, high), method="bvls")
        # What lies on a bound must not lie beyond it by rounding: effects refuse such values.
        return within_bounds(self.parameters, self.x + found.x / scale)

    def summed(self) -> Quadratic:
        """Return the same of all frames as if they were one."""
        return replace(
            self,
            information=self.information.sum(axis=0, keepdims=True),
            gradient=self.gradient.sum(axis=0, keepdims=True),
            chi2=self.chi2.sum(keepdims=True),
            counts=self.counts.sum(keepdims=True),
        )

    def only(self, kept: Int64) -> Quadratic:
        """Return the same along some of the parameters, the others staying where they are."""
        return replace(
            self,
            parameters=tuple(self.parameters[i] for i in kept),
            x=self.x[kept],
            information=self.information[:, kept[:, np.newaxis], kept],
            gradient=self.gradient[:, kept],
        )

    def about(self, x: Float64) -> Quadratic:
        """Return the same about other parameters (p,)."""
        return replace(
            self, x=x, gradient=self.gradient - self.information @ (x - self.x), chi2=self.costs(x)
        )

    def without_bounds(self, freed: Bool) -> Quadratic:
        """Return the same with no bounds for some of the parameters (p,)."""
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
