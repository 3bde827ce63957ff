"""Test of innovations: whether the seam moves as pose and seam line predict.

In base a seam stands still. So each measurement must be where those before it put the seam, within its sigma
and what a seam may bend on the way: the innovation nu of a Kalman filter along the stations, with the process
of `gaussian_process`. With a right pose nu^2 / S is chi-squared with one degree of freedom for each axis,
white over frames (Bar-Shalom, Li, Kirubarajan 2001, Estimation with Applications, section 5.4.2). A pose that
is late by t adds v t for a weave of velocity v, a mirrored one twice the weave, a drifting one its slope.
Their sum over a window is compared with a quantile at a stated rate of false alarms.

A single innovation is capped at a few sigmas: a tack or a bad frame is not a wrong pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import lru_cache

from scipy.special import gammainccinv

from robot_io.poses.nominal_path import Vector
from robot_io.stated_limit import check_limits
from tracker.seam.gaussian_process import BEND_LENGTH_MM, BEND_SIGMA_MM, MODEL_SIGMA_MM, WIDE_SIGMA_MM

DECAY = math.sqrt(3.0) / BEND_LENGTH_MM
VALUE_MM2, SLOPE_MM2 = BEND_SIGMA_MM**2, (DECAY * BEND_SIGMA_MM) ** 2


class SeamMotion(Enum):
    """Agreement of the seam's motion in the image with the poses."""

    UNPROVEN = "too few measurements yet"
    CONSISTENT = "as pose and seam line predict"
    CONTRADICTED = "the seam moves otherwise than the poses say"


@dataclass(frozen=True)
class InnovationLimits:
    """Limits of the innovation test; raises ValueError for one that is not positive and finite.

    - `window`: number of measurements tested together (chosen: 0.4 s of 50 frames a second).
    - `false_alarm`: probability that a window of right poses fails (chosen: at 50 frames a second once in
      some days of weld, were windows disjoint; each shares 19 of 20 with the next).
    - `sigma_floor_mm`: smallest sigma of a measurement (speckle that neighbouring frames share).
    - `max_sigmas`: cap of a single innovation (chosen: one bad frame alone cannot fail it).
    - `gap_mm`: a station this far off the last restarts the test (chosen: a third of the length over which
      seams bend).
    - `pose_time_s`: 1 sigma of a pose's time against its frame's (the age's rounding to 1 ms, and a wait for
      the bus of up to some frames of 0.25 ms, common to many frames).
    """

    window: int = 20
    false_alarm: float = 1e-6
    sigma_floor_mm: float = 0.03
    max_sigmas: float = 4.0
    gap_mm: float = 20.0
    pose_time_s: float = 0.001

    def __post_init__(self) -> None:
        check_limits(self, "innovation limit")

    @property
    def chi2(self) -> float:
        """The largest sum over a window of two axes."""
        return _chi2_quantile(2 * self.window, self.false_alarm)


@dataclass(frozen=True)
class SeamMeasurement:
    """Measured seam at a station along the nominal line.

    `displacement_mm` is (y, z) from that line, joint frame, with the pose at the capture; `sigma_mm` is 1
    sigma of each, of the image alone. `axes_base` are the directions of y and z there, `lever_mm` is the
    seam's distance from the tool's origin.
    """

    station_mm: float
    displacement_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    axes_base: tuple[Vector, Vector] = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    lever_mm: float = 0.0

    def at_speed(self, speed_mm_s: float, turn_rad_s: float, limits: InnovationLimits) -> SeamMeasurement:
        """Return it with the sigma of a moving tool, when the pose's time is uncertain by the limits.

        With a tool that weaves at v, a pose that is off by t displaces the seam by v t; with one that turns
        at w by w t times the lever.
        """
        spread_mm = limits.pose_time_s * (speed_mm_s + turn_rad_s * self.lever_mm)
        y_mm, z_mm = self.sigma_mm
        return replace(self, sigma_mm=(math.hypot(y_mm, spread_mm), math.hypot(z_mm, spread_mm)))


@dataclass(frozen=True)
class _SeamAxis:
    """Bend, its slope and the whole seam's displacement, and the upper triangle of their covariance."""

    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    covariance: tuple[float, float, float, float, float, float] = (
        VALUE_MM2,
        0.0,
        0.0,
        SLOPE_MM2,
        0.0,
        WIDE_SIGMA_MM**2,
    )

    @property
    def displacement_mm(self) -> float:
        """The seam's displacement, mm."""
        return self.mean[0] + self.mean[2]

    @property
    def variance_mm2(self) -> float:
        """Its variance, mm^2."""
        p00, _, p02, _, _, p22 = self.covariance
        return p00 + 2.0 * p02 + p22

    def moved(self, distance_mm: float) -> _SeamAxis:
        """Return the prediction for a station further on."""
        fade = math.exp(-DECAY * distance_mm)
        a, b = fade * (1.0 + DECAY * distance_mm), fade * distance_mm
        c, d = -(DECAY**2) * fade * distance_mm, fade * (1.0 - DECAY * distance_mm)
        bend, slope, whole = self.mean
        p00, p01, p02, p11, p12, p22 = self.covariance
        # What the process gains is what the step takes from its stationary variance.
        q00 = VALUE_MM2 - a * a * VALUE_MM2 - b * b * SLOPE_MM2
        q11 = SLOPE_MM2 - c * c * VALUE_MM2 - d * d * SLOPE_MM2
        q01 = -(a * c * VALUE_MM2 + b * d * SLOPE_MM2)
        return _SeamAxis(
            (a * bend + b * slope, c * bend + d * slope, whole),
            (
                a * a * p00 + 2.0 * a * b * p01 + b * b * p11 + q00,
                a * c * p00 + (a * d + b * c) * p01 + b * d * p11 + q01,
                a * p02 + b * p12,
                c * c * p00 + 2.0 * c * d * p01 + d * d * p11 + q11,
                c * p02 + d * p12,
                p22,
            ),
        )

    def turned(self, turn_rad: float) -> _SeamAxis:
        """Return the prediction along an axis that has turned: what the part is displaced along it is new."""
        p00, p01, p02, p11, p12, p22 = self.covariance
        return _SeamAxis(self.mean, (p00 + (WIDE_SIGMA_MM * turn_rad) ** 2, p01, p02, p11, p12, p22))

    def measured(
        self, displacement_mm: float, variance_mm2: float, max_sigmas: float = math.inf
    ) -> tuple[_SeamAxis, float]:
        """Return the estimate after a measurement, and its innovation over its sigma, both cut (Huber)."""
        p00, p01, p02, p11, p12, p22 = self.covariance
        g0, g1, g2 = p00 + p02, p01 + p12, p02 + p22
        spread = g0 + g2 + variance_mm2
        sigma_mm = math.sqrt(spread)
        innovation = (displacement_mm - self.mean[0] - self.mean[2]) / sigma_mm
        innovation = math.copysign(min(abs(innovation), max_sigmas), innovation)
        share = innovation / sigma_mm
        mean = (self.mean[0] + g0 * share, self.mean[1] + g1 * share, self.mean[2] + g2 * share)
        covariance = (
            p00 - g0 * g0 / spread,
            p01 - g0 * g1 / spread,
            p02 - g0 * g2 / spread,
            p11 - g1 * g1 / spread,
            p12 - g1 * g2 / spread,
            p22 - g2 * g2 / spread,
        )
        return _SeamAxis(mean, covariance), innovation


@dataclass(frozen=True)
class _SeamKnowledge:
    """Estimate of the seam at a station."""

    station_mm: float
    axes: tuple[_SeamAxis, _SeamAxis]
    axes_base: tuple[Vector, Vector]

    def moved(self, station_mm: float, axes_base: tuple[Vector, Vector]) -> tuple[_SeamAxis, _SeamAxis]:
        """Return the prediction for another station, with the directions of y and z there."""
        step_mm = station_mm - self.station_mm
        y, z = (
            axis.turned(math.dist(there, here))
            for axis, here, there in zip(self.axes, self.axes_base, axes_base, strict=True)
        )
        if step_mm >= 0.0:
            return y.moved(step_mm), z.moved(step_mm)
        # Backwards the same law holds: of a seam that runs the other way the slope changes its sign.
        return _mirrored(_mirrored(y).moved(-step_mm)), _mirrored(_mirrored(z).moved(-step_mm))

    def agrees(self, other: _SeamKnowledge, limits: InnovationLimits) -> bool:
        """Return True if two estimates without a common measurement may be of one seam."""
        chi2 = 0.0
        for here, there in zip(self.axes, other.moved(self.station_mm, self.axes_base), strict=True):
            variance_mm2 = here.variance_mm2 + there.variance_mm2
            chi2 += (here.displacement_mm - there.displacement_mm) ** 2 / variance_mm2
        return chi2 <= _chi2_quantile(2, limits.false_alarm)


@dataclass(frozen=True)
class SeamInnovation:
    """State of the innovation test.

    `innovations` are the window's over their sigmas, as pairs (y, z). `motion` says whether the seam moves as
    the poses say. Once contradicted it stays so until a whole window that began after that fits, with the
    seam where the measurements before the contradiction put it.
    """

    motion: SeamMotion = SeamMotion.UNPROVEN
    known: _SeamKnowledge | None = None
    innovations: tuple[tuple[float, float], ...] = field(default=(), repr=False)
    past: tuple[_SeamKnowledge, ...] = field(default=(), repr=False)
    reference: _SeamKnowledge | None = field(default=None, repr=False)

    @property
    def chi2(self) -> float:
        """The sum of the window's squared innovations over their variances."""
        return math.fsum(y * y + z * z for y, z in self.innovations)

    def with_seam(self, seam: SeamMeasurement, limits: InnovationLimits) -> SeamInnovation:
        """Return the state after one more measurement; values that are not finite are ignored."""
        if not all(map(math.isfinite, (seam.station_mm, *seam.displacement_mm, *seam.sigma_mm))):
            return self
        if self.known is None or not abs(seam.station_mm - self.known.station_mm) <= limits.gap_mm:
            return replace(self, known=_begun(seam, limits), innovations=(), past=())
        axes, innovations = [], []
        there = self.known.moved(seam.station_mm, seam.axes_base)
        for axis, displacement_mm, sigma_mm in zip(there, seam.displacement_mm, seam.sigma_mm, strict=True):
            known, innovation = axis.measured(
                displacement_mm, _variance_mm2(sigma_mm, limits), limits.max_sigmas
            )
            axes.append(known)
            innovations.append(innovation)
        window = (*self.innovations, (innovations[0], innovations[1]))[-limits.window :]
        state = replace(
            self,
            known=_SeamKnowledge(seam.station_mm, (axes[0], axes[1]), seam.axes_base),
            innovations=window,
            past=(*self.past, self.known)[-limits.window :],
        )
        if state.chi2 > limits.chi2:
            # What the window took in is doubted with it: the seam is where it was before.
            before = self.reference
            if self.motion is SeamMotion.CONSISTENT:
                before = state.past[0]
            return SeamInnovation(SeamMotion.CONTRADICTED, _begun(seam, limits), reference=before)
        if len(window) < limits.window:
            return state
        assert state.known is not None
        if state.reference is not None and not state.known.agrees(state.reference, limits):
            return state
        return replace(state, motion=SeamMotion.CONSISTENT, reference=None)


def _begun(seam: SeamMeasurement, limits: InnovationLimits) -> _SeamKnowledge:
    """Return the estimate after a first measurement, of which the wide prior makes no innovation."""
    y, z = (
        _SeamAxis().measured(displacement_mm, _variance_mm2(sigma_mm, limits))[0]
        for displacement_mm, sigma_mm in zip(seam.displacement_mm, seam.sigma_mm, strict=True)
    )
    return _SeamKnowledge(seam.station_mm, (y, z), seam.axes_base)


def _mirrored(axis: _SeamAxis) -> _SeamAxis:
    bend, slope, whole = axis.mean
    p00, p01, p02, p11, p12, p22 = axis.covariance
    return _SeamAxis((bend, -slope, whole), (p00, -p01, p02, p11, -p12, p22))


def _variance_mm2(sigma_mm: float, limits: InnovationLimits) -> float:
    return max(sigma_mm, limits.sigma_floor_mm) ** 2 + MODEL_SIGMA_MM**2


@lru_cache
def _chi2_quantile(degrees: int, false_alarm: float) -> float:
    return 2.0 * float(gammainccinv(0.5 * degrees, false_alarm))
