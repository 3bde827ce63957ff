"""Upright edges: no point lies on one, so it lies between the last point before and the first one behind."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from noise_model.frames import Float64
from noise_model.kernel import kernel

Bool = npt.NDArray[np.bool_]


@kernel
def neighbours_of_edge(y_mm: Float64, before: Bool, behind: Bool) -> tuple[float, float]:
    """Return the places of the last point before an edge and of the first behind it, NaN without either.

    `y_mm` (n,) rises; `before` and `behind` (n,) say which points lie on which side's face. The changes that
    put most points on their own side are taken: one on the other side's face by chance is outvoted.
    """
    n, votes, most, first, last = y_mm.shape[0], 0, -y_mm.shape[0], 0, 0
    for i in range(n):
        votes += int(before[i]) - int(behind[i])
        if votes > most:
            most, first = votes, i
        if votes == most:
            last = i
    while first >= 0 and not before[first]:
        first -= 1
    last += 1
    while last < n and not behind[last]:
        last += 1
    if first < 0 or last >= n:
        return math.nan, math.nan
    return y_mm[first], y_mm[last]


def hidden_strip(source_mm: Float64, edge_y_mm: float, edge_z_mm: float, step_mm: float) -> float:
    """Return how much of the lower side beside the foot an edge hides from a point (3,), mm.

    From a point that is not above the edge all of it is hidden: infinity.
    """
    over_mm = float(source_mm[2]) - edge_z_mm
    return max(0.0, (edge_y_mm - float(source_mm[1])) / over_mm * step_mm) if over_mm > 0.0 else math.inf
