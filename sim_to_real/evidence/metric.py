"""The log evidence of linear hypotheses, in closed form.

With whitened residuals r of a hypothesis at its prior's mean, columns A that one prior sigma of each of its
parameters adds, the model's own error in columns F, and robust weights W, all sizes are standard normal, so

    ln Z = ln N(r; 0, C + A A^T),   C = W^-1 + F F^T.

By Woodbury and Sylvester only products with C^-1 = W - W F (I + F^T W F)^-1 F^T W are needed: of a few
columns with each other. What all hypotheses share, ln |C|, is left out. About the fit of a hypothesis that is
not linear this is Laplace's approximation (MacKay 1992, Neural Computation 4, 415).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr

from noise_model.arrays import Float32, Float64

MIN_EIGENVALUE = 0.05
"""Directions of the model's own error with a smaller variance than this, over noise, are left out."""


@dataclass(frozen=True, eq=False)
class Metric:
    """The product a^T C^-1 b of columns (n, k).

    `weights` (n,) are robust ones, `projected` (m, n) is L^-1 F^T W with L L^T = I + F^T W F.
    """

    weights: Float32
    projected: Float64

    @classmethod
    def of(cls, floor: Float32, weights: Float32) -> Metric:
        """Return the metric of the model's own error in columns (n, m) and of weights (n,)."""
        compact = compressed(floor).astype(np.float64)
        weighted = compact * weights[:, np.newaxis]
        information = weighted.T @ compact
        information[np.diag_indices_from(information)] += 1.0
        root = np.linalg.cholesky(information)
        projected = solve_triangular(root, weighted.T, lower=True)
        return cls(weights, projected)

    def products(self, columns: Float64 | Float32, others: Float64 | Float32) -> Float64:
        """Return the products (k, j) of columns (n, k) with others (n, j)."""
        a, b = np.asarray(columns, dtype=np.float64), np.asarray(others, dtype=np.float64)
        return (a * self.weights[:, np.newaxis]).T @ b - (self.projected @ a).T @ (self.projected @ b)

    def log_evidence(
        self, residuals: Float64 | Float32, columns: Float64 | Float32, sides: Float64 | None = None
    ) -> float:
        """Return ln Z, nats, of residuals (n,) and columns (n, k), but for what all hypotheses share.

        `sides` (k,) are those of `log_evidence`; without them no size is bounded.
        """
        both: Float64 = np.column_stack([columns, residuals]).astype(np.float64)
        return log_evidence(self.products(both, both), np.zeros(columns.shape[1]) if sides is None else sides)


def log_evidence(products: Float64, sides: Float64) -> float:
    """Return ln Z, nats, from the products (k + 1, k + 1) of columns and, last, of the residuals.

    `sides` (k,) are 1 for sizes that only positive values have, -1 for negative ones, 0 for both. A bounded
    size has a half-normal prior: with m and s its mean and sigma without the bound, Z is 2 Phi(m / s) times
    as large. Of several bounded sizes each is taken by itself.
    """
    information, along = products[:-1, :-1] + np.eye(len(products) - 1), products[:-1, -1]
    root = np.linalg.cholesky(information)
    explained = solve_triangular(root, along, lower=True)
    unbounded = -0.5 * (products[-1, -1] - explained @ explained) - np.log(np.diag(root)).sum()
    places = np.flatnonzero(sides)
    if not len(places):
        return float(unbounded)
    inverse = solve_triangular(root, np.eye(len(root))[:, places], lower=True)
    mean, sigma = -inverse.T @ explained, np.sqrt(np.sum(inverse**2, axis=0))
    return float(unbounded + np.sum(np.log(2.0) + log_ndtr(sides[places] * mean / sigma)))


def compressed(columns: Float32) -> Float32:
    """Return fewer columns F' (n, m) with F' F'^T that of columns (n, k), but for what noise hides."""
    if not columns.shape[1]:
        return columns
    values, vectors = np.linalg.eigh((columns.T @ columns).astype(np.float64))
    return np.asarray(columns @ vectors[:, values > MIN_EIGENVALUE].astype(np.float32))


def robust_weights(residuals: Float64 | Float32, columns: Float32, dof: float, rounds: int = 4) -> Float32:
    """Return the weights (n,) of residuals about what columns (n, k) explain, for Student's distribution.

    Iterated least squares (Lange, Little and Taylor 1989, J. Am. Stat. Assoc. 84, 881), 1 at most.
    """
    r = residuals.astype(np.float32)
    weights = np.ones(len(r), dtype=np.float32)
    for _ in range(rounds):
        weighted = columns * weights[:, np.newaxis]
        information = (weighted.T @ columns).astype(np.float64)
        # Float products of large columns leave errors of a millionth: a ridge of it keeps the system regular.
        information[np.diag_indices_from(information)] *= 1.0 + 1e-5
        information[np.diag_indices_from(information)] += 1.0
        sizes = np.linalg.solve(information, (weighted.T @ r).astype(np.float64))
        rest = r - columns @ sizes.astype(np.float32)
        weights = np.minimum((dof + 1.0) / (dof + rest**2), 1.0).astype(np.float32)
    return weights
