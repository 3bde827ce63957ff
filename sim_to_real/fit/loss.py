"""Losses of residuals in a fit: Huber's loss of each, which needs no error model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.fit import Parameter
from noise_model.robust import sigma_of
from sim_to_real.fit.quadratic import Quadratic

N_EFFECTIVE = 200.0
"""The effective number of independent residuals: neighbours share the model's error."""


class Loss(Protocol):
    """A cost of residuals (n,) whose form stays during a step, and its quadratic approximation."""

    def cost(self, r: Float64) -> float:
        """Return the cost of residuals (n,)."""

    def quadratic(self, parameters: Sequence[Parameter], x: Float64, r: Float64, J: Float64) -> Quadratic:
        """Return the cost about parameters x (p,) with residuals r (n,) and their derivatives J (n, p)."""

    def is_converged(self, cost: float, gained: float) -> bool:
        """Return True if a step of this gain ends a fit of this cost."""


LossAbout: TypeAlias = Callable[[Float64], Loss]
"""Returns the loss for a step from residuals (n,)."""


@dataclass(frozen=True, eq=False)
class HuberLoss:
    """Huber's loss beyond a `bound`.

    Only `N_EFFECTIVE` residuals count as independent, and their variance is that which is left. So where a
    model is still far off, the priors keep its parameters near.
    """

    bound: float
    prior_weight: float

    @classmethod
    def about(cls, r: Float64) -> "HuberLoss":
        """Return the loss for a step from residuals (n,)."""
        bound = huber_bound(r)
        chi2 = float(huber_weights(r, bound) @ r**2)
        return cls(bound, max(chi2 / min(len(r), N_EFFECTIVE), 1e-3))

    def cost(self, r: Float64) -> float:
        """Return the cost of residuals (n,)."""
        size = np.abs(r)
        return float(np.sum(np.where(size > self.bound, 2.0 * self.bound * size - self.bound**2, size**2)))

    def quadratic(self, parameters: Sequence[Parameter], x: Float64, r: Float64, J: Float64) -> Quadratic:
        """Return the cost about parameters x (p,) with residuals r (n,) and their derivatives J (n, p)."""
        weights = huber_weights(r, self.bound)
        weighted = weights[:, np.newaxis] * J
        chi2 = float(weights @ r**2)
        return Quadratic(tuple(parameters), x, J.T @ weighted, -(weighted.T @ r), chi2, self.prior_weight)

    def is_converged(self, cost: float, gained: float) -> bool:
        """Return True if a step of this gain ends a fit of this cost."""
        return gained < 1e-3 * cost


def huber_bound(r: Float64) -> float:
    """Return Huber's bound for residuals (n,), proportional to their own spread."""
    return 3.0 * max(1.0, sigma_of(r))


def huber_weights(r: Float64, bound: float) -> Float64:
    """Return Huber's weights (n,)."""
    return np.asarray(np.minimum(1.0, bound / np.maximum(np.abs(r), bound)))
