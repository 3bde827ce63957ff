"""Correlated residuals of neighbouring lines: each one's own noise, and a wander that they share.

`evidence` says what for. Residuals may be those of single lines or the means of two (`stripe.neighbours`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.median import median_of, numbers_for
from noise_model.robust import MAD_SIGMA
from tracker.joint.section_fit import BISQUARE_WIDTH

LAGS, CHANCE_SIGMAS = 8, 2.0
"""Over so many lines a wander is read; an autocorrelation of less than so many sigmas is chance."""

MIN_CORRELATION, MAX_CORRELATION, OWN_SHARE = 0.1, 0.98, 0.01
"""Bounds of a wander's correlation from line to line, and least share of each line's own noise."""


class Wander(NamedTuple):
    """Residuals' own variance, that of their wander, and its correlation from line to line."""

    own: float
    wander: float
    correlation: float


@kernel(allocates=True)
def wander_of(off: Float64, n_lines: Float64) -> Wander:
    """Return the parts of residuals (n,), in sigmas of a line and in order, by their autocovariances c_k.

    The wander's correlation from one to the next is sum(c_k c_(k+1)) / sum(c_k^2) over LAGS, its
    variance c_1 over that. Outliers are left out. Residuals smaller than their sigmas are taken for as large.

    Where `n_lines` (n,) is 2 they are means of two lines'. Times the root of 2 these have, of a line's own
    variance v and a wander of variance q and correlation rho from line to line,

        c_0 = v + q (1 + rho),    c_k = q (1 + rho)^2 / (2 rho) rho^(2 k).

    Among single lines both factors of q are in between.
    """
    n = off.shape[0]
    sizes, core, c, lines = np.empty(numbers_for(n), np.float32), np.empty(n), np.zeros(LAGS + 2), 0.0
    for i in range(n):
        core[i] = off[i] * math.sqrt(n_lines[i])
        sizes[i] = abs(core[i])
        lines += n_lines[i] / n
    width = BISQUARE_WIDTH * max(1.0, MAD_SIGMA * median_of(sizes, n))
    for i in range(n):
        core[i] = core[i] if abs(core[i]) < width else 0.0
    for lag in range(LAGS + 2):
        c[lag] = _product(core, lag) / n
    if not c[1] > CHANCE_SIGMAS / math.sqrt(n) * c[0]:
        return Wander(max(c[0], 1.0), 0.0, 0.0)
    both, squares = 0.0, 0.0
    for lag in range(1, LAGS + 1):
        both += c[lag] * c[lag + 1]
        squares += c[lag] * c[lag]
    shared = min(max(max(both, 0.0) / squares, MIN_CORRELATION**lines), MAX_CORRELATION)
    correlation = shared ** (1.0 / lines)
    of_all = 1.0 + (lines - 1.0) * correlation
    wander = c[1] / shared / (1.0 + (lines - 1.0) * ((1.0 + correlation) ** 2 / (2.0 * correlation) - 1.0))
    wander, scale = min(wander, c[0] / of_all), max(1.0, 1.0 / c[0])
    return Wander(max(c[0] - wander * of_all, OWN_SHARE * c[0]) * scale, wander * scale, correlation)


@kernel(fastmath=REDUCTION)
def _product(values: Float64, lag: int) -> float:
    """Return the sum of the products of values (n,) a lag apart."""
    total = 0.0
    for i in range(values.shape[0] - lag):
        total += values[i] * values[i + lag]
    return total


@kernel(allocates=True)
def innovations(off: Float64, scan: Float64, n_lines: Float64, seen: Wander) -> Float64:
    """Return the innovations of residuals (n,), in order, over their sigma: see `Wander`.

    They are those of scan lines `scan` (n,), or means of two about there, as `n_lines` (n,) says. A wander w
    goes on to rho w + eta. So the mean of two is (1 + rho) / 2 w + eta / 2, and half of the own variance.
    """
    own, wander, correlation = seen
    new, foreseen, variance = np.empty(off.shape[0]), 0.0, wander
    of_mean, fresh = 0.5 * (1.0 + correlation), (1.0 - correlation * correlation) * wander
    for i in range(off.shape[0]):
        if i > 0:
            apart = abs(scan[i] - scan[i - 1]) - 0.5 * (n_lines[i] + n_lines[i - 1] - 2.0)
            shared = correlation ** max(apart, 0.0)
            foreseen *= shared
            variance = shared * shared * variance + (1.0 - shared * shared) * wander
        if n_lines[i] > 1.0:
            total = of_mean * of_mean * variance + 0.25 * fresh + 0.5 * own
            surprise = off[i] - of_mean * foreseen
            covariance = correlation * of_mean * variance + 0.5 * fresh
            foreseen = correlation * foreseen + covariance / total * surprise
            variance = correlation * correlation * variance + fresh - covariance * covariance / total
        else:
            total = variance + own
            surprise = off[i] - foreseen
            foreseen += variance / total * surprise
            variance *= own / total
        new[i] = surprise / math.sqrt(total)
    return new


@kernel(allocates=True)
def points_as_one(off: Float64) -> float:
    """Return the number of neighbouring residuals (n,), in order, in sigmas, that count as one; 1 at least.

    It is 1 + 2 sum of their autocorrelations, up to where those of two lags together are no longer above 0
    (Geyer 1992, Statistical Science 7, 473).
    """
    core = np.empty(off.shape[0])
    for i in range(off.shape[0]):
        core[i] = off[i] if abs(off[i]) < BISQUARE_WIDTH else 0.0
    power = _product(core, 0)
    if power == 0.0:
        return 1.0
    total = 0.0
    # Residuals are compared over a quarter of a profile at most.
    for lag in range(1, core.shape[0] // 4, 2):
        pair = (_product(core, lag) + _product(core, lag + 1)) / power
        if pair <= 0.0:
            break
        total += pair
    return 1.0 + 2.0 * total
