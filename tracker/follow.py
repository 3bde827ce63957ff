"""From seam points ahead of the torch to the offset at the torch: a Gaussian process along the seam.

The seam's displacement from the programmed path is a smooth function of the station x along it. With the
prior covariance k(x, x') = s_0^2 + s_1^2 (1 + r) exp(-r), r = sqrt(3) |x - x'| / l (Matern 3/2: a seam that
bends, but not sharply; Rasmussen and Williams, Gaussian Processes for Machine Learning, Eq. 4.17) the best
estimate at any station from noisy measurements and its covariance are closed forms. It smooths where there
are many measurements, interpolates the look-ahead from sensor to torch, and says by its own sigma when the
torch stands where nothing has been measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_solve

from noise_model.frames import Float64
from noise_model.surface import SeamLine

CAPACITY = 96
"""How many measurements are kept."""

SPACING_MM = 1.0
"""What lies nearer to the latest measurement is averaged with it, so a high frame rate forgets nothing."""

WIDE_SIGMA_MM = 5.0
"""s_0: how far a whole seam may lie off its programmed path."""

BEND_SIGMA_MM, BEND_LENGTH_MM = 0.5, 60.0
"""s_1 and l: how far a seam wanders about its mean, and over what length."""

MODEL_SIGMA_MM = 0.01
"""What a measurement may be off beyond its stated noise, so that repeats do not average without end."""


@dataclass(frozen=True)
class SeamHistory:
    """Latest measurements, joint frame, mm: stations x (n,), displacements (n, 2) as (y, z), variances."""

    stations_mm: Float64 = field(default_factory=lambda: np.empty(0))
    displacements_mm: Float64 = field(default_factory=lambda: np.empty((0, 2)))
    variances_mm2: Float64 = field(default_factory=lambda: np.empty((0, 2)))

    def __len__(self) -> int:
        return len(self.stations_mm)

    def with_measurement(
        self, station_mm: float, displacement_mm: Float64, variance_mm2: Float64
    ) -> SeamHistory:
        """Return the history with one more measurement, the oldest dropped beyond CAPACITY."""
        kept = slice(1 - CAPACITY, None)
        variance = variance_mm2 + MODEL_SIGMA_MM**2
        if len(self) and abs(station_mm - self.stations_mm[-1]) < SPACING_MM:
            kept = slice(-1)
            last = self.displacements_mm[-1]
            share = self.variances_mm2[-1] / (self.variances_mm2[-1] + variance)
            station_mm = float(self.stations_mm[-1] + share.mean() * (station_mm - self.stations_mm[-1]))
            displacement_mm = last + share * (displacement_mm - last)
            variance = np.maximum(share * variance, MODEL_SIGMA_MM**2)
        return SeamHistory(
            np.append(self.stations_mm[kept], station_mm),
            np.vstack([self.displacements_mm[kept], displacement_mm]),
            np.vstack([self.variances_mm2[kept], variance]),
        )

    def is_measured(self, station_mm: float) -> bool:
        """Say whether a station lies within the measured stretch."""
        return len(self) > 0 and self.stations_mm.min() <= station_mm <= self.stations_mm.max()

    def line_at(self, station_mm: float) -> tuple[SeamLine, Float64]:
        """Return the seam as a straight stretch about a station, and the 1 sigma (2,) of its y and z, mm."""
        here, sigma = self.at(station_mm)
        ahead, _ = self.at(station_mm + 1.0)
        behind, _ = self.at(station_mm - 1.0)
        slope_y, slope_z = 0.5 * (ahead - behind)
        return SeamLine(station_mm, float(here[0]), float(here[1]), float(slope_y), float(slope_z)), sigma

    def at(self, station_mm: float) -> tuple[Float64, Float64]:
        """Return the displacement (2,) as (y, z), mm, and its 1 sigma (2,) at a station."""
        prior = WIDE_SIGMA_MM**2 + BEND_SIGMA_MM**2
        if len(self) == 0:
            return np.zeros(2), np.full(2, math.sqrt(prior))
        between = _covariance(self.stations_mm[:, None] - self.stations_mm[None, :])
        to_station = _covariance(self.stations_mm - station_mm)
        value, sigma = np.empty(2), np.empty(2)
        for axis in range(2):
            factor = np.linalg.cholesky(between + np.diag(self.variances_mm2[:, axis]))
            weights = cho_solve((factor, True), to_station)
            value[axis] = weights @ self.displacements_mm[:, axis]
            sigma[axis] = math.sqrt(max(prior - weights @ to_station, 0.0))
        return value, sigma


def _covariance(apart_mm: Float64) -> Float64:
    """Return the prior covariance of displacements that lie `apart_mm` apart, mm^2."""
    r = math.sqrt(3.0) * np.abs(apart_mm) / BEND_LENGTH_MM
    return np.asarray(WIDE_SIGMA_MM**2 + BEND_SIGMA_MM**2 * (1.0 + r) * np.exp(-r))
