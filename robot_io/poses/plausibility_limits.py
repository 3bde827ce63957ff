"""Limits of poses, and the errors from the bus' rounding and the clocks' jitter.

The bus rounds a coordinate to steps q: an error that is uniform over q, of variance q^2 / 12. A sample whose
time is off by t is off its place by v t. Both are sub-Gaussian: E exp(u e) <= exp(u^2 sigma^2 / 2) (a
symmetric error with its own variance: Arbel, Marchal, Nguyen 2020, ESAIM: P&S 24, 39). So for a sum n of such
errors in three axes the chi-squared's Chernoff bound holds, P(|n|^2 > x sigma^2) <= (x/3)^(3/2) exp((3 - x) /
2), and what a test allows beyond a limit follows from the rate of false alarms, not from an assumed
distribution.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

from robot_io.stated_limit import check_limits, stated

MAY_BE_ZERO = ("time_jitter_s", "weave_along_mm", "settle_s")
"""The limits that may be 0; all others are above it."""


@dataclass(frozen=True)
class PlausibilityLimits:
    """Limits that poses must keep to; each field's metadata states `unit`, `role` and `source`.

    Raises ValueError for a limit that is not positive and finite.
    """

    speed_mm_s: float = stated(
        250.0, "mm/s", "largest speed of the tool, weave included", "ISO 10218-1's reduced speed"
    )
    acceleration_mm_s2: float = stated(
        5000.0, "mm/s^2", "largest acceleration", "chosen: a weave of 3 mm at 6 Hz; state the robot's own"
    )
    rotation_deg_s: float = stated(
        180.0, "deg/s", "largest rate of turning", "chosen: half a turn a second; state the robot's own"
    )
    false_alarm: float = stated(
        1e-9,
        "",
        "rate of false alarms of a question, for each sample",
        "chosen: one in 100 days at 100 poses a second",
    )
    position_step_mm: float = stated(0.025, "mm", "the bus' step of a coordinate", "as arctrack.dbc states")
    quaternion_step: float = stated(
        4.32e-5, "", "the bus' step of a quaternion's component", "as arctrack.dbc states"
    )
    time_jitter_s: float = stated(
        0.0005,
        "s",
        "1 sigma of a sample's time",
        "rounding to 1 ms makes 0.29 ms, the wait for the bus the rest",
    )
    gap_s: float = stated(
        0.1, "s", "longest silence; after it poses have stopped", "stale after ten cycles, as all messages"
    )
    age_required: bool = stated(
        True, "", "whether a sample must say how old it is", "false only where the latency is calibrated"
    )
    settle_s: float = stated(
        0.3,
        "s",
        "longest time until the robot moves as it states",
        "chosen: delay of servo and status, and a ramp",
    )
    speed_change_share: float = stated(
        0.05, "", "share up to which a stated speed is the same as before", "chosen: a controller's ripple"
    )
    speed_change_mm_s: float = stated(
        0.1, "mm/s", "change up to which a stated speed is the same as before", "two of the bus' steps"
    )
    window_s: float = stated(1.0, "s", "longest time over which progress is asked for", "chosen")
    frozen_s: float = stated(
        0.1, "s", "least time that a moving robot's poses stand before they are frozen", "chosen: ten cycles"
    )
    speed_share: float = stated(
        0.5,
        "",
        "share by which the progress may be off the stated speed",
        "chosen: robots slow down at corners",
    )
    still_mm: float = stated(
        0.1, "mm", "farthest way while the robot says that it stands", "chosen: brakes and servos settle"
    )
    weave_along_mm: float = stated(
        0.0, "mm", "reach of a weave to and fro along the travel", "across the travel only"
    )
    lateral_mm: float = stated(
        15.0,
        "mm",
        "largest lateral distance of the tool from the nominal seam",
        "the largest offset, and a weave",
    )
    below_mm: float = stated(
        15.0, "mm", "largest distance below the nominal seam", "the largest offset, and a weave"
    )
    above_mm: float = stated(
        30.0, "mm", "largest distance above the nominal seam", "the stand-off that the sensor's range leaves"
    )
    ends_mm: float = stated(
        50.0, "mm", "largest distance before the seam's start and past its end", "chosen: run-in and run-out"
    )
    travel_deg: float = stated(
        45.0,
        "deg",
        "largest angle of the tool's x off the travel",
        "chosen: the sensor must look at the seam ahead",
    )
    tilt_deg: float = stated(
        60.0, "deg", "largest angle of the tool's z off the surface's normal", "chosen, as off the travel"
    )
    programmed_mm: float = stated(
        15.0, "mm", "largest distance off the programmed pose", "the largest offset, and a weave"
    )
    programmed_deg: float = stated(
        5.0, "deg", "largest turn against the programmed pose", "offsets turn nothing"
    )
    programmed_age_s: float = stated(
        0.1, "s", "longest time between the two poses that are compared", "ten cycles"
    )
    follow_s: float = stated(0.2, "s", "lag of the robot behind its program", "chosen")
    prove_s: float = stated(
        0.3, "s", "time for which poses must be plausible before they are trusted", "chosen: thirty cycles"
    )
    rejoin_mm: float = stated(
        2.0,
        "mm",
        "after a doubt, farthest way off the place before it",
        "chosen: the offset goes on for a while",
    )
    rejoin_deg: float = stated(
        10.0, "deg", "after a doubt, largest turn since then", "chosen: a turn on a curve"
    )
    rejoin_late_s: float = stated(
        0.05, "s", "after a doubt, farthest lag along the travel", "chosen: half of 100 ms"
    )
    rejoin_share: float = stated(
        0.05, "", "share of the way since then by which the stated travel speed may mislead", "chosen"
    )

    def __post_init__(self) -> None:
        check_limits(self, "plausibility limit", MAY_BE_ZERO)
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
        """Largest length of an error in three axes, in sigmas of one."""
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
