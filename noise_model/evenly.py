"""Some of many, evenly over all of them."""

from __future__ import annotations

import numpy as np

from noise_model.compiled.arrays import Int64


def evenly(count: int, most: int) -> Int64:
    """Return the positions of `most` of `count` at the most, in order, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
