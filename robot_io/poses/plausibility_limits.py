"""What poses must keep to, and how far the bus' rounding and the clocks' jitter reach.

The bus rounds a coordinate to steps q: an error that is even over q, of variance q^2 / 12. A sample whose
time is off by t is off its place by v t. Both are sub-Gaussian: E exp(u e) <= exp(u^2 sigma^2 / 2) (an even
error with its own variance: Arbel, Marchal, Nguyen 2020, ESAIM: P&S 24, 39). So for a sum n of such errors in
three axes the chi-squared's Chernoff bound holds, P(|n|^2 > x sigma^2) <= (x/3)^(3/2) exp((3 - x) / 2), and
what a question allows beyond a limit follows from the rate of false alarms, not from a law that is assumed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache

MAY_BE_ZERO = ("time_jitter_s", "weave_along_mm", "settle_s")
"""The limits that may be 0; all others are above it."""


@dataclass(frozen=True)
class PlausibilityLimits:
    """What poses must keep to. Each limit's source stands in brackets.

    Parameters
    ----------
    speed_mm_s : float
        The largest speed of the tool, mm/s, weave included (ISO 10218-1's reduced speed: nothing is corrected
        in an air move).
    acceleration_mm_s2 : float
        The largest acceleration, mm/s^2 (chosen: a weave of 3 mm at 6 Hz stays below; state the robot's own).
    rotation_deg_s : float
        The largest rate of turning, degrees/s (chosen: half a turn a second; state the robot's own).
    false_alarm : float
        The probability that a question takes rounding and jitter for a fault, for each sample (chosen: at 100
        poses a second one in some 100 days).
    position_step_mm : float
        The bus' step of a coordinate, mm (arctrack.dbc).
    quaternion_step : float
        The bus' step of a quaternion's component (arctrack.dbc).
    time_jitter_s : float
        1 sigma of a sample's time, s (the age is rounded to 1 ms, which alone is 0.29 ms; the rest is the
        wait for the bus).
    gap_s : float
        After a longer silence poses have stopped, s (stale after ten cycles, as all messages).
    age_required : bool
        Whether a sample must say how old it is. False only where the latency has been calibrated.
    settle_s : float
        How long after a change of its stated motion the robot may take to move so, s (chosen: delay of servo
        and status, and a ramp from 0 to some 10 mm/s).
    speed_change_share, speed_change_mm_s : float
        Up to which share, or to how many mm/s, a stated speed is the same as before (chosen: a controller's
        ripple; two of the bus' steps).
    window_s : float
        Over how long progress is asked for at most, s (chosen).
    frozen_s : float
        How long a moving robot's poses may stand at least before they are frozen, s (chosen: ten cycles).
    speed_share : float
        By which share of the stated travel speed the progress along the path may be off (chosen: robots slow
        down at corners).
    still_mm : float
        How far the tool may go while the robot says that it stands, mm (chosen: brakes and servos settle).
    weave_along_mm : float
        How far a weave goes to and fro along the travel, mm (0: across the travel only).
    lateral_mm, below_mm, above_mm : float
        How far the tool may be beside, below and above the nominal seam, mm (the largest offset, and a weave;
        the stand-off that the sensor's range leaves).
    ends_mm : float
        How far it may be before the seam's start and past its end, mm (chosen: run-in and run-out).
    travel_deg, tilt_deg : float
        The largest angle of the tool's x off the travel, and of its z off the surface's normal, degrees
        (chosen: beyond, the sensor does not look at the seam ahead).
    programmed_mm : float
        How far the tool may be off the programmed pose, mm (the largest offset, and a weave).
    programmed_deg : float
        How far it may be turned against the programmed pose, degrees (offsets turn nothing).
    programmed_age_s : float
        How far apart in time the two may be to be compared, s (ten cycles).
    follow_s : float
        By how much the robot lags behind its program, s (chosen).
    prove_s : float
        How long poses must be plausible before they are trusted, s (chosen: thirty cycles).
    rejoin_mm, rejoin_deg : float
        After a doubt, how far the tool may be beyond where it was beside the path in the window before, mm,
        and how far turned, degrees (chosen: the offset goes on for a while, and a turn on a curve).
    rejoin_late_s : float
        How far it may be behind along the travel then, s (chosen: half of 100 ms).
    rejoin_share : float
        By which share of the way since then the stated travel speed may mislead (chosen).

    Raises
    ------
    ValueError
        For a limit that is not positive and finite.
    """

    speed_mm_s: float = 250.0
    acceleration_mm_s2: float = 5000.0
    rotation_deg_s: float = 180.0
    false_alarm: float = 1e-9
    position_step_mm: float = 0.025
    quaternion_step: float = 4.32e-5
    time_jitter_s: float = 0.0005
    gap_s: float = 0.1
    age_required: bool = True
    settle_s: float = 0.3
    speed_change_share: float = 0.05
    speed_change_mm_s: float = 0.1
    window_s: float = 1.0
    frozen_s: float = 0.1
    speed_share: float = 0.5
    still_mm: float = 0.1
    weave_along_mm: float = 0.0
    lateral_mm: float = 15.0
    below_mm: float = 15.0
    above_mm: float = 30.0
    ends_mm: float = 50.0
    travel_deg: float = 45.0
    tilt_deg: float = 60.0
    programmed_mm: float = 15.0
    programmed_deg: float = 5.0
    programmed_age_s: float = 0.1
    follow_s: float = 0.2
    prove_s: float = 0.3
    rejoin_mm: float = 2.0
    rejoin_deg: float = 10.0
    rejoin_late_s: float = 0.05
    rejoin_share: float = 0.05

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.name != "age_required"):
            value = getattr(self, name)
            is_low = value < 0.0 if name in MAY_BE_ZERO else not value > 0.0
            if is_low or not math.isfinite(value):
                raise ValueError(f"plausibility limit {name}: is {value}; it must be positive and finite")
        for name in ("false_alarm", "speed_share"):
            if not getattr(self, name) < 1.0:
                raise ValueError(f"plausibility limit {name}: is {getattr(self, name)}; it must be below 1")

    def position_sigma_mm(self, speed_mm_s: float) -> float:
        """Return 1 sigma of a coordinate, mm, of a tool at a speed, mm/s."""
        return math.hypot(self.position_step_mm / math.sqrt(12.0), speed_mm_s * self.time_jitter_s)

    def rotation_sigma_rad(self, rate_rad_s: float) -> float:
        """Return 1 sigma of a turn about each axis, rad, of a tool that turns at a rate, rad/s.

        A turn is twice the change of the quaternion's vector. The component that the bus leaves out is at
        least 1/2: its own error, which follows from those of the others, at most doubles theirs.
        """
        return math.hypot(4.0 * self.quaternion_step / math.sqrt(12.0), rate_rad_s * self.time_jitter_s)

    @property
    def sigmas(self) -> float:
        """How many sigmas of one axis the length of an error in three may reach."""
        return noise_sigmas(self.false_alarm)


@lru_cache
def noise_sigmas(false_alarm: float) -> float:
    """Return the x^(1/2) > 3^(1/2) at which the chi-squared's Chernoff bound is a rate of false alarms."""
    log_rate = math.log(false_alarm)
    x = 3.0 - 2.0 * log_rate
    # x = 3 - 2 ln(rate) + 3 ln(x / 3), whose right side rises by less than x does.
    for _ in range(60):
        x = 3.0 - 2.0 * log_rate + 3.0 * math.log(x / 3.0)
    return math.sqrt(x)
