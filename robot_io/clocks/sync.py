"""Offset of the robot's clock from the tracker's, from SYNC and its echo, without the bias of arrival times.

The robot sends its time t1; the tracker reads it at t2 on its own clock, and answers; the robot states how
long the exchange was on the bus, r = (t4 - t1) - (t3 - t2): the four times of NTP (RFC 5905, section 8) and
of PTP's delay request. The offset o = t2 - t1 less the transit time is sought. No transit takes less than no
time, so each exchange holds it between hard bounds, t2 - t1 - r <= o <= t2 - t1, whatever queues.

Clocks drift: o is a line over the robot's time, with a skew of some 10 ppm. All lines between all bounds make
a polygon of offset and skew (Moon, Skelly, Towsley 1999, INFOCOM, 227, for one way). Its ends at the present
are exact solutions of a linear programme in two unknowns: the skew of a feasible line is bounded by pairs of
exchanges, and the offset at the latest time grows with the skew. No average is taken, so no queue biases it;
only the split of the least delays between both ways is undetermined.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import numpy.typing as npt

from robot_io.described_enum import described
from robot_io.protocol.messages import RobotSync
from robot_io.stated_limit import check_limits

Float64 = npt.NDArray[np.float64]

TIME_BITS, SEQUENCE_BITS = 28, 8
"""Bits after which the robot's time and the sequence number wrap (arctrack.dbc)."""


@described
class Unestimated(Enum):
    """Reason for which there is no offset."""

    TOO_FEW = "too few exchanges with a round trip"
    STALE = "no exchange for too long"
    TOO_WIDE = "the bounds are too far apart"


@dataclass(frozen=True)
class SyncLimits:
    """Limits of the clock estimate; raises ValueError for one that is not positive and finite.

    - `window_s`: span of the exchanges used (chosen: over it a quartz's skew is steady to 1 ppm).
    - `skew`: largest skew between the two clocks (100 ppm: two quartzes of 50 ppm each).
    - `resolution_s`: error of a bound (arctrack.dbc's microsecond in each of three times, and the skew over
      an echo's delay).
    - `min_exchanges`: exchanges with a round trip that are needed (chosen).
    - `stale_s`: largest age of the newest exchange (chosen: ten cycles).
    - `width_s`: largest distance of the bounds (chosen: at 10 mm/s that is 0.05 mm of travel).
    """

    window_s: float = 30.0
    skew: float = 100e-6
    resolution_s: float = 5e-6
    min_exchanges: int = 5
    stale_s: float = 1.0
    width_s: float = 0.005

    def __post_init__(self) -> None:
        check_limits(self, "sync limit")


@dataclass(frozen=True)
class Exchange:
    """One SYNC that arrived.

    `robot_s` is its sending on the robot's clock, `arrived_s` its reading on the tracker's; `round_trip_s` is
    the time that it and its echo were on the bus, NaN if unknown.
    """

    robot_s: float
    arrived_s: float
    round_trip_s: float = math.nan


@dataclass(frozen=True)
class ClockOffset:
    """The tracker's clock less the robot's, at one time; all NaN where it is unestimated.

    `offset_s` is the middle of the certain bounds `lower_s` and `upper_s`; `sigma_s` is its 1 sigma if every
    split of the least delays between both ways is equally probable. `skew` (2,) bounds the tracker's rate
    over the robot's less 1. `unestimated` says why there is none.
    """

    offset_s: float = math.nan
    lower_s: float = math.nan
    upper_s: float = math.nan
    sigma_s: float = math.nan
    skew: tuple[float, float] = (math.nan, math.nan)
    unestimated: Unestimated | None = None


@dataclass(frozen=True)
class ClockSync:
    """State of the clock comparison; a new one knows nothing.

    `exchanges` are those of the last seconds, none from before a clock was set. `last_sequence` and
    `last_time_us` are of the newest RobotSync, whose time wraps; `robot_s` is unwrapped from the first one
    on. `steps` counts how often a clock was set.
    """

    exchanges: tuple[Exchange, ...] = ()
    last_sequence: int | None = None
    last_time_us: int = 0
    robot_s: float = 0.0
    steps: int = 0

    def on_sync(self, sync: RobotSync, arrived_s: float, limits: SyncLimits) -> "ClockSync":
        """Return the state after a RobotSync that was read at `arrived_s`, tracker's clock.

        Its round trip is that of the message before it.
        """
        exchanges = self.exchanges
        follows = self.last_sequence is not None and (
            (sync.sequence - self.last_sequence) % 2**SEQUENCE_BITS == 1
        )
        if follows and exchanges and sync.last_round_trip_us is not None:
            before = replace(exchanges[-1], round_trip_s=sync.last_round_trip_us * 1e-6)
            exchanges = (*exchanges[:-1], before)
        elapsed_us = (sync.robot_time_us - self.last_time_us) % 2**TIME_BITS
        state = replace(
            self,
            exchanges=exchanges,
            last_sequence=sync.sequence,
            last_time_us=sync.robot_time_us,
            robot_s=self.robot_s + elapsed_us * 1e-6,
        )
        return state.exchanged(Exchange(state.robot_s, arrived_s), limits)

    def exchanged(self, exchange: Exchange, limits: SyncLimits) -> "ClockSync":
        """Return the state with one more exchange.

        Where it contradicts those before, a clock was set, and the state holds this one alone.
        """
        kept = tuple(e for e in self.exchanges if 0.0 < exchange.robot_s - e.robot_s <= limits.window_s)
        exchanges = (*kept, exchange)
        if kept and _polygon(exchanges, limits) is None:
            return replace(self, exchanges=(exchange,), steps=self.steps + 1)
        return replace(self, exchanges=exchanges)

    def offset(self, now_s: float, limits: SyncLimits) -> ClockOffset:
        """Return the tracker's clock less the robot's at the newest exchange, or why it is not known.

        The time `now_s` is by the tracker's clock.
        """
        answered = sum(math.isfinite(e.round_trip_s) for e in self.exchanges)
        if answered < limits.min_exchanges:
            return ClockOffset(unestimated=Unestimated.TOO_FEW)
        if not abs(now_s - self.exchanges[-1].arrived_s) <= limits.stale_s:
            return ClockOffset(unestimated=Unestimated.STALE)
        polygon = _polygon(self.exchanges, limits)
        assert polygon is not None
        if polygon.upper_s - polygon.lower_s > limits.width_s:
            return ClockOffset(unestimated=Unestimated.TOO_WIDE)
        return ClockOffset(
            offset_s=0.5 * (polygon.lower_s + polygon.upper_s),
            lower_s=polygon.lower_s,
            upper_s=polygon.upper_s,
            sigma_s=(polygon.upper_s - polygon.lower_s) / math.sqrt(12.0),
            skew=polygon.skew,
        )

    def delay_s(self, now_s: float, limits: SyncLimits) -> tuple[float, float]:
        """Return bounds of the newest SYNC's transit time, s; NaN where the offset is unestimated.

        `now_s` is on the tracker's clock.
        """
        offset = self.offset(now_s, limits)
        if offset.unestimated is not None:
            return (math.nan, math.nan)
        newest = self.exchanges[-1]
        apart_s = newest.arrived_s - newest.robot_s
        return (max(0.0, apart_s - offset.upper_s), apart_s - offset.lower_s)


@dataclass(frozen=True)
class _Polygon:
    lower_s: float
    upper_s: float
    skew: tuple[float, float]


def _polygon(exchanges: tuple[Exchange, ...], limits: SyncLimits) -> _Polygon | None:
    """Return the ends of all feasible lines at the newest exchange, None if there is no such line.

    Between the bounds l_j and u_i a line of skew b fits where u_i - l_j >= b (x_i - x_j) for all pairs. At
    the latest time, x = 0 here, its offset is at most the least u_i - b x_i, and at least the largest
    l_j - b x_j: both rise with b.
    """
    rows = np.array([(e.robot_s, e.arrived_s, e.round_trip_s) for e in exchanges])
    x = rows[:, 0] - rows[-1, 0]
    # Not to lose microseconds of a large offset.
    apart = (rows[:, 1] - rows[-1, 1]) - x
    upper = apart + limits.resolution_s
    lower = np.where(np.isnan(rows[:, 2]), -np.inf, apart - rows[:, 2] - limits.resolution_s)
    dx = x[:, None] - x[None, :]
    room = upper[:, None] - lower[None, :]
    if (np.diagonal(room) < 0.0).any():
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = room / dx
    low = max(-limits.skew, float(np.max(slope, where=dx < 0.0, initial=-np.inf)))
    high = min(limits.skew, float(np.min(slope, where=dx > 0.0, initial=np.inf)))
    if low > high:
        return None
    base_s = rows[-1, 1] - rows[-1, 0]
    return _Polygon(
        base_s + float(np.max(lower - low * x)), base_s + float(np.min(upper - high * x)), (low, high)
    )
