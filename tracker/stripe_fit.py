"""The maximum-likelihood centre of a stripe in a scan line, under arc light.

Along a scan line the charge is d(r) = A exp(-1/2 ((r - r_0)/w)^2) + L m(r) + b_0 + b_1 (r - r_0) + noise, m
the arc map, with the variance of a pixel at its *fitted* mean (never the observed one: that would favour
dark pixels). b_0 and b_1 are what the map may be wrong by, with a prior from its stated uncertainty; ln w has
one from the stripe that the setup predicts. A saturated pixel is censored: it says no more than 'at least
this', so it pulls only where the model lies below it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from noise_model.frames import Float64
from noise_model.kernel import REDUCTION, kernel
from tracker.stripe_path import Float32, Int64, Pair, bell

N_PARAMETERS = 5
WINDOW_SIGMAS = 4.0
"""The fit reads this many stripe sigmas to either side of the centre: beyond them little tells of it."""

MOST_PIXELS = 512
"""No stripe's window is longer."""

MIN_PIXELS = 8
"""Fewer pixels that count tell nothing of five parameters."""

MOST_STEPS, SETTLED = 12, 5e-4
"""Gauss-Newton steps at most; one that gains less of chi2 is the last: it ends within 0.01 of a sigma."""

WIDTH_SIGMA_LN = 0.1
"""1 sigma of ln(width / predicted width): focus, plate angle."""

CORRELATION_PX = 30.0
"""Over how many pixels the map's error changes: its slope's 1 sigma is the level's over this."""

MIN_SIGMA_E = 1e-3
"""The least 1 sigma of the background: a black level may be stated as exact."""

EDGE_PX = 3
"""How far off, in scan lines, the map's edges may lie: hand-eye and the seam's direction."""

MIN_SIGNIFICANCE = 5.0
"""A stripe counts from this amplitude over its 1 sigma."""

WIDTH_LIMIT_LN = 0.35
"""A fitted width further off than this is two faces or no stripe."""


class LineScratch(NamedTuple):
    """Room for one line's fit: pixel numbers (`MOST_PIXELS`,), information (5, 5), three vectors (5,)."""

    ramp: Float32
    H: Float64
    g: Float64
    step: Float64
    x: Float64


@kernel(fastmath=REDUCTION)
def _window(charge: Float32, background: Float32, ramp: Float32, start: float, width: float) -> Pair:
    """Return the background's mean and a stripe's least-squares amplitude about a start, in one pass.

    Both are NaN where the map or the charge is.
    """
    inverse = np.float32(1.0 / width)
    x0 = np.float32(start)
    top, bottom, level = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for j in range(charge.shape[0]):
        g = bell((ramp[j] - x0) * inverse)
        top += g * (charge[j] - background[j])
        bottom += g * g
        level += background[j]
    return float(level / charge.shape[0]), float(top / bottom)


@kernel(fastmath=REDUCTION)
def _normal_equations(
    charge: Float32,
    background: Float32,
    censored: npt.NDArray[np.bool_],
    ramp: Float32,
    x: Float64,
    width: float,
    shot: float,
    dark_variance: float,
    H: Float64,
    g: Float64,
) -> Pair:
    """Write the information's lower triangle H (5, 5) and the gradient g (5,) of a line's pixels at x.

    `x` holds amplitude, position over width, ln width, offset and slope times width: five numbers of alike
    derivatives. `charge` (n,) and its like are the window's, `ramp` (n,) counts its pixels. Returns chi2 and
    how many pixels counted. Reductions may be summed in any order, so they run 8 or 16 pixels at once.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    amplitude, offset, slope = np.float32(x[0]), np.float32(x[3]), np.float32(x[4])
    inverse, t0 = np.float32(1.0 / width), np.float32(x[1])
    shot32, dark32 = np.float32(shot), np.float32(dark_variance)
    h00, h10, h11, h20, h21 = zero, zero, zero, zero, zero
    h22, h30, h31, h32, h33 = zero, zero, zero, zero, zero
    h40, h41, h42, h43, h44 = zero, zero, zero, zero, zero
    g0, g1, g2, g3, g4 = zero, zero, zero, zero, zero
    chi2, used = zero, zero
    for j in range(charge.shape[0]):
        t = ramp[j] * inverse - t0
        g_t = bell(t)
        mean = amplitude * g_t + background[j] + offset + slope * t
        residual = charge[j] - mean
        counts = one if (not censored[j]) or residual > zero else zero
        weight = counts / (shot32 * max(mean, zero) + dark32)
        rise = amplitude * g_t * t
        wider = rise * t
        moved = rise - slope
        w_bell, w_moved, w_wider, w_t = weight * g_t, weight * moved, weight * wider, weight * t
        h00 += w_bell * g_t
        h10 += w_bell * moved
        h11 += w_moved * moved
        h20 += w_bell * wider
        h21 += w_moved * wider
        h22 += w_wider * wider
        h30 += w_bell
        h31 += w_moved
        h32 += w_wider
        h33 += weight
        h40 += w_bell * t
        h41 += w_moved * t
        h42 += w_wider * t
        h43 += w_t
        h44 += w_t * t
        g0 += w_bell * residual
        g1 += w_moved * residual
        g2 += w_wider * residual
        g3 += weight * residual
        g4 += w_t * residual
        chi2 += weight * residual * residual
        used += counts
    H[0, 0], H[1, 0], H[1, 1], H[2, 0], H[2, 1] = h00, h10, h11, h20, h21
    H[2, 2], H[3, 0], H[3, 1], H[3, 2], H[3, 3] = h22, h30, h31, h32, h33
    H[4, 0], H[4, 1], H[4, 2], H[4, 3], H[4, 4] = h40, h41, h42, h43, h44
    g[0], g[1], g[2], g[3], g[4] = g0, g1, g2, g3, g4
    return float(chi2), float(used)


@kernel
def _solve(H: Float64, g: Float64, step: Float64) -> bool:
    """Solve H step = g for a symmetric H (5, 5) by Cholesky, in place; False if it is not positive.

    `g` becomes the factor's inverse times g, whose square is what the step gains.
    """
    for i in range(N_PARAMETERS):
        for j in range(i + 1):
            total = H[i, j]
            for m in range(j):
                total -= H[i, m] * H[j, m]
            if i == j:
                if not total > 0.0:
                    return False
                H[i, i] = math.sqrt(total)
            else:
                H[i, j] = total / H[j, j]
    for i in range(N_PARAMETERS):
        total = g[i]
        for m in range(i):
            total -= H[i, m] * g[m]
        g[i] = total / H[i, i]
    for i in range(N_PARAMETERS - 1, -1, -1):
        total = g[i]
        for m in range(i + 1, N_PARAMETERS):
            total -= H[m, i] * step[m]
        step[i] = total / H[i, i]
    return True


@kernel
def _variance(H: Float64, which: int, column: Float64) -> float:
    """Return one parameter's variance, an element of the inverse, from the information's factor H (5, 5)."""
    variance = 0.0
    for i in range(which, N_PARAMETERS):
        total = 1.0 if i == which else 0.0
        for m in range(which, i):
            total -= H[i, m] * column[m]
        column[i] = total / H[i, i]
        variance += column[i] * column[i]
    return variance


@kernel
def fit_line(
    charge: Float32,
    background: Float32,
    censored: npt.NDArray[np.bool_],
    start: float,
    width: float,
    shot: float,
    dark_variance: float,
    map_sigma: float,
    base_sigma: float,
    edge_e: float,
    scratch: LineScratch,
    out: Float64,
) -> bool:
    """Fit one scan line by Gauss-Newton on the likelihood; write (position, sigma, amplitude, width, chi2).

    `charge`, `background` (depth,) are the linearised pixels and the arc map at its level, e-; `start` and
    `width` px. The variance of a pixel is `shot` (1, or 0 for one variance for all) times its mean plus
    `dark_variance`, e-^2. `map_sigma` is the map's relative 1 sigma, `base_sigma` the black level's, e-,
    `edge_e` by how much the map changes to the neighbouring lines: an edge that may cut across this one.
    False if there is no stripe there; what is written then is the fit that was refused, if it ran to its
    end. The position is relative to the band's start.
    """
    depth = charge.shape[0]
    half = WINDOW_SIGMAS * width
    middle = round(start)
    low, high = max(0, int(start - half)), min(depth - 1, int(start + half) + 1)
    n = high - low + 1
    if high - low < 2.0 * width or n > MOST_PIXELS or not low < middle < high:
        return False
    charge, background, censored = (
        charge[low : high + 1],
        background[low : high + 1],
        censored[low : high + 1],
    )
    ramp, H, g, step, x = scratch.ramp[:n], scratch.H, scratch.g, scratch.step, scratch.x
    level, amplitude = _window(charge, background, ramp, start - low, width)
    if not math.isfinite(amplitude):
        return False
    smooth = max(math.hypot(map_sigma * level, base_sigma), MIN_SIGMA_E)
    sigma_b0 = math.hypot(smooth, edge_e)
    sigma_b1 = math.hypot(smooth / CORRELATION_PX, edge_e / half)

    ln_w0 = math.log(width)
    position, ln_w, w, unit, b1 = start - low, ln_w0, width, width, 0.0
    x[0], x[3] = max(amplitude, 1.0), 0.0
    chi2, used = 0.0, 0.0
    for _ in range(MOST_STEPS):
        x[1], x[2], x[4] = position / w, ln_w, b1 * w
        chi2, used = _normal_equations(charge, background, censored, ramp, x, w, shot, dark_variance, H, g)
        off = (ln_w - ln_w0) / WIDTH_SIGMA_LN
        known_b0, known_b1 = 1.0 / sigma_b0**2, 1.0 / (sigma_b1 * w) ** 2
        H[2, 2] += 1.0 / WIDTH_SIGMA_LN**2
        g[2] -= off / WIDTH_SIGMA_LN
        H[3, 3] += known_b0
        g[3] -= x[3] * known_b0
        H[4, 4] += known_b1
        g[4] -= x[4] * known_b1
        chi2 += off * off + x[3] * x[3] * known_b0 + x[4] * x[4] * known_b1
        if used < MIN_PIXELS or not _solve(H, g, step):
            return False
        x[0] = max(x[0] + step[0], 0.1 * x[0])
        position += min(max(step[1], -1.0), 1.0) * w
        ln_w += min(max(step[2], -0.3), 0.3)
        x[3] += step[3]
        b1 += step[4] / w
        unit, w = w, math.exp(ln_w)
        if not 0.0 < position < n - 1 or abs(ln_w - ln_w0) > 1.0:
            return False
        gained = 0.0
        for i in range(N_PARAMETERS):
            gained += g[i] * g[i]
        if gained < SETTLED:
            break
    variance_a, variance_x = _variance(H, 0, g), _variance(H, 1, g) * unit * unit
    # Three of the five parameters brought a prior, whose term is counted too.
    freedom = used - 2.0
    chi2 /= freedom
    # Only what chi2 shows beyond its own scatter widens the sigmas: else chance alone would, on average.
    excess = max(chi2 - math.sqrt(2.0 / freedom), 1.0)
    significance = x[0] / math.sqrt(variance_a * excess)
    out[0] = low + position
    out[1] = math.sqrt(variance_x * excess)
    out[2] = x[0]
    out[3] = w
    out[4] = chi2
    return significance >= MIN_SIGNIFICANCE and abs(ln_w - ln_w0) <= WIDTH_LIMIT_LN


@kernel
def map_edge(background: Float32, lows: Int64, cell: int, s: int, position: float) -> float:
    """Return how much the map changes, e-, over EDGE_PX scan lines to either side at a position."""
    n_scan, depth = background.shape
    middle = background[s, min(max(int(position) - lows[s // cell], 0), depth - 1)]
    change = 0.0
    for other in (s - EDGE_PX, s + EDGE_PX):
        if 0 <= other < n_scan:
            r = min(max(int(position) - lows[other // cell], 0), depth - 1)
            if not math.isnan(background[other, r]):
                change = max(change, abs(background[other, r] - middle))
    return change


@kernel(allocates=True)
def fit_lines(
    charge: Float32,
    background: Float32,
    censored: npt.NDArray[np.bool_],
    start: Float64,
    width: Float64,
    lows: Int64,
    cell: int,
    shot: float,
    dark_variance: float,
    map_sigma: float,
    base_sigma: float,
    fits: Float64,
    saturated: npt.NDArray[np.bool_],
) -> None:
    """Fit every scan line from `start` (n_scan,), NaN for none; write `fits` (n_scan, 5) and `saturated`."""
    n_scan = charge.shape[0]
    scratch = LineScratch(
        np.arange(MOST_PIXELS).astype(np.float32),
        np.empty((N_PARAMETERS, N_PARAMETERS)),
        np.empty(N_PARAMETERS),
        np.empty(N_PARAMETERS),
        np.empty(N_PARAMETERS),
    )
    for s in range(n_scan):
        saturated[s] = False
        found = False
        if not math.isnan(start[s]):
            low = lows[s // cell]
            found = fit_line(
                charge[s],
                background[s],
                censored[s],
                start[s] - low,
                width[s],
                shot,
                dark_variance,
                map_sigma,
                base_sigma,
                map_edge(background, lows, cell, s, start[s]),
                scratch,
                fits[s],
            )
            if found:
                near = int(fits[s, 0])
                reach = int(2.0 * width[s])
                for r in range(max(0, near - reach), min(censored.shape[1], near + reach + 1)):
                    if censored[s, r]:
                        saturated[s] = True
                fits[s, 0] += low
        if not found:
            fits[s, :] = np.nan
