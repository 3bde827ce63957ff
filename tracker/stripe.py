"""The stripe under arc light: candidates by a matched filter, their path, the maximum-likelihood centre.

Along a scan line the charge is d(r) = A exp(-1/2 ((r - r_0)/w)^2) + L m(r) + b_0 + b_1 (r - r_0) + noise, m
the arc map, with the variance of a pixel at its *fitted* mean (never the observed one: that would favour
dark pixels). b_0 and b_1 are what the map may be wrong by, with a prior from its stated uncertainty; ln w has
one from the stripe that the setup predicts. A saturated pixel is censored: it says no more than 'at least
this', so it pulls only where the model lies below it.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from noise_model.frames import Float64
from noise_model.kernel import kernel

Float32 = npt.NDArray[np.float32]
Int64 = npt.NDArray[np.int64]

N_PARAMETERS = 5
WINDOW_SIGMAS = 3.0
"""The fit reads this many stripe sigmas to either side of the centre."""

OFFSET_STEP = 2
"""The path is sought on every second pixel; the fit starts from there."""

GAIN_CAP = 60.0
"""The most that one scan line's evidence counts in the path: a spatter streak cannot buy a detour."""

JUMP_COST, JUMP_COST_CAP, MISSING_COST = 1.0, 12.0, 6.0
"""Path costs in log-likelihood: per 2 px of change against the expected shape, at most, and for no stripe."""

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


@kernel(allocates=True)
def matched_filter(
    residual_e: Float32,
    variance_e2: Float32,
    center: Float64,
    width: Float64,
    lows: Int64,
    cell: int,
    offsets: Int64,
    score: Float32,
) -> None:
    """Score a stripe of the expected width at offsets from its expected place, in sigmas of its amplitude.

    `residual_e`, `variance_e2` (n_scan, depth) hold the charge less the arc's and the variance without a
    stripe; `center`, `width` (n_scan,) are expected positions and sigmas; `score` (n_scan, n_offsets). The
    template's mean is taken out, so a wrong level of the map scores nothing.
    """
    n_scan, depth = residual_e.shape
    for s in range(n_scan):
        w = width[s]
        half = math.ceil(2.5 * w)
        template = np.empty(2 * half + 1)
        mean = 0.0
        for j in range(-half, half + 1):
            template[j + half] = math.exp(-0.5 * (j / w) ** 2)
            mean += template[j + half]
        mean /= 2 * half + 1
        energy = 0.0
        for j in range(2 * half + 1):
            template[j] -= mean
            energy += template[j] * template[j]
        base = round(center[s]) - lows[s // cell]
        for i in range(offsets.shape[0]):
            at = base + offsets[i]
            if at - half < 0 or at + half >= depth:
                score[s, i] = 0.0
                continue
            total, noise = 0.0, 0.0
            for j in range(-half, half + 1):
                g = template[j + half]
                value = residual_e[s, at + j]
                if not math.isnan(value):
                    total += g * value
                    noise += g * g * variance_e2[s, at + j]
            score[s, i] = total / math.sqrt(noise) if noise > 0.0 else 0.0


@kernel(allocates=True)
def best_path(score: Float32, choice: Int64) -> None:
    """Find the likeliest path of offsets through the scores (n_scan, n); write its indices, -1 for no stripe.

    Viterbi: the gain is score^2 / 2 (capped), a change of offset costs its size up to a cap, so a step of a
    lap may be taken, and 'no stripe' is a state of its own.
    """
    n_scan, n = score.shape
    cost = np.zeros(n + 1)
    back = np.empty((n_scan, n + 1), dtype=np.int32)
    reach = np.empty(n)
    source = np.empty(n, dtype=np.int32)
    for s in range(n_scan):
        # Lower envelope of cost[j] + JUMP_COST |i - j|, in two passes.
        cheapest, cheapest_at = cost[0], 0
        for i in range(n + 1):
            if cost[i] < cheapest:
                cheapest, cheapest_at = cost[i], i
        for i in range(n):
            reach[i], source[i] = cost[i], i
            if i > 0 and reach[i - 1] + JUMP_COST < reach[i]:
                reach[i], source[i] = reach[i - 1] + JUMP_COST, source[i - 1]
        for i in range(n - 2, -1, -1):
            if reach[i + 1] + JUMP_COST < reach[i]:
                reach[i], source[i] = reach[i + 1] + JUMP_COST, source[i + 1]
        lost = cost[n]
        for i in range(n):
            if cheapest + JUMP_COST_CAP < reach[i]:
                reach[i], source[i] = cheapest + JUMP_COST_CAP, cheapest_at
            gain = 0.0
            if score[s, i] > 0.0:
                gain = min(0.5 * score[s, i] * score[s, i], GAIN_CAP)
            cost[i] = reach[i] - gain
            back[s, i] = source[i]
        if cheapest + JUMP_COST_CAP < lost:
            lost = cheapest + JUMP_COST_CAP
            back[s, n] = cheapest_at
        else:
            back[s, n] = n
        cost[n] = lost - MISSING_COST
    at = 0
    for i in range(n + 1):
        if cost[i] < cost[at]:
            at = i
    for s in range(n_scan - 1, -1, -1):
        choice[s] = at if at < n else -1
        at = back[s, at]


@kernel
def _solve(H: Float64, g: Float64, step: Float64) -> bool:
    """Solve H step = g for a symmetric H (5, 5) by Cholesky, in place; False if it is not positive."""
    for i in range(N_PARAMETERS):
        for j in range(i + 1):
            total = H[i, j]
            for m in range(j):
                total -= H[i, m] * H[j, m]
            if i == j:
                if total <= 0.0:
                    return False
                H[i, i] = math.sqrt(total)
            else:
                H[i, j] = total / H[j, j]
    for i in range(N_PARAMETERS):
        total = g[i]
        for m in range(i):
            total -= H[i, m] * step[m]
        step[i] = total / H[i, i]
    for i in range(N_PARAMETERS - 1, -1, -1):
        total = step[i]
        for m in range(i + 1, N_PARAMETERS):
            total -= H[m, i] * step[m]
        step[i] = total / H[i, i]
    return True


@kernel(allocates=True)
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
    out: Float64,
) -> bool:
    """Fit one scan line by Gauss-Newton on the likelihood; write (position, sigma, amplitude, width, chi2).

    `charge`, `background` (depth,) are the linearised pixels and the arc map at its level, e-; `start` and
    `width` px. The variance of a pixel is `shot` (1, or 0 for one variance for all) times its mean plus
    `dark_variance`, e-^2. `map_sigma` is the map's relative 1 sigma, `base_sigma` the black level's, e-,
    `edge_e` by how much the map changes to the neighbouring lines: an edge that may cut across this one.
    False if there is no stripe there. The position is relative to the band's start.
    """
    depth = charge.shape[0]
    half = WINDOW_SIGMAS * width
    middle = round(start)
    low, high = max(0, int(start - half)), min(depth - 1, int(start + half) + 1)
    if high - low < 2.0 * width or not low < middle < high:
        return False
    level = 0.0
    for r in range(low, high + 1):
        if math.isnan(background[r]) or math.isnan(charge[r]):
            return False
        level += background[r]
    level /= high - low + 1
    smooth = max(math.hypot(map_sigma * level, base_sigma), MIN_SIGMA_E)
    sigma_b0 = math.hypot(smooth, edge_e)
    sigma_b1 = math.hypot(smooth / CORRELATION_PX, edge_e / half)

    # Start: amplitude by least squares at the given place.
    top, bottom = 0.0, 0.0
    for r in range(low, high + 1):
        g = math.exp(-0.5 * ((r - start) / width) ** 2)
        top += g * (charge[r] - background[r])
        bottom += g * g
    amplitude, position, ln_w, b0, b1 = max(top / bottom, 1.0), start, math.log(width), 0.0, 0.0
    ln_w0 = ln_w
    H, g_vector, step = np.empty((5, 5)), np.empty(5), np.empty(5)
    J = np.empty(5)
    chi2, used = 0.0, 0
    for _ in range(12):
        for i in range(5):
            g_vector[i] = 0.0
            for j in range(5):
                H[i, j] = 0.0
        w = math.exp(ln_w)
        chi2, used = 0.0, 0
        for r in range(low, high + 1):
            t = (r - position) / w
            shape = math.exp(-0.5 * t * t)
            mean = amplitude * shape + background[r] + b0 + b1 * (r - position)
            residual = charge[r] - mean
            if censored[r] and residual <= 0.0:
                continue
            weight = 1.0 / (shot * max(mean, 0.0) + dark_variance)
            J[0] = shape
            J[1] = amplitude * shape * t / w - b1
            J[2] = amplitude * shape * t * t
            J[3] = 1.0
            J[4] = r - position
            chi2 += weight * residual * residual
            used += 1
            for i in range(5):
                g_vector[i] += weight * J[i] * residual
                for j in range(i + 1):
                    H[i, j] += weight * J[i] * J[j]
        H[2, 2] += 1.0 / WIDTH_SIGMA_LN**2
        g_vector[2] += (ln_w0 - ln_w) / WIDTH_SIGMA_LN**2
        H[3, 3] += 1.0 / sigma_b0**2
        g_vector[3] -= b0 / sigma_b0**2
        H[4, 4] += 1.0 / sigma_b1**2
        g_vector[4] -= b1 / sigma_b1**2
        chi2 += ((ln_w0 - ln_w) / WIDTH_SIGMA_LN) ** 2 + (b0 / sigma_b0) ** 2 + (b1 / sigma_b1) ** 2
        if used < 8 or not _solve(H, g_vector, step):
            return False
        move = min(max(step[1], -width), width)
        amplitude = max(amplitude + step[0], 0.1 * amplitude)
        position += move
        ln_w += min(max(step[2], -0.3), 0.3)
        b0 += step[3]
        b1 += step[4]
        if not low < position < high or abs(ln_w - ln_w0) > 1.0:
            return False
        if abs(move) < 1e-4 and abs(step[2]) < 1e-4:
            break
    # H holds the Cholesky factor of the information: two columns of its inverse are the variances sought.
    variance = np.empty(2)
    for which in range(2):
        for i in range(5):
            g_vector[i] = 1.0 if i == which else 0.0
        for i in range(5):
            total = g_vector[i]
            for m in range(i):
                total -= H[i, m] * step[m]
            step[i] = total / H[i, i]
        variance[which] = 0.0
        for i in range(5):
            variance[which] += step[i] * step[i]
    # Three of the five parameters brought a prior, whose term is counted too.
    freedom = used - 2
    chi2 /= freedom
    # Only what chi2 shows beyond its own scatter widens the sigmas: else chance alone would, on average.
    excess = max(chi2 - math.sqrt(2.0 / freedom), 1.0)
    significance = amplitude / math.sqrt(variance[0] * excess)
    if significance < MIN_SIGNIFICANCE or abs(ln_w - ln_w0) > WIDTH_LIMIT_LN:
        return False
    out[0] = position
    out[1] = math.sqrt(variance[1] * excess)
    out[2] = amplitude
    out[3] = math.exp(ln_w)
    out[4] = chi2
    return True


@kernel
def _map_edge(background: Float32, lows: Int64, cell: int, s: int, position: float) -> float:
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
                _map_edge(background, lows, cell, s, start[s]),
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
            for i in range(5):
                fits[s, i] = np.nan
