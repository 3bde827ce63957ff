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

from noise_model.arrays import Bool, Float32, Float64, Int64
from noise_model.kernel import REDUCTION, kernel
from tracker.stripe.normal_equations import N_PARAMETERS, moments_of, normal_equations, solve, variance_of
from tracker.stripe.viterbi import Pair

WINDOW_SIGMAS = 4.0
"""The fit reads this many stripe sigmas to either side of the centre: beyond them little tells of it."""

BLOCK = 8
"""The pixels that the CPU takes at once: a window is a multiple, for a rest takes as long as several."""

MAX_PIXELS = 512
"""No stripe's window is longer."""

N_FITTED = 7
"""A line's fit writes so many numbers."""

MIN_PIXELS = 8
"""Fewer pixels that count tell nothing of five parameters."""

MAX_STEPS, LINE_SETTLED = 12, 2e-3
"""Gauss-Newton steps at most; one that gains less of chi2 is the last: it ends within 0.01 of a sigma."""

CORE_SIGMAS, CORE_MEAN = 0.5, 0.95
"""The first guess of an amplitude is from the pixels so near: a bell's mean there, over its top."""

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


class LineScratch(NamedTuple):
    """Room for one line's fit: pixel numbers (`MAX_PIXELS`,), information (5, 5), three vectors (5,)."""

    ramp: Float32
    H: Float64
    g: Float64
    step: Float64
    x: Float64


@kernel
def line_window(start: float, width: float, depth: int) -> tuple[int, int]:
    """Return from which pixel on and before which a line of so many pixels is read for a stripe at `start`.

    It is as many BLOCKs as hold WINDOW_SIGMAS on either side, two at least, moved where the line ends.
    """
    n = max(2, math.ceil(2.0 * WINDOW_SIGMAS * width / BLOCK)) * BLOCK
    low = max(0, min(math.ceil(start) - n // 2, depth - n))
    return low, min(low + n, depth)


@kernel(fastmath=REDUCTION)
def _start(charge: Float32, background: Float32, first: int, last: int) -> Pair:
    """Return the background's mean and that of what stands over it from pixel `first` to before `last`.

    Both are NaN where the map is.
    """
    level, over = np.float32(0.0), np.float32(0.0)
    for j in range(charge.shape[0]):
        level += background[j]
    for j in range(first, last):
        over += charge[j] - background[j]
    level /= np.float32(charge.shape[0])
    return float(level), float(over / np.float32(last - first) + np.float32(0.0) * level)


@kernel
def fit_line(
    charge: Float32,
    background: Float32,
    censored: Bool,
    start: float,
    width: float,
    shot: float,
    dark_variance: float,
    speckle: float,
    map_sigma: float,
    base_sigma: float,
    edge_e: float,
    scratch: LineScratch,
    out: Float64,
) -> bool:
    """Fit one scan line by Gauss-Newton on the likelihood.

    Written are position, sigma, amplitude, width, chi2, and the offset b_0 and slope b_1 of the background.

    `charge`, `background` (depth,) are the linearised pixels and the arc map at its level, e-; `start` and
    `width` px. The variance of a pixel is `shot` (1, or 0 for one variance for all) times its mean plus
    `dark_variance`, e-^2, and the square of `speckle` times the stripe's light. `map_sigma` is the map's
    relative 1 sigma, `base_sigma` the black level's, e-, `edge_e` by how much the map changes to the
    neighbouring lines: an edge that may cut across this one.
    False if there is no stripe there; what is written then is the fit that was refused, if it ran to its
    end. The position is relative to the band's start.
    """
    middle = round(start)
    low, end = line_window(start, width, charge.shape[0])
    n = end - low
    if n <= 2.0 * width or n > MAX_PIXELS or not low < middle < end - 1:
        return False
    charge, background, censored = charge[low:end], background[low:end], censored[low:end]
    ramp, H, g, step, x = scratch.ramp[:n], scratch.H, scratch.g, scratch.step, scratch.x
    core = int(CORE_SIGMAS * width) + 1
    level, over = _start(charge, background, max(middle - core - low, 0), min(middle + core + 1 - low, n))
    if not math.isfinite(over):
        return False
    smooth = max(math.sqrt((map_sigma * level) ** 2 + base_sigma**2), MIN_SIGMA_E)
    sigma_b0 = math.sqrt(smooth**2 + edge_e**2)
    sigma_b1 = math.sqrt((smooth / CORRELATION_PX) ** 2 + (edge_e / (WINDOW_SIGMAS * width)) ** 2)

    ln_w0 = math.log(width)
    position, ln_w, w, unit, b1 = start - low, ln_w0, width, width, 0.0
    x[0], x[3] = max(over / CORE_MEAN, 1.0), 0.0
    chi2, used, is_settled = 0.0, 0.0, False
    for _ in range(MAX_STEPS):
        x[1], x[2], x[4] = position / w, ln_w, b1 * w
        moments = moments_of(charge, background, censored, ramp, x, w, shot, dark_variance, speckle)
        normal_equations(moments, x, H, g)
        off = (ln_w - ln_w0) / WIDTH_SIGMA_LN
        known_b0, known_b1 = 1.0 / sigma_b0**2, 1.0 / (sigma_b1 * w) ** 2
        H[2, 2] += 1.0 / WIDTH_SIGMA_LN**2
        g[2] -= off / WIDTH_SIGMA_LN
        H[3, 3] += known_b0
        g[3] -= x[3] * known_b0
        H[4, 4] += known_b1
        g[4] -= x[4] * known_b1
        used = float(moments.used)
        chi2 = float(moments.chi2) + off * off + x[3] * x[3] * known_b0 + x[4] * x[4] * known_b1
        gained = solve(H, g, step)
        if used < MIN_PIXELS or math.isnan(gained):
            return False
        x[0] = max(x[0] + step[0], 0.1 * x[0])
        position += min(max(step[1], -1.0), 1.0) * w
        ln_w += min(max(step[2], -0.3), 0.3)
        x[3] += step[3]
        b1 += step[4] / w
        unit, w = w, math.exp(ln_w)
        if not 0.0 < position < n - 1 or abs(ln_w - ln_w0) > 1.0:
            return False
        # The last step may let a saturated pixel count, or no more: what they tell is asked once again.
        if gained < LINE_SETTLED and (is_settled or used == n):
            break
        is_settled = gained < LINE_SETTLED
    variance_a, variance_x = variance_of(H, 0, g), variance_of(H, 1, g) * unit * unit
    # Three of the five parameters brought a prior, whose term is counted too.
    freedom = used - 2.0
    chi2 /= freedom
    # Only what chi2 shows beyond its own scatter widens the sigmas: else chance alone would, on average.
    excess = max(chi2 - math.sqrt(2.0 / freedom), 1.0)
    # Where there is no stripe there is no speckle: a stripe is told from the noise without it.
    without = max(shot * (level + x[0]) + dark_variance, MIN_SIGMA_E**2)
    unspeckled = without / (without + (speckle * x[0]) ** 2)
    significance = x[0] / math.sqrt(variance_a * excess * unspeckled)
    out[0] = low + position
    out[1] = math.sqrt(variance_x * excess)
    out[2] = x[0]
    out[3] = w
    out[4] = chi2
    out[5] = x[3]
    out[6] = b1
    return bool(significance >= MIN_SIGNIFICANCE)


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
    censored: Bool,
    start: Float64,
    width: Float64,
    lows: Int64,
    cell: int,
    shot: float,
    dark_variance: float,
    speckle: float,
    map_sigma: float,
    base_sigma: float,
    fits: Float64,
    saturated: Bool,
) -> None:
    """Fit every scan line from `start` (n_scan,), NaN for none; write `fits` (n_scan, 7) and `saturated`."""
    n_scan = charge.shape[0]
    scratch = LineScratch(
        np.arange(MAX_PIXELS).astype(np.float32),
        np.empty((N_PARAMETERS, N_PARAMETERS)),
        np.empty(N_PARAMETERS),
        np.empty(N_PARAMETERS),
        np.empty(N_PARAMETERS),
    )
    for s in range(n_scan):
        saturated[s] = False
        is_fitted = False
        if not math.isnan(start[s]):
            low = lows[s // cell]
            is_fitted = fit_line(
                charge[s],
                background[s],
                censored[s],
                start[s] - low,
                width[s],
                shot,
                dark_variance,
                speckle,
                map_sigma,
                base_sigma,
                map_edge(background, lows, cell, s, start[s]),
                scratch,
                fits[s],
            )
            if is_fitted:
                near = int(fits[s, 0])
                reach = int(2.0 * width[s])
                for r in range(max(0, near - reach), min(censored.shape[1], near + reach + 1)):
                    if censored[s, r]:
                        saturated[s] = True
                fits[s, 0] += low
        if not is_fitted:
            fits[s, :] = np.nan
