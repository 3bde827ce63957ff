"""Upright edges: no point lies on one, so it lies between the last point before and the first one behind."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from noise_model.frames import Float64

Bool = npt.NDArray[np.bool_]


def neighbours_of_edge(y_mm: Float64, before: Bool, behind: Bool) -> tuple[float, float] | None:
    """Return the places of the last point before an edge and of the first behind it, None without either.

    `y_mm` (n,) rises; `before` and `behind` (n,) say which points lie on which side's face. The changes that
    put most points on their own side are taken: one on the other side's face by chance is outvoted.
    """
    votes = np.cumsum(before.astype(int) - behind.astype(int))
    first, last = np.flatnonzero(votes == votes.max())[[0, -1]] + 1
    before_y, behind_y = y_mm[:first][before[:first]], y_mm[last:][behind[last:]]
    if not before_y.size or not behind_y.size:
        return None
    return float(before_y.max()), float(behind_y.min())


def hidden_strip(source_mm: Float64, edge_y_mm: float, edge_z_mm: float, step_mm: float) -> float:
    """Return how much of the lower side beside the foot an edge hides from a point (3,), mm."""
    _, y, z = source_mm
    return float(max(0.0, (edge_y_mm - y) / (z - edge_z_mm) * step_mm))
