"""Errors whose size only few values say."""

from __future__ import annotations

from scipy.stats import norm, t


def wider_by_few(freedom: float) -> float:
    """Return the factor of a 95 % interval at these degrees of freedom over the normal one: Student's t."""
    return float(t.isf(0.025, freedom) / norm.isf(0.025))
