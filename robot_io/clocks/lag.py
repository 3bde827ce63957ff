"""Lag of the robot's motion behind its command, or of one measure of a motion behind another.

A commanded motion u(t) is followed with a dead time L and a first-order lag T: T dr/dt = u(t - L) - r. What
is measured is g r(t) + c and white noise. The lag is L + T, the delay of a ramp. Under that noise the largest
likelihood is the least sum of squares, and for a pure delay that is the peak of the correlation of both
motions in continuous time (Knapp and Carter 1976, IEEE Trans. ASSP 24, 320). So no grid of samples limits it:
u is held, or runs straight, between its own times, and the response to either is a closed form.

The sigma is the Cramer-Rao bound at the estimate, widened for the residuals' autocorrelation. Where the
motion does not determine the lag, there is none.
"""

import math
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from robot_io.described_enum import described
from robot_io.stated_limit import check_limits

Float64 = npt.NDArray[np.float64]

NO_TIME_CONSTANT_S = 1e-6
"""Time constant below which there is none."""


@described
class LagUnestimated(Enum):
    """Reason for which there is no lag."""

    TOO_FEW = "too few samples"
    TOO_STILL = "what was commanded does not show in what was seen"
    AT_BOUND = "the best lag lies at the end of what is searched"
    AMBIGUOUS = "another lag explains the motion as well"
    TOO_UNSURE = "the sigma is too large"


@dataclass(frozen=True)
class LagLimits:
    """Limits of an estimate.

    Parameters
    ----------
    longest_s : float
        The largest dead time, and the largest time constant, that are searched, s (chosen: twice what slow
        controllers take).
    step_s : float
        The step of the search's grid, s (chosen: well within the width of a peak).
    min_samples : int
        The least number of seen samples (chosen: some for each of the unknowns).
    gain_sigmas : float
        Least significance of the gain, sigmas (chosen).
    rival_chi2 : float
        Least excess of any other lag's chi2 (chosen: 5 sigmas).
    sigma_s : float
        The largest sigma, s (chosen: at 10 mm/s that is 0.2 mm).

    Raises
    ------
    ValueError
        For a limit that is not positive and finite.
    """

    longest_s: float = 0.6
    step_s: float = 0.01
    min_samples: int = 30
    gain_sigmas: float = 8.0
    rival_chi2: float = 25.0
    sigma_s: float = 0.02

    def __post_init__(self) -> None:
        check_limits(self, "lag limit")


@dataclass(frozen=True)
class Motion:
    """A motion in one coordinate.

    Parameters
    ----------
    times_s : array (n,)
        Times, s, rising.
    values_mm : array (n,)
        Where it was then, mm.

    Raises
    ------
    ValueError
        If the two differ in length, a value is not finite, or the times do not rise.
    """

    times_s: Float64
    values_mm: Float64

    def __post_init__(self) -> None:
        times_s, values_mm = self.times_s, self.values_mm
        if times_s.ndim != 1 or times_s.shape != values_mm.shape:
            raise ValueError("a motion needs a value for each of its times")
        if not (np.isfinite(times_s).all() and np.isfinite(values_mm).all()):
            raise ValueError("a motion with a value that is not finite: leave unknown ones out")
        if (np.diff(times_s) <= 0.0).any():
            raise ValueError("a motion's times must rise")


@dataclass(frozen=True)
class Lag:
    """The lag; NaN where it is unestimated.

    Attributes
    ----------
    lag_s : float
        Dead time plus time constant, s.
    sigma_s : float
        1 sigma of it, s.
    dead_time_s, time_constant_s : float
        The two, s; they are known less well than their sum.
    gain : float
        Ratio of the measured to the commanded motion.
    noise_mm : float
        1 sigma of the residuals, mm.
    unestimated : LagUnestimated or None
        Reason for which there is no lag.
    """

    lag_s: float = math.nan
    sigma_s: float = math.nan
    dead_time_s: float = math.nan
    time_constant_s: float = math.nan
    gain: float = math.nan
    noise_mm: float = math.nan
    unestimated: LagUnestimated | None = None


Between = Literal["held", "straight"]


def estimate_lag(
    commanded: Motion,
    seen: Motion,
    limits: LagLimits,
    between: Between = "held",
    first_order: bool = True,
    nuisances: Float64 | None = None,
) -> Lag:
    """Return the lag of a measured motion behind a commanded one.

    Parameters
    ----------
    commanded : Motion
        The command: offsets at the times of their sending, or poses at theirs.
    seen : Motion
        The measured motion, on the same clock.
    limits : LagLimits
        The estimate's limits.
    between : str
        Interpolation of the command between its times: "held", as offsets, or "straight", as poses.
    first_order : bool
        True to fit a time constant in addition to the dead time.
    nuisances : array (n, m), optional
        Further components of the measured motion, a column each, such as a weave's sine and cosine. A
        constant is always one.

    Returns
    -------
    Lag
        The lag and its sigma, or why there is none.
    """
    # Before the first command nothing is known of what was commanded, whatever the lag.
    is_known = (seen.times_s >= commanded.times_s[0] + limits.longest_s) if len(commanded.times_s) else None
    if is_known is None or np.count_nonzero(is_known) < limits.min_samples:
        return Lag(unestimated=LagUnestimated.TOO_FEW)
    columns = np.ones((len(seen.times_s), 1))
    if nuisances is not None:
        columns = np.column_stack([columns, nuisances])
    problem = _LagProblem(
        commanded, seen.times_s[is_known], seen.values_mm[is_known], columns[is_known], between, first_order
    )
    return _estimate(problem, limits)


@dataclass(frozen=True)
class _LagProblem:
    commanded: Motion
    times_s: Float64
    seen_mm: Float64
    columns: Float64
    between: Between
    first_order: bool
    knots: dict[float, Float64] = field(default_factory=dict)

    def response(self, dead_time_s: float, time_constant_s: float) -> Float64:
        # The search asks for the same time constants again and again.
        knots = self.knots.get(time_constant_s)
        if knots is None:
            knots = self.knots[time_constant_s] = _at_knots(self.commanded, time_constant_s, self.between)
        times_s = self.times_s - dead_time_s
        return _between_knots(self.commanded, knots, times_s, time_constant_s, self.between)

    @cached_property
    def _basis(self) -> Float64:
        U, s, _ = np.linalg.svd(self.columns, full_matrices=False)
        return np.asarray(U[:, s > s[0] * len(s) * np.finfo(float).eps])

    @cached_property
    def _seen_without_nuisances_mm(self) -> Float64:
        """Measured motion less what nuisances can explain of it."""
        return np.asarray(self.seen_mm - self._basis @ (self._basis.T @ self.seen_mm))

    def project(self, dead_time_s: float, time_constant_s: float) -> tuple[float, Float64]:
        """Return the best gain at a lag, and the residuals where the nuisances are the best as well."""
        response = self.response(dead_time_s, time_constant_s)
        without_nuisances = response - self._basis @ (self._basis.T @ response)
        power = float(without_nuisances @ without_nuisances)
        if power <= np.finfo(float).eps * float(response @ response):
            return 0.0, self._seen_without_nuisances_mm
        gain = float(without_nuisances @ self._seen_without_nuisances_mm) / power
        return gain, self._seen_without_nuisances_mm - gain * without_nuisances

    def linear(self, dead_time_s: float, time_constant_s: float) -> tuple[Float64, Float64]:
        """Return the best gain and nuisances at a lag, and the residuals."""
        A = np.column_stack([self.response(dead_time_s, time_constant_s), self.columns])
        best = np.asarray(np.linalg.lstsq(A, self.seen_mm, rcond=None)[0], np.float64)
        residuals: Float64 = self.seen_mm - A @ best
        return best, residuals

    def residuals(self, unknown: Float64) -> Float64:
        """Return the residuals where gain and nuisances are the best (variable projection)."""
        time_constant_s = float(unknown[1]) if self.first_order else 0.0
        return self.project(float(unknown[0]), time_constant_s)[1]

    def jacobian(self, dead_time_s: float, time_constant_s: float) -> Float64:
        """Return the derivatives of the model by dead time, time constant if sought, gain and nuisances."""
        best, _ = self.linear(dead_time_s, time_constant_s)
        step_s = 1e-4
        later = self.response(dead_time_s + step_s, time_constant_s)
        sooner = self.response(dead_time_s - step_s, time_constant_s)
        columns = [best[0] * (later - sooner) / (2.0 * step_s)]
        if self.first_order:
            low_s = max(time_constant_s - step_s, 0.0)
            high = self.response(dead_time_s, time_constant_s + step_s)
            low = self.response(dead_time_s, low_s)
            columns.append(best[0] * (high - low) / (time_constant_s + step_s - low_s))
        return np.column_stack([*columns, self.response(dead_time_s, time_constant_s), self.columns])


def _estimate(problem: _LagProblem, limits: LagLimits) -> Lag:
    starts = _grid(problem, limits)
    _, dead_s, constant_s = min(starts)
    bounds = ([0.0, 0.0], [limits.longest_s] * 2) if problem.first_order else ([0.0], [limits.longest_s])
    start = [dead_s, constant_s] if problem.first_order else [dead_s]
    fitted = least_squares(
        problem.residuals, np.clip(start, 1e-4, limits.longest_s - 1e-4), bounds=bounds, x_scale=0.02
    )
    dead_s = float(fitted.x[0])
    constant_s = float(fitted.x[1]) if problem.first_order else 0.0
    best, residuals = problem.linear(dead_s, constant_s)
    J = problem.jacobian(dead_s, constant_s)
    freedom = len(residuals) - J.shape[1]
    variance = float(residuals @ residuals) / freedom
    # Its rows times themselves are the covariance: no sum of variances comes out below 0, however near to
    # each other two columns are.
    inverse = np.linalg.pinv(J)
    noise = math.sqrt(variance * _autocorrelation_factor(residuals))
    n_lags = 2 if problem.first_order else 1
    gain_sigma = noise * float(np.linalg.norm(inverse[n_lags]))
    if not best[0] > limits.gain_sigmas * gain_sigma or np.ptp(J[:, n_lags]) == 0.0:
        return Lag(unestimated=LagUnestimated.TOO_STILL)
    if max(dead_s, constant_s) > limits.longest_s - limits.step_s:
        return Lag(unestimated=LagUnestimated.AT_BOUND)
    sigma_s = noise * float(np.linalg.norm(inverse[:n_lags].sum(axis=0)))
    lag_s = dead_s + constant_s
    if not sigma_s <= limits.sigma_s:
        return Lag(unestimated=LagUnestimated.TOO_UNSURE)
    rival = variance * _autocorrelation_factor(residuals) * limits.rival_chi2 + float(residuals @ residuals)
    apart_s = max(5.0 * sigma_s, 3.0 * limits.step_s)
    if any(t < rival and abs(d + c - lag_s) > apart_s for t, d, c in starts):
        return Lag(unestimated=LagUnestimated.AMBIGUOUS)
    return Lag(lag_s, sigma_s, dead_s, constant_s, float(best[0]), math.sqrt(variance))


def _grid(problem: _LagProblem, limits: LagLimits) -> list[tuple[float, float, float]]:
    """Return the sum of squares, dead time and time constant over a grid; a negative gain is none."""
    constants_s = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4) if problem.first_order else (0.0,)
    tried = []
    for dead_s in np.arange(0.0, limits.longest_s, limits.step_s).tolist():
        for constant_s in (c for c in constants_s if c <= limits.longest_s):
            gain, residuals = problem.project(dead_s, constant_s)
            total = float(residuals @ residuals) if gain > 0.0 else math.inf
            tried.append((total, dead_s, constant_s))
    return tried


def _autocorrelation_factor(residuals: Float64) -> float:
    """Return the variance inflation by the residuals' autocorrelation, an AR(1) process."""
    total = float(residuals @ residuals)
    share = float(residuals[1:] @ residuals[:-1]) / total if total > 0.0 else 0.0
    share = min(max(share, 0.0), 0.95)
    return (1.0 + share) / (1.0 - share)


def _slopes(motion: Motion, between: Between) -> Float64:
    slope = np.zeros(len(motion.times_s))
    if between == "straight":
        slope[:-1] = np.diff(motion.values_mm) / np.diff(motion.times_s)
    return slope


def _at_knots(motion: Motion, time_constant_s: float, between: Between) -> Float64:
    """Return the response at the motion's own times."""
    if time_constant_s < NO_TIME_CONSTANT_S:
        return motion.values_mm
    slope = _slopes(motion, between)
    lagging = slope * time_constant_s
    steps_s = np.diff(motion.times_s)
    fades = np.exp(-steps_s / time_constant_s).tolist()
    # What r would be without its past, and how far that is from what it comes from.
    straight = (motion.values_mm[:-1] + slope[:-1] * steps_s - lagging[:-1]).tolist()
    begins = (motion.values_mm - lagging).tolist()
    r = [float(motion.values_mm[0])]
    for end, begin, fade in zip(straight, begins, fades, strict=False):
        r.append(end + (r[-1] - begin) * fade)
    return np.array(r)


def _between_knots(
    motion: Motion, knots: Float64, times_s: Float64, time_constant_s: float, between: Between
) -> Float64:
    """Return the response at any times: on u = a + b s it is a + b (s - T) + (r - a + b T) exp(-s / T)."""
    t, u, slope = motion.times_s, motion.values_mm, _slopes(motion, between)
    here = np.clip(np.searchsorted(t, times_s, side="right") - 1, 0, len(t) - 1)
    since_s = np.maximum(times_s - t[here], 0.0)
    straight = u[here] + slope[here] * since_s
    if time_constant_s < NO_TIME_CONSTANT_S:
        return np.asarray(straight)
    lagging = slope[here] * time_constant_s
    return np.asarray(
        straight - lagging + (knots[here] - u[here] + lagging) * np.exp(-since_s / time_constant_s)
    )
