"""A scan line's weighted sums, the normal equations of a stripe's fit that follow from them, their solution.

The mean of a pixel is A g(t) + its background + offset + slope t, g(t) = exp(-t^2 / 2), t its place over the
stripe's width. Its derivatives with the five unknowns are g, t^k or products of both, so the information
matrix is made of a dozen sums, whatever amplitude and slope are.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float32, Float64
from noise_model.kernel import REDUCTION, kernel
from tracker.stripe.viterbi import bell

N_PARAMETERS = 5

Single = np.floating[Any]


class Moments(NamedTuple):
    """Sums over a line's pixels, w a pixel's weight, g the bell and t the place over the width at it.

    `bell2_k` sums w g^2 t^k, `bell_k` w g t^k, `flat_k` w t^k; `off_k` and `off_bell_k` the same with the
    residual for one w; `chi2` w times the residual's square; `used` is how many pixels counted.
    """

    bell2_0: Single
    bell2_1: Single
    bell2_2: Single
    bell2_3: Single
    bell2_4: Single
    bell_0: Single
    bell_1: Single
    bell_2: Single
    bell_3: Single
    flat_0: Single
    flat_1: Single
    flat_2: Single
    off_bell_0: Single
    off_bell_1: Single
    off_bell_2: Single
    off_0: Single
    off_1: Single
    chi2: Single
    used: Single


@kernel(fastmath=REDUCTION)
def moments_of(
    charge: Float32,
    background: Float32,
    censored: Bool,
    ramp: Float32,
    x: Float64,
    width: float,
    shot: float,
    dark_variance: float,
    speckle: float,
) -> Moments:
    """Return the moments of a line's pixels at x.

    `x` holds amplitude, position over width, ln width, offset and slope times width: five numbers of alike
    derivatives. `charge` (n,) and its like are the window's, `ramp` (n,) counts its pixels. A pixel has the
    variance `shot` times its mean plus `dark_variance`, e-^2, and the square of `speckle` times the stripe's
    light. Sums may be taken in any order, so they run 8 or 16 pixels at once.
    """
    zero, unity = np.float32(0.0), np.float32(1.0)
    amplitude, offset, slope = np.float32(x[0]), np.float32(x[3]), np.float32(x[4])
    inverse, t0 = np.float32(1.0 / width), np.float32(x[1])
    shot32, dark32, speckled = np.float32(shot), np.float32(dark_variance), np.float32(speckle * x[0])
    bell2_0, bell2_1, bell2_2, bell2_3, bell2_4 = zero, zero, zero, zero, zero
    bell_0, bell_1, bell_2, bell_3 = zero, zero, zero, zero
    flat_0, flat_1, flat_2 = zero, zero, zero
    off_bell_0, off_bell_1, off_bell_2, off_0, off_1 = zero, zero, zero, zero, zero
    chi2, used = zero, zero
    for j in range(charge.shape[0]):
        t = ramp[j] * inverse - t0
        g = bell(t)
        mean = amplitude * g + background[j] + offset + slope * t
        residual = charge[j] - mean
        counts = unity if (not censored[j]) or residual > zero else zero
        grains = speckled * g
        weight = counts / (shot32 * max(mean, zero) + dark32 + grains * grains)
        t2, off = t * t, weight * residual
        w_bell, off_bell = weight * g, off * g
        w_bell2, w_bell2_2 = w_bell * g, w_bell * g * t2
        bell2_0 += w_bell2
        bell2_1 += w_bell2 * t
        bell2_2 += w_bell2_2
        bell2_3 += w_bell2_2 * t
        bell2_4 += w_bell2_2 * t2
        bell_0 += w_bell
        bell_1 += w_bell * t
        bell_2 += w_bell * t2
        bell_3 += w_bell * t2 * t
        flat_0 += weight
        flat_1 += weight * t
        flat_2 += weight * t2
        off_bell_0 += off_bell
        off_bell_1 += off_bell * t
        off_bell_2 += off_bell * t2
        off_0 += off
        off_1 += off * t
        chi2 += off * residual
        used += counts
    return Moments(
        bell2_0,
        bell2_1,
        bell2_2,
        bell2_3,
        bell2_4,
        bell_0,
        bell_1,
        bell_2,
        bell_3,
        flat_0,
        flat_1,
        flat_2,
        off_bell_0,
        off_bell_1,
        off_bell_2,
        off_0,
        off_1,
        chi2,
        used,
    )


@kernel
def normal_equations(m: Moments, x: Float64, H: Float64, g: Float64) -> None:
    """Write the information's lower triangle H (5, 5) and the gradient g (5,) that a line's moments give.

    The mean's derivatives with x are g, A g t - slope, A g t^2, 1 and t.
    """
    A, slope = x[0], x[4]
    H[0, 0] = m.bell2_0
    H[1, 0] = A * m.bell2_1 - slope * m.bell_0
    H[1, 1] = A * A * m.bell2_2 - 2.0 * slope * A * m.bell_1 + slope * slope * m.flat_0
    H[2, 0] = A * m.bell2_2
    H[2, 1] = A * A * m.bell2_3 - slope * A * m.bell_2
    H[2, 2] = A * A * m.bell2_4
    H[3, 0] = m.bell_0
    H[3, 1] = A * m.bell_1 - slope * m.flat_0
    H[3, 2] = A * m.bell_2
    H[3, 3] = m.flat_0
    H[4, 0] = m.bell_1
    H[4, 1] = A * m.bell_2 - slope * m.flat_1
    H[4, 2] = A * m.bell_3
    H[4, 3] = m.flat_1
    H[4, 4] = m.flat_2
    g[0] = m.off_bell_0
    g[1] = A * m.off_bell_1 - slope * m.off_0
    g[2] = A * m.off_bell_2
    g[3] = m.off_0
    g[4] = m.off_1


@kernel
def solve(H: Float64, g: Float64, step: Float64) -> float:
    """Solve H step = g for a symmetric H (5, 5) given by its lower triangle; NaN if it is not positive.

    Returns what the step gains, g H^-1 g. H becomes the factors of L D L^T: L below the diagonal, 1 / D on
    it; `g` becomes L^-1 g.
    """
    gained = 0.0
    for i in range(N_PARAMETERS):
        for j in range(i):
            total = H[i, j]
            for m in range(j):
                total -= H[j, m] * H[m, i]
            # L D waits in the upper triangle.
            H[j, i] = total
            H[i, j] = total * H[j, j]
        pivot, total = H[i, i], g[i]
        for m in range(i):
            pivot -= H[i, m] * H[m, i]
            total -= H[i, m] * g[m]
        if not pivot > 0.0:
            return math.nan
        H[i, i] = 1.0 / pivot
        g[i] = total
        gained += total * total * H[i, i]
    for i in range(N_PARAMETERS - 1, -1, -1):
        total = g[i] * H[i, i]
        for m in range(i + 1, N_PARAMETERS):
            total -= H[m, i] * step[m]
        step[i] = total
    return gained


@kernel
def variance_of(H: Float64, which: int, column: Float64) -> float:
    """Return one parameter's variance, an element of the inverse, from the factors H (5, 5) of `solve`."""
    variance = 0.0
    for i in range(which, N_PARAMETERS):
        total = 1.0 if i == which else 0.0
        for m in range(which, i):
            total -= H[i, m] * column[m]
        column[i] = total
        variance += total * total * H[i, i]
    return variance
