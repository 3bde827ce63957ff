"""How late offsets go out, counted in bins: a shift takes no more memory than a minute."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

BIN_MS, BINS = 0.1, 10_000
"""A bin's width, ms, and how many there are: up to a second. What is later is in the last one."""


@dataclass(frozen=True)
class Quantiles:
    """The median, the quantiles of 99 and 99.9 %, and the largest of times, ms; NaN without any."""

    p50_ms: float
    p99_ms: float
    p999_ms: float
    max_ms: float

    def __str__(self) -> str:
        if math.isnan(self.max_ms):
            return "none"
        quantiles = f"p50 {self.p50_ms:.1f} ms, p99 {self.p99_ms:.1f} ms, p99.9 {self.p999_ms:.1f} ms"
        return f"{quantiles}, at most {self.max_ms:.1f} ms"


class LatencyCounts:
    """Counts times, and gives their quantiles to a bin's width.

    Attributes
    ----------
    max_ms : float
        The largest time, ms; NaN before the first.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(BINS, np.int64)
        self.max_ms = math.nan

    def add(self, took_s: float) -> None:
        """Count a time, s."""
        took_ms = 1000.0 * took_s
        self._counts[min(max(int(took_ms / BIN_MS), 0), BINS - 1)] += 1
        # Written so that a NaN gives way.
        if not took_ms <= self.max_ms:
            self.max_ms = took_ms

    def quantiles(self) -> Quantiles:
        """Return what the times come to."""
        total = np.cumsum(self._counts)
        if total[-1] == 0:
            return Quantiles(math.nan, math.nan, math.nan, math.nan)
        # The upper end of the bin below which a share of the times lies.
        bins = np.searchsorted(total, np.array([0.5, 0.99, 0.999]) * total[-1])
        p50_ms, p99_ms, p999_ms = np.minimum(BIN_MS * (bins + 1), self.max_ms).tolist()
        return Quantiles(p50_ms, p99_ms, p999_ms, self.max_ms)
