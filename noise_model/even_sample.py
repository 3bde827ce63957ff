"""Some of many, evenly over all of them."""

from __future__ import annotations

import numpy as np

from noise_model.compiled.arrays import Int64


def evenly(count: int, max_count: int) -> Int64:
    """Return the positions of at most `max_count` of `count`, in order, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, max_count)).round().astype(np.int64))
