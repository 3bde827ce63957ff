"""Latencies of offsets, counted in bins of 1 %: a shift takes no more memory than a minute."""

import math
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from arctrack.live.journal.records import BUCKETS_S

EDGES_MS = tuple(per_thousand * 10**decade / 1000 for decade in range(7) for per_thousand in range(100, 1000))
"""The bins' upper ends, ms: three digits of each time from 0.1 ms to 1000 s. Later times share one bin."""

_ENDS_MS = np.array([*EDGES_MS, math.inf])
_BUCKET_BINS = np.searchsorted(_ENDS_MS, [*(1000.0 * end_s for end_s in BUCKETS_S), math.inf])


@dataclass(frozen=True)
class Quantiles:
    """The median, the quantiles of 99 and 99.9 %, and the largest of times, ms; NaN without any.

    A quantile is at most 1 %, or 0.1 ms, above the true one. The largest time is exact.
    """

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
    """Histogram of latencies, with quantiles to a bin's width; `max_ms` is NaN before the first."""

    def __init__(self) -> None:
        self._counts = np.zeros(len(_ENDS_MS), np.int64)
        self.sum_s = 0.0
        self.max_ms = math.nan

    def add(self, took_s: float) -> None:
        """Count a time, s."""
        took_ms = 1000.0 * took_s
        self._counts[bisect_left(EDGES_MS, took_ms)] += 1
        self.sum_s += took_s
        # Written so that a NaN gives way.
        if not took_ms <= self.max_ms:
            self.max_ms = took_ms

    def quantiles(self) -> Quantiles:
        """Return what the times come to."""
        totals = np.cumsum(self._counts)
        if totals[-1] == 0:
            return Quantiles(math.nan, math.nan, math.nan, math.nan)
        # The upper end of the bin in which a share of the times is reached.
        bins = np.searchsorted(totals, np.array([0.5, 0.99, 0.999]) * totals[-1])
        p50_ms, p99_ms, p999_ms = np.minimum(_ENDS_MS[bins], self.max_ms).tolist()
        return Quantiles(p50_ms, p99_ms, p999_ms, self.max_ms)

    def up_to_buckets(self) -> tuple[int, ...]:
        """Return how many times were at most each of `BUCKETS_S`, and last how many there were."""
        return tuple(np.cumsum(self._counts)[_BUCKET_BINS].tolist())
