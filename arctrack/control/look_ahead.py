"""Look-ahead of the torch, from the robot's lag behind its offsets, estimated while it welds.

An offset that is right at its capture acts a lag L later, v L farther along the seam, so it is computed for
there. L is that of `robot_io.clocks.lag`, from the offsets at their captures' times and the tool's lateral
motion relative to the path; the weave, which is in the latter alone, is removed at its own frequency. An
offset is held until the next one: on average it acts half a frame period later still.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from itertools import cycle
from typing import Protocol

import numpy as np
from scipy.optimize import minimize_scalar

from arctrack.control.policy import LookAheadPolicy
from noise_model.compiled.arrays import Float64
from robot_io import BusMessage, Command, PoseSample, SeamOffset, TrackerCommand, Validity
from robot_io.clocks.lag import Lag, LagLimits, LagUnestimated, Motion, estimate_lag
from robot_io.poses.nominal_path import NominalPath
from tracker.state import AT_ONCE, OffsetLookAhead

NOTHING_YET = Lag(unestimated=LagUnestimated.TOO_FEW)


@dataclass(frozen=True)
class _Place:
    time_s: float
    station_mm: float
    lateral_mm: float


@dataclass(frozen=True)
class Motions:
    """Commanded offsets, and the tool's measured motion relative to its path."""

    commanded: Motion
    seen: Motion


class LagEstimator(Protocol):
    """Estimator of lags, blocking or not."""

    def ask(self, motions: Motions) -> None:
        """Request an estimate from motions; an unanswered earlier request comes first."""

    def answer(self) -> Lag | None:
        """Return the requested estimate, None while there is none; each is returned once."""


class LagNow:
    """Lag estimator that blocks until its estimate is there."""

    _lag: Lag | None = None

    def ask(self, motions: Motions) -> None:
        """Estimate the lag."""
        self._lag = lag_of(motions, LookAheadPolicy(), LagLimits())

    def answer(self) -> Lag | None:
        """Return the estimate."""
        lag, self._lag = self._lag, None
        return lag


@dataclass
class LookAhead:
    """Commanded and executed motion, with the robot's lag estimated from it now and then.

    All times are on the tracker's clock. An estimate is kept until a better one comes, or one that differs:
    the lag is the robot's own, and what determines it, such as the soft start, soon is over. While there is
    none, `lag.unestimated` says why.
    """

    path: NominalPath
    policy: LookAheadPolicy = field(default_factory=LookAheadPolicy)
    limits: LagLimits = field(default_factory=LagLimits)
    estimator: LagEstimator = field(default_factory=LagNow)
    lag: Lag = NOTHING_YET

    def __post_init__(self) -> None:
        self._is_at_nought = False
        self._places: deque[_Place] = deque()
        self._commanded: deque[tuple[float, float]] = deque()
        self._estimated_s = -math.inf
        self._period_s = math.nan

    def hear(self, message: BusMessage) -> None:
        """Take what the robot commands: after DISARM it stands on its programmed path before it welds on."""
        if isinstance(message, TrackerCommand) and message.command is Command.DISARM:
            self._forget()
            self._is_at_nought = True

    def see(self, sample: PoseSample, is_trusted: bool) -> None:
        """Take where the tool was; of poses that are doubted, or whose age is unknown, nothing is kept."""
        place = self.path.place(sample.position_base_mm)
        last_s = self._places[-1].time_s if self._places else -math.inf
        if not is_trusted or math.isnan(sample.sample_age_s) or sample.timestamp_s <= last_s:
            self._forget()
            return
        self._places.append(_Place(sample.timestamp_s, place.station_mm, place.lateral_mm))
        oldest_s = sample.timestamp_s - self.policy.window_s
        while self._places[0].time_s < oldest_s:
            self._places.popleft()
        # What was commanded before still acts.
        while len(self._commanded) > 1 and self._commanded[1][0] < oldest_s - self.limits.longest_s:
            self._commanded.popleft()

    def sent(self, offset: SeamOffset, now_s: float) -> None:
        """Take an offset that went out at a time, s."""
        if offset.validity is Validity.REFUSED:
            if self._commanded:
                self._forget()
            return
        captured_s = now_s - offset.capture_age_ms / 1000.0
        if offset.validity is not Validity.VALID or math.isnan(offset.offset_y_mm):
            return
        if self._is_at_nought and not self._commanded:
            self._commanded.append((captured_s - 2.0 * self.limits.longest_s, 0.0))
            self._is_at_nought = False
        if not self._commanded or captured_s > self._commanded[-1][0]:
            self._commanded.append((captured_s, offset.offset_y_mm))

    def update(self, now_s: float) -> None:
        """Request a new estimate where it is time to, and take one that is there."""
        if not 0.0 <= now_s - self._estimated_s < self.policy.every_s:
            self._estimated_s = now_s
            self._ask()
        lag = self.estimator.answer()
        if lag is not None:
            self.keep_better(lag)

    def offset_look_ahead(self) -> OffsetLookAhead:
        """Return the look-ahead of offsets."""
        if self.lag.unestimated is not None or len(self._commanded) < 2:
            return AT_ONCE
        time_s = self.lag.lag_s + 0.5 * self._period_s
        return OffsetLookAhead(time_s, time_s * self._speed_mm_s())

    def keep_better(self, lag: Lag) -> None:
        """Keep the better of two estimates, the new one where they do not agree."""
        best_lag = self.lag
        if lag.unestimated is not None:
            if best_lag.unestimated is not None:
                self.lag = lag
            return
        apart = abs(lag.lag_s - best_lag.lag_s) > self.policy.differ_sigmas * math.hypot(
            lag.sigma_s, best_lag.sigma_s
        )
        if best_lag.unestimated is not None or lag.sigma_s <= best_lag.sigma_s or apart:
            self.lag = lag

    def _ask(self) -> None:
        if len(self._commanded) < 2 or len(self._places) < self.limits.min_samples:
            self.keep_better(NOTHING_YET)
            return
        sent_s, offsets_mm = np.array(self._commanded).T
        self._period_s = float(np.median(np.diff(sent_s)))
        seen = Motion(
            np.array([place.time_s for place in self._places]),
            np.array([place.lateral_mm for place in self._places]),
        )
        self.estimator.ask(Motions(Motion(sent_s, offsets_mm), seen))

    def _speed_mm_s(self) -> float:
        """Return the speed along the path over the last moment, 0 where the tool goes back or is not seen."""
        if not self._places:
            return 0.0
        first = last = self._places[-1]
        for place in reversed(self._places):
            if place.time_s < last.time_s - self.policy.speed_s:
                break
            first = place
        elapsed_s = last.time_s - first.time_s
        return max(last.station_mm - first.station_mm, 0.0) / elapsed_s if elapsed_s > 0.0 else 0.0

    def _forget(self) -> None:
        self._places.clear()
        self._commanded.clear()


def lag_of(motions: Motions, policy: LookAheadPolicy, limits: LagLimits) -> Lag:
    """Return the lag of the measured motion behind the commanded one, with a weave removed."""
    nuisances = _weave(motions.commanded, motions.seen, limits, policy)
    lag = estimate_lag(motions.commanded, motions.seen, limits, nuisances=nuisances)
    return replace(lag, sigma_s=math.hypot(lag.sigma_s, policy.timing_sigma_s))


def _weave(commanded: Motion, seen: Motion, limits: LagLimits, policy: LookAheadPolicy) -> Float64:
    """Return a drift, the weave's sines and cosines, and the derivative by its frequency (n, m).

    The rows are the times of the measured motion. The frequency is the one of least residual, in least
    squares together with the offsets: these at some lags at once, since the lag is not known yet.
    """
    times_s = seen.times_s - seen.times_s[0]
    length_s = max(float(times_s[-1]), 1.0)
    drift = times_s / length_s
    lags_s = np.linspace(0.0, limits.longest_s, policy.guessed_lags)
    guesses = [np.interp(seen.times_s - lag_s, commanded.times_s, commanded.values_mm) for lag_s in lags_s]
    basis = np.linalg.qr(np.column_stack([np.ones_like(drift), drift, *guesses]))[0]
    rest = seen.values_mm - basis @ (basis.T @ seen.values_mm)

    def waves(hz: float) -> Float64:
        phase = 2.0 * math.pi * hz * times_s
        return np.column_stack(
            [wave(n * phase) for n in range(1, policy.harmonics + 1) for wave in (np.sin, np.cos)]
        )

    def residual_sum(hz: float) -> float:
        columns = waves(hz)
        columns = columns - basis @ (basis.T @ columns)
        residuals = rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
        return float(residuals @ residuals)

    tried_hz = np.arange(*policy.weave_hz, 0.25 / length_s)
    power = np.abs(np.exp(-2.0j * math.pi * np.outer(tried_hz, times_s)) @ rest)
    coarse_hz = float(tried_hz[int(np.argmax(power))])
    within = (coarse_hz - 0.5 / length_s, coarse_hz + 0.5 / length_s)
    hz = float(minimize_scalar(residual_sum, bounds=within, method="bounded", options={"xatol": 1e-5}).x)
    columns = waves(hz)
    amplitudes = np.linalg.lstsq(np.column_stack([basis, columns]), seen.values_mm, rcond=None)[0]
    # By the frequency a sine's derivative is t times the cosine, a cosine's -t times the sine, and n as much.
    turned = np.column_stack(
        [
            sign * columns[:, n ^ 1] * (n // 2 + 1)
            for n, sign in zip(range(columns.shape[1]), cycle((1, -1)), strict=False)
        ]
    )
    unsure = times_s * (turned @ amplitudes[basis.shape[1] :])
    return np.column_stack([drift, columns, unsure])
