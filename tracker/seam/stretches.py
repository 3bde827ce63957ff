"""What is remembered of the seam from frame to frame: the stretch measured now, and those between jumps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Float64, Int64
from noise_model.kernel import kernel
from tracker.seam.gaussian_process import SeamHistory, is_measured

MAX_STRETCHES = 8
"""So many stretches between jumps are remembered for the torch that comes after."""

_NO_STATIONS, _NO_PLACES, _NO_ENDS = np.empty(0), np.empty((0, 2)), np.empty(0, np.int64)


class PastStretches(NamedTuple):
    """The latest stretches before the present one, in which the torch may still stand, the oldest first.

    Their measurements (n,) and (n, 2) stand one after another as a `SeamHistory` has them, each one's up to
    its place in `ends` (k,), with its own `began_mm` (k,).
    """

    stations_mm: Float64 = _NO_STATIONS
    displacements_mm: Float64 = _NO_PLACES
    variances_mm2: Float64 = _NO_PLACES
    began_mm: Float64 = _NO_STATIONS
    ends: Int64 = _NO_ENDS

    @classmethod
    def of(cls, histories: Sequence[SeamHistory]) -> PastStretches:
        """Return some stretches as one record."""
        past = cls()
        for history in histories:
            past = with_stretch(past, history)
        return past

    @property
    def histories(self) -> tuple[SeamHistory, ...]:
        """The stretches one by one."""
        return tuple(stretch_of(self, i) for i in range(len(self.ends)))


@kernel(allocates=True)
def stretch_of(past: PastStretches, i: int) -> SeamHistory:
    """Return the i-th of the stretches before."""
    first, end = past.ends[i - 1] if i > 0 else 0, past.ends[i]
    n = end - first
    history = SeamHistory(np.empty(n), np.empty((n, 2)), np.empty((n, 2)), past.began_mm[i])
    for k in range(n):
        history.stations_mm[k] = past.stations_mm[first + k]
        for axis in range(2):
            history.displacements_mm[k, axis] = past.displacements_mm[first + k, axis]
            history.variances_mm2[k, axis] = past.variances_mm2[first + k, axis]
    return history


@kernel(allocates=True)
def with_stretch(past: PastStretches, history: SeamHistory) -> PastStretches:
    """Return the stretches before with one more, the oldest dropped beyond MAX_STRETCHES."""
    k = past.ends.shape[0]
    dropped = 1 if k == MAX_STRETCHES else 0
    first = past.ends[0] if dropped > 0 else 0
    n_before, n = past.stations_mm.shape[0] - first, history.stations_mm.shape[0]
    n_all = n_before + n
    stations, displacements, variances = np.empty(n_all), np.empty((n_all, 2)), np.empty((n_all, 2))
    began, ends = np.empty(k + 1 - dropped), np.empty(k + 1 - dropped, np.int64)
    for i in range(n_before):
        stations[i] = past.stations_mm[first + i]
        for axis in range(2):
            displacements[i, axis] = past.displacements_mm[first + i, axis]
            variances[i, axis] = past.variances_mm2[first + i, axis]
    for i in range(n):
        stations[n_before + i] = history.stations_mm[i]
        for axis in range(2):
            displacements[n_before + i, axis] = history.displacements_mm[i, axis]
            variances[n_before + i, axis] = history.variances_mm2[i, axis]
    for i in range(k - dropped):
        began[i], ends[i] = past.began_mm[i + dropped], past.ends[i + dropped] - first
    began[k - dropped], ends[k - dropped] = history.began_mm, n_all
    return PastStretches(stations, displacements, variances, began, ends)


@kernel(allocates=True)
def history_at(history: SeamHistory, behind: PastStretches, station_mm: float) -> tuple[SeamHistory, bool]:
    """Return the stretch of the seam that a station lies on, and whether it is the present one.

    It is the latest that has measured the station. Between two stretches it is that of the nearer one.
    """
    k = behind.ends.shape[0]
    if k == 0 or is_measured(history, station_mm):
        return history, True
    for i in range(k - 1, -1, -1):
        before = stretch_of(behind, i)
        if is_measured(before, station_mm):
            return before, False
    stretch, is_present = history, True
    for i in range(k - 1, -1, -1):
        before = stretch_of(behind, i)
        if stretch.stations_mm.shape[0] > 0:
            middle_mm = 0.5 * (before.stations_mm.max() + stretch.stations_mm.min())
            if station_mm >= middle_mm:
                return stretch, is_present
        stretch, is_present = before, False
    return stretch, is_present
