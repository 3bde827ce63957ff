"""The seam of a recording as a curve: where the tracker found it, and how it may depart from that.

What the tracker does not know of the seam is its posterior covariance along the stations. Its Karhunen-Loeve
modes, each with a coefficient of unit variance, are the fewest numbers that say how the seam really runs. A
wrong camera adds modes of its own, whose coefficients are the camera's errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import STRETCH_ASIDE_MM, BentSeam, SeamLine, stretch_stations_mm
from tracker.seam.gaussian_process import SLOPE_SIGMA

BEND_MM, BEND_LENGTH_MM = (1.0, 0.02), 30.0
"""1 sigma of how far a seam wanders sideways and in height, and over what length; it bends without corners.

Plates are straight: a height that bent between view and torch would look like the arc's.
"""

SYSTEMATIC_MM, SYSTEMATIC_SLOPE = 0.05, 0.001
"""1 sigma of the tracker's systematic error with the right camera: in offset and in slope."""

MODES_LEAVE_MM = 0.002
"""Largest rms over the stations, mm, of the part of a seam that its modes leave out.

Bins of a diagnosis show the seam to about 2 um, and what modes left out an effect would seem to explain. Half
or twice as much changes the number of modes by a tenth or so: each is smaller than the one before.
"""

STRETCH_TURN, MIN_STRETCHES = 0.0015, 3
"""Change of slope from one straight stretch to the next, and their least number.

Light that grazes a groove's walls at some 0.1 rad goes with the sine of that angle: half of a turn changes it
by the model's floor, 0.6 %.
"""

GRID_MM = 1.0
"""Spacing of the stations at which curves are given."""

POINT_SCATTER_MM = 0.04
"""1 sigma of the tracker's points about a smooth seam, beyond what they state: tilt makes them wander."""


@dataclass(frozen=True, eq=False)
class SeamCurve:
    """Displacement from the nominal line at `stations_mm` (g,), joint frame, mm.

    `mean_mm` (2, g) as y and z, `modes_mm` (m, 2, g) by which they change for one unit of a coefficient.
    `has_ridges` says whether ridges run across it.
    """

    stations_mm: Float64
    mean_mm: Float64
    modes_mm: Float64
    has_ridges: bool

    @classmethod
    def of(
        cls,
        seen_mm: Float64,
        displacements_mm: Float64,
        variances_mm2: Float64,
        ends_mm: tuple[float, float],
        has_ridges: bool,
        systematic: tuple[float, float] = (SYSTEMATIC_MM, SYSTEMATIC_SLOPE),
    ) -> SeamCurve:
        """Return the curve between two stations that fits the seam's observations.

        They are displacements (n, 2) as y and z at stations (n,), with their variances (n, 2). `systematic`
        is 1 sigma, mm and mm/mm, of their common error, in position and in slope. Modes of y come first, as
        many of either as leave no more than `MODES_LEAVE_MM`.
        """
        stations = np.arange(ends_mm[0], ends_mm[1] + GRID_MM, GRID_MM)
        means, modes = [], []
        for axis in range(2):
            mean, covariance_mm2 = _posterior(stations, axis, seen_mm, displacements_mm, variances_mm2)
            along = stations - _middle(stations)
            turned = np.outer(along, along) * systematic[1] ** 2
            values, vectors = np.linalg.eigh(covariance_mm2 + systematic[0] ** 2 + turned)
            # The smallest come first: what all up to each of them together would leave.
            left_mm2 = np.cumsum(np.maximum(values, 0.0)) / len(stations)
            shown = np.flatnonzero(left_mm2 > MODES_LEAVE_MM**2)[::-1]
            vectors = vectors[:, shown]
            largest = vectors[np.argmax(np.abs(vectors), axis=0), np.arange(len(shown))]
            means.append(mean)
            of_axis = np.zeros((len(shown), 2, len(stations)))
            of_axis[:, axis] = (np.sqrt(values[shown]) * np.sign(largest) * vectors).T
            modes.append(of_axis)
        return cls(stations, np.array(means), np.concatenate(modes), has_ridges)

    def through(self, seen_mm: Float64, displacements_mm: Float64, variances_mm2: Float64) -> SeamCurve:
        """Return the curve through other observations, see `of`, with the same modes."""
        seen = seen_mm, displacements_mm, variances_mm2
        means = [_posterior(self.stations_mm, axis, *seen)[0] for axis in range(2)]
        return replace(self, mean_mm=np.array(means))

    def with_modes(self, modes_mm: Float64) -> SeamCurve:
        """Return the curve with further modes (k, 2, g) before its own."""
        return replace(self, modes_mm=np.concatenate([modes_mm, self.modes_mm]))

    @property
    def n_modes(self) -> int:
        """The number of coefficients."""
        return len(self.modes_mm)

    def evaluate(self, coefficients: Float64) -> tuple[Float64, Float64]:
        """Return displacement and slope (2, g) for coefficients (m,)."""
        y_z = self.mean_mm + np.tensordot(coefficients, self.modes_mm, 1)
        return y_z, np.gradient(y_z, self.stations_mm, axis=1)

    def mode_at(self, mode: int, stations_mm: Float64) -> tuple[Float64, Float64]:
        """Return displacement and slope (2, ...) of one mode, 0 to m - 1, at stations (...,)."""
        values = self.modes_mm[mode]
        slopes = np.gradient(values, self.stations_mm, axis=1)

        def at(of_stations: Float64) -> Float64:
            return np.stack([np.interp(stations_mm, self.stations_mm, of_axis) for of_axis in of_stations])

        return at(values), at(slopes)

    def chord_deviation_mm(self, coefficients: Float64, station_mm: float, torch_mm: float) -> float:
        """Return the largest sideways distance of the seam from the chord between a station and the torch."""
        y = self.evaluate(coefficients)[0][0]
        ends = sorted((station_mm, torch_mm))
        between = (self.stations_mm >= ends[0]) & (self.stations_mm <= ends[1])
        x = self.stations_mm[between]
        chord = np.interp(x, ends, np.interp(ends, self.stations_mm, y))
        return float(np.abs(y[between] - chord).max(initial=0.0))

    def bent(self, coefficients: Float64, first_mm: float, last_mm: float, torch_mm: float) -> BentSeam:
        """Return the seam from first to last as straight stretches, tangents at their middles.

        The arc stands at the height that the seam has at the torch's station. There are as many stretches as
        this very seam turns: by its mean alone, a seam that its modes bend would be lit more coarsely than
        the same one with a bent mean. Derivatives keep the stretches that they begin with.
        """
        evaluated = self.evaluate(coefficients)
        count = self._stretches(evaluated, first_mm, last_mm)
        stations_mm = stretch_stations_mm((first_mm, last_mm), torch_mm, count)
        *stretches, ground = self._tangents_of(evaluated, stations_mm)
        return BentSeam.over_ground(stretches, ground)

    def _stretches(self, evaluated: tuple[Float64, Float64], first_mm: float, last_mm: float) -> int:
        """Return the number of stretches that show a seam of displacement and slope (2, g)."""
        seen = (self.stations_mm >= first_mm) & (self.stations_mm <= last_mm)
        if np.count_nonzero(seen) < 2:
            return MIN_STRETCHES
        displacement, slope = (values[:, seen] for values in evaluated)
        count = math.ceil(float(np.ptp(slope, axis=1).max()) / STRETCH_TURN)
        aside = math.ceil(float(np.ptp(displacement[0])) / STRETCH_ASIDE_MM) if self.has_ridges else 0
        return max(count, aside, MIN_STRETCHES)

    def tangents(self, coefficients: Float64) -> Callable[[float], SeamLine]:
        """Return the function that gives the seam's tangent at a station, mm, for coefficients (m,)."""
        evaluated = self.evaluate(coefficients)
        return lambda station_mm: self._tangents_of(evaluated, np.array([station_mm]))[0]

    def _tangents_of(self, evaluated: tuple[Float64, Float64], stations_mm: Float64) -> list[SeamLine]:
        """Return the tangents at stations (n,), mm, of displacement and slope (2, g)."""
        values = [np.interp(stations_mm, self.stations_mm, curve) for curve in np.concatenate(evaluated)]
        return [SeamLine(*line) for line in np.transpose([stations_mm, *values]).tolist()]

    def sigma_mm(self, station_mm: float) -> Float64:
        """Return the 1 sigma (2,) of y and z at a station, mm, that the modes leave."""
        modes = [self.mode_at(n, np.array(station_mm))[0] for n in range(self.n_modes)]
        return np.asarray(np.sqrt(np.sum(np.square(modes), axis=0)))


def _middle(stations_mm: Float64) -> float:
    return 0.5 * float(stations_mm[0] + stations_mm[-1])


def _posterior(
    stations_mm: Float64, axis: int, seen_mm: Float64, displacements_mm: Float64, variances_mm2: Float64
) -> tuple[Float64, Float64]:
    """Return the posterior mean (g,), mm, and covariance (g, g), mm^2, of y or z at stations."""
    middle, bend_mm = _middle(stations_mm), BEND_MM[axis]
    prior = prior_covariance(stations_mm, stations_mm, middle, bend_mm)
    if not len(seen_mm):
        return np.zeros(len(stations_mm)), prior
    seen = prior_covariance(seen_mm, seen_mm, middle, bend_mm) + np.diag(
        variances_mm2[:, axis] + POINT_SCATTER_MM**2
    )
    across = prior_covariance(seen_mm, stations_mm, middle, bend_mm)
    gain = cho_solve(cho_factor(seen), across)
    return gain.T @ displacements_mm[:, axis], prior - across.T @ gain


def prior_covariance(x_mm: Float64, other_mm: Float64, middle_mm: float, bend_mm: float) -> Float64:
    """Return the prior covariance (n, m), mm^2, of the displacements at stations (n,) and (m,)."""
    apart = x_mm[:, None] - other_mm[None, :]
    slope = np.outer(x_mm - middle_mm, other_mm - middle_mm) * SLOPE_SIGMA**2
    # 1 sigma of a seam's offset from its nominal line.
    return np.asarray(5.0**2 + slope + bend_mm**2 * np.exp(-0.5 * (apart / BEND_LENGTH_MM) ** 2))
