"""The evidence of a hypothesis with any of some blocks of columns, from products that are computed once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64, Int64
from sim_to_real.evidence.metric import WeightedColumns, log_evidence, rescale_errors


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks of columns side by side as the metric sees them: their `sides`, and `products` (k, k)."""

    sides: tuple[Float64, ...]
    seen: WeightedColumns
    products: Float64


@dataclass(frozen=True, eq=False)
class Sizes:
    """The posterior of sizes: mean (k,) and covariance (k, k), and the log evidence with them, nats.

    `mean_square` is the cost of what remains per degree of freedom, tr (I - H)^2 with H the hat matrix: an
    estimate of all errors' variance over the stated one that has no bias (Hastie and Tibshirani 1990,
    Generalized Additive Models, 3.5).
    """

    nats: float
    mean: Float64
    covariance: Float64
    mean_square: float


@dataclass(frozen=True, eq=False)
class EvidenceTable:
    """The products of a hypothesis' columns, of further blocks, which end at `ends`, and of residuals.

    There are `count` residuals.
    """

    products: Float64
    sides: Float64
    ends: Int64
    count: int

    def log_evidence(self, *chosen: int, size: float = 1.0) -> float:
        """Return ln Z, nats, of the hypothesis with some blocks, by number, whose sizes are scaled."""
        return log_evidence(*self._part(chosen, size), self.count)

    def sizes(self, *chosen: int, size: float = 1.0) -> Sizes:
        """Return the sizes of some blocks, by number, after what was seen; before, their sigma is `size`."""
        products, sides = self._part(chosen, size)
        nats, variance, cost = rescale_errors(products, sides, self.count)
        P = products[:-1, :-1] / variance
        covariance = np.asarray(np.linalg.inv(P + np.eye(len(P))), dtype=np.float64)
        mean = -covariance @ products[:-1, -1] / variance
        dof = self.count - len(P) + float(np.sum(covariance**2))
        of_blocks = slice(self.ends[1], None)
        return Sizes(nats, size * mean[of_blocks], size**2 * covariance[of_blocks, of_blocks], cost / dof)

    def _part(self, chosen: Sequence[int], size: float) -> tuple[Float64, Float64]:
        """Return the products and the sides of the hypothesis with some blocks, whose sizes are scaled."""
        places = np.concatenate([np.arange(self.ends[1]), *map(self._places, chosen)])
        kept = np.append(places, len(self.products) - 1)
        scale = np.ones(len(kept))
        scale[self.ends[1] : -1] = size
        return self.products[np.ix_(kept, kept)] * np.outer(scale, scale), self.sides[places]

    def likeliest(self, *chosen: int) -> list[Float64]:
        """Return the likeliest sizes (k,) of each of some blocks, by number, fitted together."""
        blocks = [np.arange(self.ends[1]), *map(self._places, chosen)]
        places = np.concatenate(blocks)
        information = self.products[np.ix_(places, places)] + np.eye(len(places))
        sizes = -np.linalg.solve(information, self.products[places, -1])
        return np.split(sizes, np.cumsum([len(block) for block in blocks]))[1:-1]

    def _places(self, block: int) -> Int64:
        return np.arange(self.ends[block + 1], self.ends[block + 2])
