"""The bow of a laser sheet: line lasers draw a smile, and a plane does not hold it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64

SURE_SIGMAS = 4.0
"""A bow of fewer sigmas may be chance: pairs are few, and so the sigma is rough."""


@dataclass(frozen=True)
class Bow:
    """The sheet's bow: distance of its ends from its middle along the plane's normal.

    `sigma_mm` follows from the scatter of pairs; `half_mm` is half the median stripe's length.
    """

    bow_mm: float
    sigma_mm: float
    half_mm: float

    @property
    def is_sure(self) -> bool:
        """True if the sheet is bent significantly."""
        return abs(self.bow_mm) > SURE_SIGMAS * self.sigma_mm


def fit_bow(points_mm: Sequence[Float64], off_mm: Sequence[Float64]) -> Bow:
    """Return the mean bow over the median stripe, from a parabola fitted to each stripe.

    Each stripe has points (n, 3), which lie `off_mm` (n,) off the plane.
    """
    curvatures, halves = [], []
    for points, off in zip(points_mm, off_mm, strict=True):
        centred = points - points.mean(axis=0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        curvatures.append(float(np.polyfit(along, off, 2)[0]))
        halves.append(0.5 * float(np.ptp(along)))
    half_mm = float(np.median(halves))
    spread = float(np.std(curvatures, ddof=1)) / math.sqrt(len(curvatures))
    return Bow(float(np.mean(curvatures)) * half_mm**2, spread * half_mm**2, half_mm)
