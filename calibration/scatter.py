"""Whether goniometer settings scatter about a fit as their repeats let expect: Fisher's test."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from calibration.reflectance_model import ReadingsFit, ReadingsModel

UNLIKELY = 0.01
"""The p-value below which the model, or the settings, are taken to be off by more than the repeats show."""


@dataclass(frozen=True)
class Scatter:
    """Mean squares of the settings about the model and of the repeats, both over one noise model.

    `p_value` is Fisher's: how often a right model's `between` would exceed `within` as much; NaN without
    repeats.
    """

    between: float
    between_freedom: float
    within: float
    within_freedom: float

    @property
    def ratio(self) -> float:
        """The scatter between settings over what the repeats let expect, as standard deviations."""
        return math.sqrt(self.between / self.within) if self.between > 0 and self.within > 0 else math.nan

    @property
    def p_value(self) -> float:
        """The probability of so large a ratio by chance."""
        if not self.within > 0:
            return math.nan
        return float(fdtrc(self.between_freedom, self.within_freedom, self.between / self.within))

    @property
    def is_unlikely(self) -> bool:
        """Whether chance does not explain the settings' scatter."""
        return self.p_value < UNLIKELY


def compare(model: ReadingsModel, fitted: ReadingsFit) -> Scatter:
    """Return how much the settings and the repeats scatter; NaN and 0 for repeats that were not taken."""
    more = model.repeats - 1.0
    freedom = float(more.sum())
    squares = float(np.sum(more * np.nan_to_num(model.variance) / (fitted.sigma**2 * model.repeats)))
    within = squares / freedom if freedom else math.nan
    return Scatter(fitted.fit.chi2, fitted.fit.freedom, within, freedom)
