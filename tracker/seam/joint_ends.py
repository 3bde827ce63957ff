"""Start and end of the joint along the path: its nominal line's ends, and those that the sensor finds.

What the sensor reports of a joint goes from 'none' to 'found' at its start, and back at its end, with misses
and false finds between. Each look multiplies the odds of every place where the change may have been by the
likelihood ratio of what it found, and adds one more such place, between the look before and itself:

    R_n = (1 + R_(n-1)) L_n

The change is declared when R reaches 1 / FALSE_ALARM (Shiryaev 1963; Roberts 1966, Technometrics 8, 411). As
R_n - n is a martingale while nothing changes, at least 1 / FALSE_ALARM looks pass on average before a false
alarm (Pollak 1987, Annals of Statistics 15, 749), and no procedure with as few of them is quicker on average
after a long wait (Pollak and Tartakovsky 2009, Statistica Sinica 19, 1729). A change is declared within
ln(FOUND_SHARE / FALSE_SHARE / FALSE_ALARM) / D looks on average (Wald's identity), D the Kullback-Leibler
divergence of the two shares. The same odds weigh the places: their mean is where it was, their spread how
well that is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.surface.joint import SeamSegments
from noise_model.transforms import invert, transform

FOUND_SHARE, FALSE_SHARE = 0.9, 0.1
"""Least detection rate of a joint where there is one, and largest where there is none."""

FALSE_ALARM = 1e-4
"""One over the looks between false alarms, at least, on average."""

LOOK_MM = 1.0
"""Frames nearer to the last look than this see the same spatter and the same plate: they are no new look."""

DECIDE_MM = 10.0
"""Distance of the search beyond the last place where an end may lie: a decision takes some frames."""


class Change(NamedTuple):
    """The odds that a change has been passed, and where it was: its station and variance.

    `before` are the odds that it lies before the first look, `odds` that it was passed since, up to the last
    look at `looked_mm`.
    """

    odds: float = 0.0
    before: float = 1.0
    station_mm: float = math.nan
    variance_mm2: float = math.nan
    looked_mm: float = math.nan

    @property
    def sigma_mm(self) -> float:
        """The place's 1 sigma, mm."""
        return math.sqrt(self.variance_mm2)

    @property
    def is_decided(self) -> bool:
        """True once the change has happened."""
        return self.odds + self.before >= 1.0 / FALSE_ALARM

    @property
    def is_seen(self) -> bool:
        """True once the change has happened and was passed while looking."""
        return self.odds > self.before and self.is_decided

    def with_look(self, station_mm: float, ratio: float) -> Change:
        """Return the odds after a look at a station that is `ratio` times as likely after the change."""
        before = self.before * ratio
        if math.isnan(self.looked_mm):
            return self._replace(before=before, looked_mm=station_mm)
        if station_mm < self.looked_mm + LOOK_MM:
            return self
        place_mm = 0.5 * (self.looked_mm + station_mm)
        variance_mm2 = (station_mm - self.looked_mm) ** 2 / 12.0
        odds = self.odds + 1.0
        if self.odds > 0.0:
            # Two mixed laws: their spreads, and how far their means lie apart.
            away_mm = place_mm - self.station_mm
            place_mm = self.station_mm + away_mm / odds
            variance_mm2 = (self.odds * (self.variance_mm2 + away_mm**2 / odds) + variance_mm2) / odds
        return Change(odds * ratio, before, place_mm, variance_mm2, station_mm)


class JointEnds(NamedTuple):
    """Estimate of the joint's ends by the frames so far."""

    start: Change = Change()
    end: Change = Change()

    def with_look(
        self, station_mm: float, is_found: bool, nominal_mm: tuple[float, float], within_mm: float
    ) -> JointEnds:
        """Return the ends after the sensor looked at a station and found the joint there or did not.

        Each end is searched within `within_mm` of its nominal station, and the end once the start is behind.
        """
        ratio = FOUND_SHARE / FALSE_SHARE if is_found else (1.0 - FOUND_SHARE) / (1.0 - FALSE_SHARE)
        from_start_mm, from_end_mm = station_mm - nominal_mm[0], station_mm - nominal_mm[1]
        if not self.start.is_decided and from_start_mm <= within_mm + DECIDE_MM:
            if from_start_mm >= -within_mm:
                return self._replace(start=self.start.with_look(station_mm, ratio))
        elif not self.end.is_decided and -within_mm <= from_end_mm <= within_mm + DECIDE_MM:
            return self._replace(end=self.end.with_look(station_mm, 1.0 / ratio))
        return self

    def stretch_mm(self, nominal_mm: tuple[float, float], within_mm: float) -> tuple[float, float]:
        """Return the stations between which there may be a joint: its ends where they were seen."""
        start_mm, end_mm = nominal_mm[0] - within_mm, nominal_mm[1] + within_mm
        return (
            self.start.station_mm if self.start.is_seen else start_mm,
            self.end.station_mm if self.end.is_seen else end_mm,
        )


def nominal_ends(segments: SeamSegments) -> tuple[float, float]:
    """Return the stations, mm, of the ends of a joint's nominal line; they count through all its bends."""
    (first, last), start = segments.frames[[0, -1]], segments.starts[0]
    end = segments.starts[-1] + segments.steps[-1]
    return float(transform(invert(first), start)[0]), float(transform(invert(last), end)[0])
