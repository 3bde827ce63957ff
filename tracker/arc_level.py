"""The arc's output and the map's fit, from pixels off the stripe, robustly: an arc breathes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from noise_model.arc_map import ArcKernel
from noise_model.frames import Float64
from tracker.geometry import SensorGeometry
from tracker.passage import Passage, seen_arc

MAP_SIGMA = 0.05
"""The map's stated relative 1 sigma: hand-eye, material and arc shape within their tolerance."""

HUBER = 2.0
"""Residuals beyond this many sigmas pull no harder."""

MISFIT_QUANTILE, NORMAL_QUANTILE = 0.9, 1.6449
"""The quantile of |residual| that the misfit is, and a normal law's."""

MIN_PIXELS = 40


@dataclass(frozen=True)
class ArcLevel:
    """The arc's output over the expected one, its 1 sigma, the black level's offset (e-) and the misfit.

    `misfit` is the residual's 90 % quantile over that of its stated uncertainty, 1 or less where the map is
    right: spatter over a twentieth of the pixels leaves it, a map that is wrong over an eighth does not. NaN
    where too few pixels can be used.
    """

    level: float
    sigma: float
    black_e: float
    misfit: float


UNKNOWN = ArcLevel(np.nan, np.nan, 0.0, np.nan)


def estimate_arc_level(
    geometry: SensorGeometry,
    kernel: ArcKernel,
    passage: Passage | None,
    image_dn: npt.NDArray[np.integer],
    stripe_px: Float64 | None,
    keep_off_px: float,
) -> ArcLevel:
    """Fit charge = level * map + black to a lattice of pixels farther than `keep_off_px` from the stripe.

    `kernel` predicts the arc at its expected output, `passage` what effects make of it. Weighted least
    squares with Huber weights; the variance is the pixel's at the fitted mean plus (MAP_SIGMA level map)^2,
    the black level's prior is its tolerance.
    """
    s, r = geometry.lattice()
    if stripe_px is not None:
        clear = np.abs(r - stripe_px[s]) > keep_off_px
        s, r = s[clear], r[clear]
    dn = image_dn[r, s] if geometry.along_rows else image_dn[s, r]
    open_well = dn < geometry.saturation_dn
    s, r, dn = s[open_well], r[open_well], dn[open_well]
    predicted, other = seen_arc(geometry, kernel, passage, s * geometry.n_pos + r)
    seen = np.isfinite(predicted)
    m, e = predicted[seen], geometry.charge_e[dn[seen]].astype(np.float64) - other[seen]
    if len(m) < MIN_PIXELS or not (m > 0.0).any():
        return UNKNOWN
    sensor, tolerance = geometry.setup.sensor, geometry.setup.tolerance
    black_sigma = max(tolerance.black_level_dn * sensor.gain_e_per_dn, 1e-3)
    A = np.column_stack([m, np.ones_like(m)])
    prior = np.diag([0.0, black_sigma**-2])
    x = np.array([max(0.0, float(np.median(e)) / float(np.median(m) + 1e-9)), 0.0])
    information = prior
    scaled = np.zeros_like(m)
    for _ in range(20):
        mean = A @ x
        sigma = np.sqrt(np.maximum(mean, 0.0) + geometry.dark_variance_e2 + (MAP_SIGMA * x[0] * m) ** 2)
        scaled = (e - mean) / sigma
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(scaled), 1e-9)) / sigma**2
        information = A.T @ (weight[:, None] * A) + prior
        step = np.linalg.solve(information, A.T @ (weight * (e - mean)) - prior @ x)
        x = x + step
        x[0] = max(x[0], 0.0)
        if np.abs(step[0]) < 1e-6 * max(x[0], 1e-3):
            break
    misfit = float(np.quantile(np.abs(scaled), MISFIT_QUANTILE)) / NORMAL_QUANTILE
    return ArcLevel(float(x[0]), float(np.sqrt(np.linalg.inv(information)[0, 0])), float(x[1]), misfit)
