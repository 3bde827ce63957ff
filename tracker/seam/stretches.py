"""What is remembered of the seam from frame to frame: the stretch measured now, and those between jumps."""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.arc.scene import Scene
from noise_model.arrays import Float64
from noise_model.kernel import kernel
from tracker import checks
from tracker.checks import Asked, ask
from tracker.seam.gaussian_process import NO_HISTORY, SeamHistory, SeamPoint, condition, with_measurement
from tracker.seam.locate import Located, SeamSource, locate
from tracker.state import Pair

JUMP_SIGMAS, JUMP_FLOOR_MM = 5.0, 0.3
JUMPS_TO_RELEARN, RELEARN_MM, RELEARN_SHARE = 3, 1.5, 0.5
"""So many jumps to one place are the seam's new place, if most frames show it there over such a way.

The rim of a tack shows a joint for some frames, or now and then: a seam shows it on and on.
"""

MAX_STRETCHES = 8
"""So many stretches between jumps are remembered for the torch that comes after."""


class Stretches(NamedTuple):
    """What a state remembers of the seam; see `TrackerState`."""

    history: SeamHistory
    beyond: SeamHistory
    behind: tuple[SeamHistory, ...]
    jumps: int
    jumped_at: int
    lost: int

    def history_at(self, station_mm: float) -> SeamHistory:
        """Return the stretch of the seam that a station lies on: the latest that has measured it.

        Between two stretches it is that of the nearer one.
        """
        if not self.behind:
            return self.history
        for measured in (self.history, *reversed(self.behind)):
            if measured.is_measured(station_mm):
                return measured
        stretch = self.history
        for before in reversed(self.behind):
            if len(stretch) and station_mm >= 0.5 * (before.stations_mm.max() + stretch.stations_mm.min()):
                return stretch
            stretch = before
        return stretch


class SeenSeam(NamedTuple):
    """A seam that a frame shows, beside what a history says of its place.

    `located` is where it lies, `variance_mm2` that of its (y, z); in y and in z it lies `away_mm` from where
    the history puts it, and may lie `limit_mm`. The rest is the history with it as one more measurement, as
    `SeamHistory` takes it.
    """

    located: Located
    variance_mm2: Pair
    away_mm: Pair
    limit_mm: Pair
    stations_mm: Float64
    displacements_mm: Float64
    variances_mm2: Float64
    began_mm: float


@kernel(allocates=True)
def see(
    source: SeamSource,
    T_nominal_tool: Float64,
    scene: Scene,
    y_mm: float,
    z_mm: float,
    variance_mm2: Pair,
    stations_mm: Float64,
    displacements_mm: Float64,
    variances_mm2: Float64,
    began_mm: float,
) -> SeenSeam:
    """Return the seam at (y, z) of a look's frame, of such variances, beside a `SeamHistory`'s numbers.

    `T_nominal_tool` is of the nominal joint frame, see `locate`.
    """
    located = locate(source, T_nominal_tool, scene, y_mm, z_mm)
    expected = condition(stations_mm, displacements_mm, variances_mm2, located.station_mm)
    stations, displacements, variances, began = with_measurement(
        stations_mm,
        displacements_mm,
        variances_mm2,
        began_mm,
        located.station_mm,
        located.displacement_mm,
        variance_mm2,
    )
    away_mm, limit_mm = aways(expected, located.displacement_mm, variance_mm2)
    return SeenSeam(located, variance_mm2, away_mm, limit_mm, stations, displacements, variances, began)


def followed(before: Stretches, asked: Asked, n: int, seen: SeenSeam) -> Stretches:
    """Judge the seam that the n-th frame shows against the earlier ones, and remember it."""
    station, displacement = seen.located.station_mm, seen.located.displacement_mm
    history, behind, jumped_at = before.history, before.behind, before.jumped_at
    if not len(history) or _is_near(asked, seen):
        history = SeamHistory(seen.stations_mm, seen.displacements_mm, seen.variances_mm2, seen.began_mm)
        return Stretches(history, NO_HISTORY, behind, 0, jumped_at, 0)
    jumps, beyond, variance_mm2 = before.jumps + 1, before.beyond, seen.variance_mm2
    elsewhere = beyond.point_at(station)
    away_mm, limit_mm = aways(elsewhere, displacement, variance_mm2)
    if away_mm[0] > limit_mm[0] or away_mm[1] > limit_mm[1]:
        # Nor where the last jump was: what is here and there is no seam.
        jumps, beyond = 1, NO_HISTORY
    jumped_at = n if jumps == 1 else jumped_at
    beyond = beyond.with_measurement(station, displacement, variance_mm2)
    way_mm = abs(station - float(beyond.stations_mm[0]))
    share = jumps / (1 + n - jumped_at)
    if jumps < JUMPS_TO_RELEARN or way_mm < RELEARN_MM or share < RELEARN_SHARE:
        return Stretches(history, beyond, behind, jumps, jumped_at, before.lost)
    # The torch comes to the new stretch later: until then it is on the one before, if that was one.
    if len(history) >= JUMPS_TO_RELEARN:
        behind = (*behind, history)[-MAX_STRETCHES:]
    return Stretches(beyond, NO_HISTORY, behind, 0, jumped_at, 0)


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
