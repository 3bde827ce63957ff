"""Test of whether goniometer settings scatter about a fit as their repeats let expect (Fisher)."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from calibration.reflectance_model import ReadingsFit, ReadingsModel

MIN_FREEDOM = 0.5
"""Settings to which a fit leaves less freedom than this say nothing of their scatter."""


@dataclass(frozen=True)
class RepeatScatter:
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
        """True if chance does not explain the settings' scatter."""
        return self.p_value < 0.01


def compare(model: ReadingsModel, fitted: ReadingsFit, part: slice) -> RepeatScatter:
    """Return the scatter of some settings, and of their repeats, about a fit weighted by the repeats.

    `between` is NaN where the fit leaves them no freedom, `within` for repeats that were not taken.
    """
    more = model.repeats[part] - 1.0
    freedom = float(more.sum())
    variance = fitted.noise.variance(model.level(fitted.fit.values) - model.response.black_dn)[part]
    squares = float(np.sum(more * np.nan_to_num(model.variance[part]) / variance))
    settings_freedom = float(np.sum(1.0 - fitted.fit.leverage[part]))
    between = (
        float(np.sum(fitted.fit.residuals[part] ** 2)) / settings_freedom
        if settings_freedom > MIN_FREEDOM
        else math.nan
    )
    return RepeatScatter(between, settings_freedom, squares / freedom if freedom else math.nan, freedom)
