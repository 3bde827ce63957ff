"""The sigma of values of which some may be far off: by medians, which hardly see those."""

from __future__ import annotations

import numpy as np

from noise_model.compiled.arrays import Float32, Float64

MAD_SIGMA = 1.4826
"""A normal law's sigma over its median absolute deviation."""


def spread(values: Float64 | Float32) -> float:
    """Return 1 sigma of values, from their median distance to the median; 0 of none."""
    return sigma_of(values - np.median(values)) if len(values) else 0.0


def sigma_of(residuals: Float64 | Float32) -> float:
    """Return 1 sigma of residuals about 0, from their median size."""
    return MAD_SIGMA * float(np.median(np.abs(residuals)))
