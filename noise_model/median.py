"""The median of some hundred numbers, without the hundred calls of Python that NumPy's own takes.

NumPy's takes some 20 µs a call, most of it Python's; a tracker's step asks for it a dozen times.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from noise_model.arrays import Float64
from noise_model.kernel import kernel


def median(values: npt.ArrayLike) -> float:
    """Return the median of values (n,), as `numpy.median` does; NaN where one is NaN, or without any."""
    # A copy of its own has one type, whatever the values' strides: nothing is compiled a second time.
    return float(_median(np.array(values, np.float64)))


def known_median(values: npt.ArrayLike) -> float:
    """Return the median of the values (n,) that are no NaN, as `numpy.nanmedian` does; NaN without any."""
    held = np.array(values, np.float64)
    return float(_median(held[~np.isnan(held)]))


@kernel(allocates=True)
def _median(values: Float64) -> float:
    if len(values) == 0:
        return math.nan
    for value in values:
        if math.isnan(value):
            return math.nan
    return np.median(values)
