"""What is remembered of the seam from frame to frame: the stretch measured now, and those between jumps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.arrays import Float64, Int64
from noise_model.kernel import kernel
from tracker import checks
from tracker.checks import Asked, ask
from tracker.seam.gaussian_process import (
    SeamHistory,
    SeamPoint,
    condition,
    is_measured,
    no_history,
    with_measurement,
)
from tracker.seam.locate import Located, SeamSource, locate
from tracker.state import Pair

JUMP_SIGMAS, JUMP_FLOOR_MM = 5.0, 0.3
JUMPS_TO_RELEARN, RELEARN_MM, RELEARN_SHARE = 3, 1.5, 0.5
"""So many jumps to one place are the seam's new place, if most frames show it there over such a way.

The rim of a tack shows a joint for some frames, or now and then: a seam shows it on and on.
"""

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


class Stretches(NamedTuple):
    """What a state remembers of the seam; see `TrackerState`."""

    history: SeamHistory
    beyond: SeamHistory
    behind: PastStretches
    jumps: int
    jumped_at: int
    lost: int


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


class SeenSeam(NamedTuple):
    """A seam that a frame shows, beside what a history says of its place.

    `located` is where it lies, `variance_mm2` that of its (y, z); in y and in z it lies `away_mm` from where
    the history puts it, and may lie `limit_mm`. `history` is the history with it as one more measurement.
    """

    located: Located
    variance_mm2: Pair
    away_mm: Pair
    limit_mm: Pair
    history: SeamHistory


@kernel(allocates=True)
def see(
    source: SeamSource,
    T_nominal_tool: Float64,
    scene: Scene,
    y_mm: float,
    z_mm: float,
    variance_mm2: Pair,
    history: SeamHistory,
) -> SeenSeam:
    """Return the seam at (y, z) of a look's frame, of such variances, beside a history.

    `T_nominal_tool` is of the nominal joint frame, see `locate`.
    """
    located = locate(source, T_nominal_tool, scene, y_mm, z_mm)
    expected = condition(history, located.station_mm)
    after = with_measurement(history, located.station_mm, located.displacement_mm, variance_mm2)
    away_mm, limit_mm = aways(expected, located.displacement_mm, variance_mm2)
    return SeenSeam(located, variance_mm2, away_mm, limit_mm, after)


@kernel(allocates=True)
def followed(asked: Asked, before: Stretches, n: int, seen: SeenSeam) -> Stretches:
    """Judge the seam that the n-th frame shows against the earlier ones, and remember it."""
    station, displacement = seen.located.station_mm, seen.located.displacement_mm
    history, behind, jumped_at = before.history, before.behind, before.jumped_at
    if history.stations_mm.shape[0] == 0 or _is_near(asked, seen):
        return Stretches(seen.history, no_history(), behind, 0, jumped_at, 0)
    jumps, beyond = before.jumps + 1, before.beyond
    away_mm, limit_mm = aways(condition(beyond, station), displacement, seen.variance_mm2)
    if away_mm[0] > limit_mm[0] or away_mm[1] > limit_mm[1]:
        # Nor where the last jump was: what is here and there is no seam.
        jumps, beyond = 1, no_history()
    if jumps == 1:
        jumped_at = n
    beyond = with_measurement(beyond, station, displacement, seen.variance_mm2)
    way_mm = abs(station - beyond.stations_mm[0])
    share = jumps / (1 + n - jumped_at)
    if jumps < JUMPS_TO_RELEARN or way_mm < RELEARN_MM or share < RELEARN_SHARE:
        return Stretches(history, beyond, behind, jumps, jumped_at, before.lost)
    # The torch comes to the new stretch later: until then it is on the one before, if that was one.
    if history.stations_mm.shape[0] >= JUMPS_TO_RELEARN:
        behind = with_stretch(behind, history)
    return Stretches(beyond, no_history(), behind, 0, jumped_at, 0)


@kernel
def _is_near(asked: Asked, seen: SeenSeam) -> bool:
    """Ask whether a seam lies where the earlier frames put it."""
    is_near_in_y = ask(asked, checks.JUMP_Y, seen.away_mm[0], seen.limit_mm[0])
    return ask(asked, checks.JUMP_Z, seen.away_mm[1], seen.limit_mm[1]) and is_near_in_y


@kernel
def aways(expected: SeamPoint, displacement_mm: Pair, variance_mm2: Pair) -> tuple[Pair, Pair]:
    """Return how far a seam lies from where it is expected, and how far it may, mm, in y and in z each."""
    (expected_y, expected_z), (sigma_y, sigma_z) = expected.displacement_mm, expected.sigma_mm
    (y_mm, z_mm), (variance_y, variance_z) = displacement_mm, variance_mm2
    return (
        (abs(y_mm - expected_y), abs(z_mm - expected_z)),
        (jump_limit_mm(sigma_y, variance_y), jump_limit_mm(sigma_z, variance_z)),
    )


@kernel
def jump_limit_mm(expected_sigma_mm: float, variance_mm2: float) -> float:
    """Return how far a seam may lie from where the earlier frames put it, mm, without being a jump."""
    return max(JUMP_SIGMAS * math.sqrt(expected_sigma_mm**2 + variance_mm2), JUMP_FLOOR_MM)
