"""The order of values, for kernels: numba's own sort takes 0.7 s to compile."""

from __future__ import annotations

import numpy as np

from noise_model.compiled.arrays import Float64, Int64
from noise_model.compiled.kernel import kernel


@kernel(allocates=True)
def stable_order(values: Float64) -> Int64:
    """Return the indices (n,) that sort values (n,), as `numpy.argsort` does with `kind="stable"`; no NaN."""
    n, width = values.shape[0], 1
    order, merged = np.arange(n), np.empty(n, np.int64)
    while width < n:
        for low in range(0, n, 2 * width):
            middle, end = min(low + width, n), min(low + 2 * width, n)
            i, j = low, middle
            for k in range(low, end):
                if j == end or (i < middle and values[order[i]] <= values[order[j]]):
                    merged[k] = order[i]
                    i += 1
                else:
                    merged[k] = order[j]
                    j += 1
        order, merged, width = merged, order, 2 * width
    return order
