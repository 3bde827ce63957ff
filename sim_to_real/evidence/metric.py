"""The log evidence of linear hypotheses, in closed form.

With whitened residuals r of a hypothesis at its prior's mean, columns A that one prior sigma of each of its
parameters adds, the model's own error in columns F, and robust weights W, all sizes are standard normal, so

    ln Z = ln N(r; 0, C + A A^T),   C = W^-1 + F F^T.

By Woodbury and Sylvester only products with C^-1 = W - W F (I + F^T W F)^-1 F^T W are needed: of a few
columns with each other. What all hypotheses share, ln |C|, is left out. About the fit of a hypothesis that is
not linear this is Laplace's approximation (MacKay 1992, Neural Computation 4, 415).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dtrtrs
from scipy.optimize import nnls
from scipy.special import erfcx, log_ndtr

from noise_model.compiled.arrays import Float32, Float64
from noise_model.fit import Parameter
from sim_to_real.fit.quadratic import Quadratic


@dataclass(frozen=True, eq=False)
class WeightedColumns:
    """Columns (n, k) as a metric sees them: times the roots of its weights, and `projected` (m, k)."""

    weighted: Float64
    projected: Float64

    def products(self, others: "WeightedColumns") -> Float64:
        """Return the products (k, j) with others (n, j) in the metric."""
        # Of one array with itself BLAS computes half of the products.
        return np.asarray(self.weighted.T @ others.weighted - self.projected.T @ others.projected)


@dataclass(frozen=True, eq=False)
class Metric:
    """The product a^T C^-1 b of columns (n, k).

    `root_weights` (n,) are the roots of robust weights, `projector` (m, n) is L^-1 F^T W^1/2 with
    L L^T = I + F^T W F.
    """

    root_weights: Float64
    projector: Float64

    @classmethod
    def of(cls, floor: Float32, weights: Float32) -> "Metric":
        """Return the metric of the model's own error in columns (n, m) and of weights (n,)."""
        root_weights = np.sqrt(weights.astype(np.float64))
        weighted = compress(floor) * root_weights[:, np.newaxis]
        information = weighted.T @ weighted
        information[np.diag_indices_from(information)] += 1.0
        root = np.linalg.cholesky(information)
        return cls(root_weights, solve_triangular(root, weighted.T, lower=True))

    def weigh(self, columns: Float64 | Float32) -> WeightedColumns:
        """Return columns (n, k) as the metric sees them, to be multiplied with any others."""
        weighted = columns * self.root_weights[:, np.newaxis]
        return WeightedColumns(weighted, self.projector @ weighted)

    def products(self, columns: Float64 | Float32, others: Float64 | Float32) -> Float64:
        """Return the products (k, j) of columns (n, k) with others (n, j)."""
        seen = self.weigh(columns)
        return seen.products(seen if others is columns else self.weigh(others))

    def log_evidence(
        self, residuals: Float64 | Float32, columns: Float64 | Float32, sides: Float64 | None = None
    ) -> float:
        """Return ln Z, nats, of residuals (n,) and columns (n, k), but for what all hypotheses share.

        `sides` (k,) are those of `log_evidence`; without them no size is bounded.
        """
        both: Float64 = np.column_stack([columns, residuals]).astype(np.float64)
        some = np.zeros(columns.shape[1]) if sides is None else sides
        return log_evidence(self.products(both, both), some, len(residuals))


@dataclass(frozen=True, eq=False)
class MetricLoss:
    """The cost of a fit's residuals in a metric."""

    metric: Metric

    def about(self, r: Float64) -> "MetricLoss":
        """Return the loss for a step from any residuals: it is always the same."""
        return self

    def cost(self, r: Float64) -> float:
        """Return the cost of residuals (n,): twice the nats that they take."""
        return float(self.metric.products(r[:, np.newaxis], r[:, np.newaxis])[0, 0])

    def quadratic(self, parameters: Sequence[Parameter], x: Float64, r: Float64, J: Float64) -> Quadratic:
        """Return the cost about parameters x (p,) with residuals r (n,) and their derivatives J (n, p)."""
        both = np.column_stack([J, r])
        products = self.metric.products(both, both)
        return Quadratic(tuple(parameters), x, products[:-1, :-1], -products[:-1, -1], products[-1, -1])

    def is_converged(self, cost: float, gained: float) -> bool:
        """Return True if a step of this gain ends a fit of this cost."""
        # Half a nat: the cost is twice the nats.
        return gained < 1.0


def log_evidence(products: Float64, sides: Float64, count: int) -> float:
    """Return ln Z, nats, from the products (k + 1, k + 1) of columns and, last, of `count` residuals.

    `sides` (k,) are 1 for sizes that only positive values have, -1 for negative ones, 0 for both. A bounded
    size has a half-normal prior.

    All errors may be larger than stated by one factor, which follows from the remaining cost where that
    exceeds the errors. So two hypotheses that leave much are compared by the ratio of what they leave, as for
    errors of unknown size.
    """
    return rescale_errors(products, sides, count)[0]


def rescale_errors(products: Float64, sides: Float64, count: int) -> tuple[float, float, float]:
    """Return ln Z as `log_evidence` does, the errors' variance there over the stated one, and the cost there.

    The cost is that of the stated errors.
    """
    # Bounded sizes come last: what the others leave of them is a block of the factor.
    order = np.argsort(sides != 0.0, kind="stable")
    sides, ordered = sides[order], np.append(order, len(order))
    products = products[np.ix_(ordered, ordered)]
    variance, nats = 1.0, -math.inf
    for _ in range(6):
        at_variance, cost = _at_variance(products, sides, variance)
        nats = max(nats, at_variance - 0.5 * count * math.log(variance))
        before, variance = variance, max(1.0, cost / max(count, 1))
        if abs(math.log(variance / before)) < 0.01:
            break
    return nats, variance, cost


def _at_variance(products: Float64, sides: Float64, variance: float) -> tuple[float, float]:
    """Return ln Z, nats, with all errors' variance scaled by `variance`, and the residuals' cost there.

    Bounded sizes come last. The cost is that of the stated errors, at the likeliest sizes x within their
    bounds: with R R^T the information, R^T x comes nearest to -R^-1 times what residuals are along the
    columns, and its last rows hold bounded sizes alone (Lawson and Hanson 1974, ch. 23). Along a size at its
    bound the exponent is -g x - h x^2 / 2, with h the information that the free sizes leave of it. With its
    prior it adds ln erfcx(g / sqrt(2 h)) - ln(h) / 2. A bounded size off its bound, of sigma s, adds
    ln 2 Phi(x / s).
    """
    information = products[:-1, :-1] / variance + np.eye(len(products) - 1)
    along = products[:-1, -1] / variance
    root = np.asarray(np.linalg.cholesky(information), dtype=np.float64)
    target = -_solve_lower(root, along)
    sizes = _solve_lower(root, target, is_transposed=True)
    is_bounded = sides != 0.0
    at_bound = is_bounded & (sides * sizes < 0.0)
    if at_bound.any():
        free, last = np.s_[: np.count_nonzero(~is_bounded)], np.s_[np.count_nonzero(~is_bounded) :]
        bounded = sides[last] * nnls(root[last, last].T * sides[last], target[last])[0]
        rest = target[free] - root[last, free].T @ bounded
        sizes = np.append(_solve_lower(root[free, free], rest, is_transposed=True), bounded)
        # A size this near its bound, in sigmas of its prior, is at it.
        at_bound = is_bounded & (np.abs(sizes) < 1e-9)
        sizes = np.where(at_bound, 0.0, sizes)
        free_information = information[np.ix_(~at_bound, ~at_bound)]
        root = np.asarray(np.linalg.cholesky(free_information), dtype=np.float64)
    gained = sizes @ along + 0.5 * sizes @ information @ sizes
    nats = -0.5 * products[-1, -1] / variance - gained - np.log(np.diag(root)).sum()
    off_bound = is_bounded[~at_bound]
    if off_bound.any():
        inverse = _solve_lower(root, np.eye(len(root))[:, off_bound])
        sigma = np.sqrt(np.sum(inverse**2, axis=0))
        off = is_bounded & ~at_bound
        nats += np.sum(np.log(2.0) + log_ndtr(sides[off] * sizes[off] / sigma))
    if at_bound.any():
        gradient = (sides * (information @ sizes + along))[at_bound]
        taken = _solve_lower(root, information[np.ix_(~at_bound, at_bound)])
        remaining = np.diag(information)[at_bound] - np.sum(taken**2, axis=0)
        nats += np.sum(np.log(erfcx(gradient / np.sqrt(2.0 * remaining))) - 0.5 * np.log(remaining))
    cost = products[-1, -1] + 2.0 * sizes @ products[:-1, -1] + sizes @ products[:-1, :-1] @ sizes
    return float(nats), float(cost)


def _solve_lower(root: Float64, known: Float64, is_transposed: bool = False) -> Float64:
    """Return x (n, ...) of L x = known, or of L^T x = known, for a lower triangular L (n, n) without a zero.

    It is LAPACK's own: of systems this small the checks of `solve_triangular` take most of the time.
    """
    if not len(root):
        return known
    # LAPACK counts by columns, and takes L for an upper triangular L^T.
    return np.asarray(dtrtrs(root.T, known, lower=0, trans=0 if is_transposed else 1)[0])


def compress(columns: Float32) -> Float32:
    """Return fewer columns F' (n, m) with F' F'^T that of columns (n, k), but for what noise hides."""
    if not columns.shape[1]:
        return columns
    values, vectors = np.linalg.eigh((columns.T @ columns).astype(np.float64))
    # Noise hides directions with less than 5 % of its variance.
    return np.asarray(columns @ vectors[:, values > 0.05].astype(np.float32))


def robust_weights(residuals: Float64 | Float32, columns: Float32, dof: float) -> Float32:
    """Return the weights (n,) of residuals about what columns (n, k) explain, for Student's distribution.

    Iterated least squares (Lange, Little and Taylor 1989, J. Am. Stat. Assoc. 84, 881), 1 at most.
    """
    r = residuals.astype(np.float32)
    weights = np.ones(len(r), dtype=np.float32)
    for _ in range(4):
        roots = np.sqrt(weights)
        weighted = columns * roots[:, np.newaxis]
        # Of one array with itself BLAS computes half of the products.
        information = (weighted.T @ weighted).astype(np.float64)
        # Float products of large columns leave errors of a millionth: a ridge of it keeps the system regular.
        information[np.diag_indices_from(information)] *= 1.0 + 1e-5
        information[np.diag_indices_from(information)] += 1.0
        sizes = np.linalg.solve(information, (weighted.T @ (roots * r)).astype(np.float64))
        rest = r - columns @ sizes.astype(np.float32)
        weights = np.minimum((dof + 1.0) / (dof + rest**2), 1.0).astype(np.float32)
    return weights
