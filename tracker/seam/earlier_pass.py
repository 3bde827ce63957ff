"""Seam of an earlier pass, which a later one follows again, and its fusion with what the later one sees.

Both passes give an estimate of the seam where the torch stands, by one Gaussian process each. What part and
robot have moved in between is common to all of the earlier pass, so it adds to that estimate's variance and
does not average out. Of independent estimates m with variance v the fused one is
sum(m / v) / sum(1 / v), its variance 1 / sum(1 / v).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from tracker.seam.gaussian_process import SeamHistory, SeamPrediction
from tracker.seam.locate import SeamSource
from tracker.state import Pair

MAX_TILT_OFF_DEG = 10.0
"""Largest difference between the tool's tilt and the pass's, degrees.

Chosen: passes of one groove differ by 10 to 30 degrees, a wrist keeps its program to one. So it tells another
pass's program; at half or twice as much it still does.
"""

_NO_TILTS = np.empty(0)


class EarlierPass(NamedTuple):
    """Seam of an earlier pass along the present nominal line; without measurements it is unusable.

    - `history`: the earlier pass's measurements, stations rising.
    - `moved_sigma_mm`: 1 sigma of what part and robot have moved since, mm, common to all stations.
    - `calibration_variance_mm2`: (y, z), the calibration's part in the error, which `history` leaves out.
    - `tilts_deg` (n,): the tilt about the seam that the tool is to have at each of the history's stations.
    - `uses_laser`: whether the present pass sees the seam, too.
    """

    history: SeamHistory = SeamHistory()
    moved_sigma_mm: float = 0.0
    calibration_variance_mm2: Pair = (0.0, 0.0)
    tilts_deg: Float64 = _NO_TILTS
    uses_laser: bool = True

    def tilt_off_deg(self, station_mm: float, tilt_deg: float) -> float:
        """Return the difference between a tool's tilt and the pass's at a station, degrees, at least 0."""
        wanted_deg = float(np.interp(station_mm, self.history.stations_mm, self.tilts_deg))
        return abs((tilt_deg - wanted_deg + 180.0) % 360.0 - 180.0)


def tool_tilt_deg(T_joint_tool: Float64) -> float:
    """Return a tool's tilt about the seam, degrees, from its pose (4, 4) in the joint frame.

    It is 0 where the tool's z lies in the plane of seam and surface normal, and positive where it leans to
    the right of the travel.
    """
    return math.degrees(math.atan2(-T_joint_tool[1, 2], T_joint_tool[2, 2]))


class KnownSeam(NamedTuple):
    """All that is known of a seam: a stretch that this pass has measured, and the earlier pass if any."""

    source: SeamSource
    history: SeamHistory
    earlier: EarlierPass | None = None

    @property
    def n(self) -> int:
        """Number of measurements."""
        return self.history.n + (0 if self.earlier is None else self.earlier.history.n)

    def at(self, station_mm: float) -> SeamPrediction:
        """Return the seam at a station, mm; the earlier pass counts by its sigma."""
        seen = self.source.seam_at(self.history, station_mm)
        before = self.before(station_mm)
        if before is None:
            return seen
        weights = self._weights(seen, before)
        displacement_mm = [
            share * there + (1.0 - share) * here
            for share, here, there in zip(weights, seen.displacement_mm, before.displacement_mm, strict=True)
        ]
        sigma_mm = [
            here * there / math.hypot(here, there)
            for here, there in zip(seen.sigma_mm, before.sigma_mm, strict=True)
        ]
        return before._replace(
            displacement_mm=(displacement_mm[0], displacement_mm[1]),
            sigma_mm=(sigma_mm[0], sigma_mm[1]),
            first_mm=float(np.fmin(seen.first_mm, before.first_mm)),
            last_mm=float(np.fmax(seen.last_mm, before.last_mm)),
        )

    def before(self, station_mm: float) -> SeamPrediction | None:
        """Return the earlier pass's own seam at a station, with what has moved since; None without one."""
        if self.earlier is None or self.earlier.history.n == 0:
            return None
        whole = self.earlier.history
        there = self.source.seam_at(whole.about(station_mm), station_mm)
        y_mm, z_mm = (math.hypot(sigma_mm, self.earlier.moved_sigma_mm) for sigma_mm in there.sigma_mm)
        first_mm, last_mm = float(whole.stations_mm[0]), float(whole.stations_mm[-1])
        return there._replace(sigma_mm=(y_mm, z_mm), first_mm=first_mm, last_mm=last_mm)

    def share_before(self, station_mm: float) -> float:
        """Return the earlier pass's share in the seam at a station, of the axis where it is larger."""
        before = self.before(station_mm)
        if before is None:
            return 0.0
        return max(self._weights(self.source.seam_at(self.history, station_mm), before))

    @staticmethod
    def _weights(seen: SeamPrediction, before: SeamPrediction) -> list[float]:
        """Return the earlier pass's shares in y and z."""
        return [
            here**2 / (here**2 + there**2) for here, there in zip(seen.sigma_mm, before.sigma_mm, strict=True)
        ]
