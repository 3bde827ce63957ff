"""Course of a stripe on a flat board in an undistorted image, a line or a parabola, and its uncertainty.

Speckle correlates the errors of neighbouring scan lines. With the residuals' autocorrelation r_k along the
stripe, n of them count as n / (1 + 2 sum r_k) independent ones (Sokal, Monte Carlo methods in statistical
mechanics, 1997, section 3); the sum ends where r_k is lost in its own noise.
"""

from dataclasses import dataclass

import numpy as np

from calibration.outliers import TAIL
from noise_model.compiled.arrays import Bool, Float64
from noise_model.robust import sigma_of

ROUNDS, SETTLED = 50, 1e-4

FAR_SIGMAS = 5.0
"""A point that many sigmas off the line is none of it."""

MIN_SIGMA = 1e-9
"""Stripes without noise occur in tests alone."""

MIN_FREEDOM = 2.0


@dataclass(frozen=True)
class LaserLineFit:
    """Line fitted to a stripe, or parabola.

    `rays` (k, 3), z = 1, are as many of its points as determine it, evenly to either side of their mean and
    as far apart as the stripe's points on the whole; they are uncertain along `across` (3,), that of the scan
    lines, with `covariance` (k, k).
    `kept` (n,) are the points on it, `sigma` is a point's, in units of the focal length, and `independent`
    the effective number of points.
    """

    rays: Float64
    across: Float64
    covariance: Float64
    kept: Bool
    sigma: float
    independent: float


def fit_line(rays: Float64, along_rows: bool, degree: int = 1) -> LaserLineFit:
    """Fit a line, or a parabola, to a stripe's rays (n, 3), z = 1, in the order of its scan lines.

    It is the maximum of Student's likelihood, with the covariance that the residuals show. With `along_rows`
    the points err along y.
    """
    t, y = (rays[:, 0], rays[:, 1]) if along_rows else (rays[:, 1], rays[:, 0])
    slope = _slope_of_most(t, y)
    course = np.polynomial.Polynomial([np.median(y - slope * t), slope])
    scale = np.inf
    weight = np.ones(len(t))
    for _ in range(ROUNDS):
        off = y - course(t)
        if not np.isfinite(scale):
            scale = max(sigma_of(off), MIN_SIGMA)
        weight = (TAIL + 1.0) / (TAIL + (off / scale) ** 2)
        before, scale = scale, max(float(np.sqrt(np.mean(weight * off**2))), MIN_SIGMA)
        course = np.polynomial.Polynomial.fit(t, y, degree, w=np.sqrt(weight))
        if abs(scale / before - 1.0) < SETTLED:
            break
    off = y - course(t)
    kept = np.abs(off) <= FAR_SIGMAS * scale
    t, off, weight = t[kept], off[kept], weight[kept]
    middle = float(np.average(t, weights=weight))
    spread = float(np.sqrt(np.average((t - middle) ** 2, weights=weight)))
    design = np.vander((t - middle) / spread, degree + 1, increasing=True)
    pull = weight * off
    bread = np.linalg.inv(design.T @ (weight_of_information(off, scale)[:, np.newaxis] * design))
    meat = design.T @ (pull[:, np.newaxis] ** 2 * design)
    together = lines_together(pull)
    independent = len(t) / together
    free = max(independent - degree - 1.0, MIN_FREEDOM)
    covariance = bread @ meat @ bread * together * independent / free
    # Evenly spaced places with the points' standard deviation.
    places = np.arange(degree + 1) - 0.5 * degree
    places /= np.sqrt(np.mean(places**2))
    ends = np.vander(places, degree + 1, increasing=True)
    along = middle + spread * places
    place = course(along)
    pair = (along, place) if along_rows else (place, along)
    across = np.array([0.0, 1.0, 0.0]) if along_rows else np.array([1.0, 0.0, 0.0])
    return LaserLineFit(
        np.column_stack([*pair, np.ones(degree + 1)]),
        across,
        ends @ covariance @ ends.T,
        kept,
        float(np.sqrt(np.mean(off**2))),
        independent,
    )


def weight_of_information(off: Float64, scale: float) -> Float64:
    """Return the slope of Student's pull over the residual, for each residual (n,)."""
    square = (off / scale) ** 2
    return np.asarray((TAIL + 1.0) * (TAIL - square) / (TAIL + square) ** 2)


def lines_together(pull: Float64) -> float:
    """Return the number of neighbours (1 or more) that count as one independent one."""
    n = len(pull)
    centred = pull - pull.mean()
    power = float(centred @ centred)
    if not power > 0.0:
        return 1.0
    total, noise = 1.0, 1.0 / np.sqrt(n)
    # The autocorrelation is summed over a fifth of the stripe's lines.
    for lag in range(1, max(int(0.2 * n), 2)):
        r = float(centred[lag:] @ centred[:-lag]) / power
        if r <= noise:
            break
        total += 2.0 * r
    return total


def _slope_of_most(t: Float64, y: Float64) -> float:
    """Return the median slope of pairs of points half the stripe apart: a quarter may be off."""
    half = len(t) // 2
    return float(np.median((y[half:] - y[: len(y) - half]) / (t[half:] - t[: len(t) - half])))
