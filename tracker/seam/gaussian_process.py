"""From seam points ahead of the torch to the offset at the torch: a Gaussian process along the seam.

The seam's displacement from the programmed path is a smooth function of the station x along it. With the
prior covariance k(x, x') = s_0^2 + s_1^2 (1 + r) exp(-r), r = sqrt(3) |x - x'| / l (Matern 3/2: a seam that
bends, but not sharply; Rasmussen and Williams, Gaussian Processes for Machine Learning, Eq. 4.17) the best
estimate at any station from noisy measurements and its covariance are closed forms. It smooths where there
are many measurements, interpolates the look-ahead from sensor to torch, and says by its own sigma when the
torch stands where nothing has been measured.

The whole seam's displacement, s_0, is that of a part that lies off alike everywhere in base, a vector w. Each
station shows it along its own left and up: where the line turns, a place behind a corner shows what no place
before it does. So d(x) = (left, up)(x) w + b(x), w ~ N(0, s_0^2 I), with b the bends across and in height.

This process is Markov in its value and slope (Hartikainen and Sarkka 2010, IEEE MLSP, 379): over a distance d
both go by exp(-q d) [[1 + q d, d], [-q^2 d, 1 - q d]] with q = sqrt(3) / l. So a Kalman filter along the
stations, which takes the state where the answer is asked for along with it, gives the process' own answer in
a time that grows with the number of measurements and no faster.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.ordering import stable_order
from tracker.seam.line_directions import STRAIGHT, TURN_OVER_MM, LineDirections

CAPACITY = 96
"""Largest number of measurements."""

SPACING_MM = 1.0
"""Distance to the latest measurement's start within which one is averaged with it, at any frame rate."""

WIDE_SIGMA_MM = 5.0
"""s_0: how far a whole seam may lie off its programmed path."""

BEND_SIGMA_MM, BEND_LENGTH_MM = 0.5, 60.0
"""s_1 and l: how far a seam wanders about its mean, and over what length."""

SLOPE_SIGMA = 0.05
"""1 sigma of a seam's slope before it is measured: parts lie skewed, and seams bow."""

MODEL_SIGMA_MM = 0.01
"""Error of a measurement beyond its stated noise, so that repeats do not average without end."""

MIN_VARIANCE_MM2 = 1e-12
"""No measurement's own variance is taken for less, so that exact ones can be averaged."""


class SeamPrediction(NamedTuple):
    """Estimate of the seam at a station from its history: pairs are (y, z).

    `displacement_mm` and `sigma_mm` are its displacement and 1 sigma, `slope` and `slope_sigma` its slope's.
    The history goes from `first_mm` to `last_mm`; both are NaN where it is empty.
    """

    displacement_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    slope: tuple[float, float]
    slope_sigma: tuple[float, float]
    first_mm: float
    last_mm: float


_NO_STATIONS, _NO_PLACES = np.empty(0), np.empty((0, 2))
"""Nothing measured: arrays without room, which nobody can write to."""


class SeamHistory(NamedTuple):
    """Latest measurements, joint frame, mm: stations x (n,), displacements (n, 2) as (y, z), variances.

    `began_mm` is the station of the first of those that the latest one is the average of.
    """

    stations_mm: Float64 = _NO_STATIONS
    displacements_mm: Float64 = _NO_PLACES
    variances_mm2: Float64 = _NO_PLACES
    began_mm: float = math.nan

    @property
    def n(self) -> int:
        """Number of measurements."""
        return len(self.stations_mm)

    def with_measurement(
        self, station_mm: float, displacement_mm: Iterable[float], variance_mm2: Iterable[float]
    ) -> SeamHistory:
        """Return the history with one more measurement, the oldest dropped beyond CAPACITY.

        It takes the place of older ones that are nearer than SPACING_MM: a sensor that goes to and fro
        forgets nothing of what it does not see again.
        """
        y_mm, z_mm = displacement_mm
        y_mm2, z_mm2 = variance_mm2
        after: SeamHistory = _with_measurement(
            self, float(station_mm), (float(y_mm), float(z_mm)), (float(y_mm2), float(z_mm2))
        )
        return after

    def is_measured(self, station_mm: float) -> bool:
        """Return True if a station lies within the measured stretch."""
        return self.n > 0 and bool(self.stations_mm.min() <= station_mm <= self.stations_mm.max())

    def about(self, station_mm: float) -> SeamHistory:
        """Return the CAPACITY measurements about a station, of stations that rise."""
        begin = int(np.searchsorted(self.stations_mm, station_mm)) - CAPACITY // 2
        begin = max(0, min(begin, self.n - CAPACITY))
        near = slice(begin, begin + CAPACITY)
        return SeamHistory(self.stations_mm[near], self.displacements_mm[near], self.variances_mm2[near])

    def at(self, station_mm: float) -> tuple[Float64, Float64]:
        """Return the displacement (2,) as (y, z), mm, and its 1 sigma (2,) at a station."""
        here = self.point_at(station_mm)
        return np.array(here.displacement_mm), np.array(here.sigma_mm)

    def point_at(self, station_mm: float) -> SeamPrediction:
        """Return the estimate of the seam at a station, of a line that does not turn."""
        point: SeamPrediction = condition(self, STRAIGHT, float(station_mm))
        return point


NO_HISTORY = SeamHistory()
"""The history before anything is measured."""


MAX_STRETCHES = 8
"""The number of stretches between jumps that are remembered for the torch, which comes later."""


def stretch_at(
    history: SeamHistory, behind: Sequence[SeamHistory], station_mm: float
) -> tuple[SeamHistory, bool]:
    """Return the stretch of the seam that a station lies on, and whether it is the present one.

    It is the latest that has measured the station; between two, the nearer. The oldest stands first `behind`.
    """
    if not behind or history.is_measured(station_mm):
        return history, True
    for before in reversed(behind):
        if before.is_measured(station_mm):
            return before, False
    stretch, is_present = history, True
    for before in reversed(behind):
        if stretch.n and station_mm >= 0.5 * (before.stations_mm.max() + stretch.stations_mm.min()):
            break
        stretch, is_present = before, False
    return stretch, is_present


@kernel(allocates=True)
def _with_measurement(
    history: SeamHistory,
    station_mm: float,
    displacement_mm: tuple[float, float],
    variance_mm2: tuple[float, float],
) -> SeamHistory:
    """Return `SeamHistory.with_measurement`."""
    stations_mm, displacements_mm, variances_mm2, began_mm = history
    last, is_kept, n_kept = len(stations_mm) - 1, np.ones(len(stations_mm), np.bool_), len(stations_mm)
    is_same = abs(station_mm - began_mm) < SPACING_MM
    for i in range(last + 1):
        # The latest stays, however near: what it is the average of began farther away.
        if i == last if is_same else i < last and abs(stations_mm[i] - station_mm) < SPACING_MM:
            is_kept[i] = False
            n_kept -= 1
    skipped = max(n_kept + 1 - CAPACITY, 0)
    n = n_kept - skipped + 1
    places_mm, off_mm, noise_mm2 = np.empty(n), np.empty((n, 2)), np.empty((n, 2))
    k = -skipped
    for i in range(last + 1):
        if is_kept[i] and k >= 0:
            places_mm[k] = stations_mm[i]
            for axis in range(2):
                off_mm[k, axis], noise_mm2[k, axis] = displacements_mm[i, axis], variances_mm2[i, axis]
        k += is_kept[i]
    shares = 0.0
    for axis in range(2):
        here_mm, here_mm2 = displacement_mm[axis], max(variance_mm2[axis], MIN_VARIANCE_MM2)
        if is_same:
            latest_mm = displacements_mm[last, axis]
            before_mm2 = max(variances_mm2[last, axis] - MODEL_SIGMA_MM**2, MIN_VARIANCE_MM2)
            share = before_mm2 / (before_mm2 + here_mm2)
            here_mm, here_mm2 = latest_mm + share * (here_mm - latest_mm), share * here_mm2
            shares += share
        off_mm[n - 1, axis], noise_mm2[n - 1, axis] = here_mm, here_mm2 + MODEL_SIGMA_MM**2
    if not is_same:
        places_mm[n - 1] = began_mm = station_mm
    else:
        # From where it began, not from the average: that would run along with a sensor that creeps.
        places_mm[n - 1] = stations_mm[last] + 0.5 * shares * (station_mm - stations_mm[last])
    return SeamHistory(places_mm, off_mm, noise_mm2, began_mm)


BENDS, PART, THERE, N_STATES = 0, 4, 7, 11
"""State: bend and slope across and in height, the part's displacement, and the bends at the asked station."""


@kernel(allocates=True)
def condition(history: SeamHistory, line: LineDirections, station_mm: float) -> SeamPrediction:
    """Return the seam at a station of a line as a history's measurements leave it.

    What the measurements tell of the bend's slope, they tell of the seam's, which may be more. Of the
    symmetric covariance the lower triangle is kept.
    """
    stations_mm, displacements_mm, variances_mm2, _ = history
    n = len(stations_mm)
    order = stable_order(stations_mm)
    decay = math.sqrt(3.0) / BEND_LENGTH_MM
    gain, axes = np.empty(N_STATES), np.empty((2, 3))
    m, P = np.zeros(N_STATES), np.zeros((N_STATES, N_STATES))
    for i in range(0, PART, 2):
        P[i, i], P[i + 1, i + 1] = BEND_SIGMA_MM**2, (decay * BEND_SIGMA_MM) ** 2
    for i in range(PART, THERE):
        P[i, i] = WIDE_SIGMA_MM**2
    before = min(stations_mm[order[0]], station_mm) if n else station_mm
    n_states, i = THERE, 0
    while i < n or n_states == THERE:
        nearest = order[min(i, n - 1)] if n else 0
        is_query = n_states == THERE and (i == n or station_mm <= stations_mm[nearest])
        here = station_mm if is_query else stations_mm[nearest]
        if here > before:
            _predict(m, P, n_states, decay, here - before)
        before = here
        if is_query:
            n_states = N_STATES
            for k in range(PART):
                m[THERE + k] = m[k]
                for j in range(THERE):
                    P[THERE + k, j] = P[max(k, j), min(k, j)]
                for j in range(k + 1):
                    P[THERE + k, THERE + j] = P[k, j]
            continue
        _write_axes(line, here, axes)
        for axis in range(2):
            innovation = displacements_mm[nearest, axis] - m[2 * axis]
            spread = variances_mm2[nearest, axis]
            for k in range(n_states):
                gain[k] = P[max(k, 2 * axis), min(k, 2 * axis)]
                for c in range(3):
                    gain[k] += axes[axis, c] * P[max(k, PART + c), min(k, PART + c)]
            spread += gain[2 * axis]
            for c in range(3):
                spread += axes[axis, c] * gain[PART + c]
                innovation -= axes[axis, c] * m[PART + c]
            for k in range(n_states):
                share = gain[k] / spread
                m[k] += share * innovation
                for j in range(k + 1):
                    P[k, j] -= share * gain[j]
        i += 1
    first_mm, last_mm = math.nan, math.nan
    if n:
        first_mm, last_mm = stations_mm[order[0]], stations_mm[order[n - 1]]
    y_mm, sigma_y_mm, slope_y, slope_sigma_y = _answer(m, P, line, station_mm, 0)
    z_mm, sigma_z_mm, slope_z, slope_sigma_z = _answer(m, P, line, station_mm, 1)
    return SeamPrediction(
        (y_mm, z_mm),
        (sigma_y_mm, sigma_z_mm),
        (slope_y, slope_z),
        (slope_sigma_y, slope_sigma_z),
        first_mm,
        last_mm,
    )


@kernel(allocates=True)
def _answer(
    m: Float64, P: Float64, line: LineDirections, station_mm: float, axis: int
) -> tuple[float, float, float, float]:
    """Return displacement and its 1 sigma, slope and its 1 sigma at the asked station, of one axis."""
    axes, turned = np.empty((2, 3)), np.empty((2, 3))
    _write_axes(line, station_mm + TURN_OVER_MM, turned)
    _write_axes(line, station_mm - TURN_OVER_MM, axes)
    k = THERE + 2 * axis
    value_mm, slope = m[k], m[k + 1]
    for c in range(3):
        slope += (turned[axis, c] - axes[axis, c]) / (2.0 * TURN_OVER_MM) * m[PART + c]
    _write_axes(line, station_mm, axes)
    variance_mm2 = P[k, k]
    for c in range(3):
        value_mm += axes[axis, c] * m[PART + c]
        variance_mm2 += 2.0 * axes[axis, c] * P[k, PART + c]
        for j in range(3):
            variance_mm2 += axes[axis, c] * axes[axis, j] * P[PART + max(c, j), PART + min(c, j)]
    bend_slope = math.sqrt(3.0) / BEND_LENGTH_MM * BEND_SIGMA_MM
    information = max(1.0 / max(P[k + 1, k + 1], MIN_VARIANCE_MM2) - 1.0 / bend_slope**2, 0.0)
    slope_sigma = 1.0 / math.sqrt(1.0 / SLOPE_SIGMA**2 + information)
    return value_mm, math.sqrt(max(variance_mm2, 0.0)), slope, slope_sigma


@kernel
def _write_axes(line: LineDirections, station_mm: float, axes: Float64) -> None:
    """Write left and up (2, 3) at a station of a line."""
    stations_mm, axes_base = line
    low, high = 0, len(stations_mm) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if stations_mm[middle] <= station_mm:
            low = middle
        else:
            high = middle
    share = 0.0
    if high > low:
        share = (station_mm - stations_mm[low]) / max(stations_mm[high] - stations_mm[low], 1e-12)
        share = min(max(share, 0.0), 1.0)
    for axis in range(2):
        for c in range(3):
            axes[axis, c] = axes_base[low, axis, c] + share * (
                axes_base[high, axis, c] - axes_base[low, axis, c]
            )


@kernel
def _predict(m: Float64, P: Float64, n_states: int, decay: float, moved_mm: float) -> None:
    """Take both bends and slopes on over a distance: P - S goes by F (P - S) F^T, S stationary."""
    fade = math.exp(-decay * moved_mm)
    a, b = fade * (1.0 + decay * moved_mm), fade * moved_mm
    c, d = -(decay**2) * fade * moved_mm, fade * (1.0 - decay * moved_mm)
    value_mm2, slope2 = BEND_SIGMA_MM**2, (decay * BEND_SIGMA_MM) ** 2
    for i in range(BENDS, PART, 2):
        m[i], m[i + 1] = a * m[i] + b * m[i + 1], c * m[i] + d * m[i + 1]
        for j in range(i):
            P[i, j], P[i + 1, j] = a * P[i, j] + b * P[i + 1, j], c * P[i, j] + d * P[i + 1, j]
        for j in range(i + 2, n_states):
            P[j, i], P[j, i + 1] = a * P[j, i] + b * P[j, i + 1], c * P[j, i] + d * P[j, i + 1]
        over, cross, over_slope = P[i, i] - value_mm2, P[i + 1, i], P[i + 1, i + 1] - slope2
        P[i, i] = value_mm2 + a * a * over + 2.0 * a * b * cross + b * b * over_slope
        P[i + 1, i] = a * c * over + (a * d + b * c) * cross + b * d * over_slope
        P[i + 1, i + 1] = slope2 + c * c * over + 2.0 * c * d * cross + d * d * over_slope
