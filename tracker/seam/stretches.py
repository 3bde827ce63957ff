"""What is remembered of the seam from frame to frame: the stretch measured now, and those between jumps."""

from __future__ import annotations

import math
import operator
from typing import NamedTuple

import numpy as np

from tracker import checks
from tracker.checks import Checks
from tracker.seam.gaussian_process import SeamHistory
from tracker.seam.locate import Located
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
        for measured in (self.history, *reversed(self.behind)):
            if measured.is_measured(station_mm):
                return measured
        stretch = self.history
        for before in reversed(self.behind):
            if len(stretch) and station_mm >= 0.5 * (before.stations_mm.max() + stretch.stations_mm.min()):
                return stretch
            stretch = before
        return stretch


def followed(before: Stretches, asked: Checks, n: int, located: Located, variance_mm2: Pair) -> Stretches:
    """Judge the seam that the n-th frame shows against the earlier ones, and remember it.

    `variance_mm2` is that of its (y, z).
    """
    station, displacement = located.station_mm, located.displacement_mm
    history, behind, jumped_at = before.history, before.behind, before.jumped_at
    if not len(history) or _is_near(asked, history, station, displacement, variance_mm2):
        history = history.with_measurement(station, displacement, variance_mm2)
        return Stretches(history, SeamHistory(), behind, 0, jumped_at, 0)
    jumps, beyond = before.jumps + 1, before.beyond
    elsewhere, sigma = beyond.at(station)
    away = np.abs(np.array(displacement) - elsewhere).tolist()
    if any(map(operator.gt, away, map(jump_limit_mm, sigma.tolist(), variance_mm2))):
        # Nor where the last jump was: what is here and there is no seam.
        jumps, beyond = 1, SeamHistory()
    jumped_at = n if jumps == 1 else jumped_at
    beyond = beyond.with_measurement(station, displacement, variance_mm2)
    way_mm = abs(station - float(beyond.stations_mm[0]))
    share = jumps / (1 + n - jumped_at)
    if jumps < JUMPS_TO_RELEARN or way_mm < RELEARN_MM or share < RELEARN_SHARE:
        return Stretches(history, beyond, behind, jumps, jumped_at, before.lost)
    # The torch comes to the new stretch later: until then it is on the one before, if that was one.
    if len(history) >= JUMPS_TO_RELEARN:
        behind = (*behind, history)[-MAX_STRETCHES:]
    return Stretches(beyond, SeamHistory(), behind, 0, jumped_at, 0)


def _is_near(
    asked: Checks, history: SeamHistory, station_mm: float, seam_mm: Pair, variance_mm2: Pair
) -> bool:
    """Ask whether a seam, (y, z), lies where the earlier frames put it."""
    expected, sigma = history.at(station_mm)
    is_near = True
    for axis, question in enumerate((checks.JUMP_Y, checks.JUMP_Z)):
        away_mm = abs(seam_mm[axis] - float(expected[axis]))
        limit_mm = jump_limit_mm(float(sigma[axis]), variance_mm2[axis])
        is_near = asked.ask(question, away_mm, limit_mm) and is_near
    return is_near


def jump_limit_mm(expected_sigma_mm: float, variance_mm2: float) -> float:
    """Return how far a seam may lie from where the earlier frames put it, mm, without being a jump."""
    return max(JUMP_SIGMAS * math.sqrt(expected_sigma_mm**2 + variance_mm2), JUMP_FLOOR_MM)
