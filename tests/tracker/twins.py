"""Plain NumPy and scipy twins of the tracker's kernels, written from their contracts, not their code."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from noise_model.compiled.arrays import Bool, Float64, Int64, Integers
from tracker.arc.level import HUBER, MAP_SIGMA
from tracker.stripe.line_fit.block import CORRELATION_PX, WIDTH_SIGMA_LN, WINDOW_SIGMAS
from tracker.stripe.line_fit.lines import EDGE_PX
from tracker.stripe.viterbi import GAIN_CAP, JUMP_COST, JUMP_COST_CAP, MISSING_COST


def gather(image: Integers, along_rows: bool, lows: Float64, cell: int, depth: int) -> Float64:
    """The codes of a band, scan line by scan line."""
    lines = image.T if along_rows else image
    return np.stack([line[lows[s // cell] : lows[s // cell] + depth] for s, line in enumerate(lines)])


def running_median(band: Float64, half: int) -> Float64:
    """The median of what lies within `half` places, line by line."""
    places = np.arange(band.shape[1])
    near = np.abs(places[:, None] - places) <= half
    return np.stack([[np.median(line[row]) for row in near] for line in band])


def matched_filter(
    residual: Float64,
    variance: Float64,
    center: Float64,
    width: Float64,
    lows: Float64,
    offsets: Float64,
    bin_px: int,
) -> Float64:
    """The amplitude of a Gaussian without its mean over its 1 sigma, 0 where it does not fit in.

    Pixels are summed by so many from the band's first on, and places count in these sums.
    """
    whole = residual.shape[1] // bin_px
    residual, variance = (
        pixels[:, : whole * bin_px].reshape(len(pixels), whole, bin_px).sum(axis=2)
        for pixels in (residual, variance)
    )
    center, width = (center - lows - 0.5 * (bin_px - 1)) / bin_px, width / bin_px
    score = np.zeros((len(residual), len(offsets)))
    for s, line in enumerate(residual):
        half = math.ceil(2.5 * width[s])
        template = np.exp(-0.5 * (np.arange(-half, half + 1) / width[s]) ** 2)
        template -= template.mean()
        for i, offset in enumerate(offsets):
            first = int(np.rint(center[s])) + offset // bin_px - half
            if first < 0 or first + len(template) > len(line):
                continue
            part = slice(first, first + len(template))
            seen = ~np.isnan(line[part])
            noise = np.sum((template**2 * variance[s, part])[seen])
            if noise > 0.0:
                score[s, i] = np.sum((template * line[part])[seen]) / np.sqrt(noise)
    return score


def path_costs(n: int) -> Float64:
    """What it costs to go from each of n offsets and 'none' (the last) to each, (n + 1, n + 1)."""
    state = np.arange(n)
    change = np.full((n + 1, n + 1), JUMP_COST_CAP)
    change[:n, :n] = np.minimum(JUMP_COST * np.abs(state[:, None] - state), JUMP_COST_CAP)
    change[n, n] = 0.0
    return change


def path_gains(score: Float64) -> Float64:
    """What each state of each line earns, (n_scan, n + 1)."""
    gains = np.minimum(0.5 * np.maximum(score, 0.0) ** 2, GAIN_CAP)
    return np.column_stack([gains, np.full(len(score), MISSING_COST)])


def path_cost(score: Float64, choice: Int64) -> float:
    """The cost of a path of offsets, -1 for none."""
    n = score.shape[1]
    states = np.where(choice < 0, n, choice)
    return float(
        path_costs(n)[states[:-1], states[1:]].sum() - path_gains(score)[np.arange(len(score)), states].sum()
    )


def best_path_cost(score: Float64) -> float:
    """The lowest cost of all paths, by dynamic programming over the full matrix of changes."""
    change, gains = path_costs(score.shape[1]), path_gains(score)
    cost = -gains[0]
    for gain in gains[1:]:
        cost = (cost[:, None] + change).min(axis=0) - gain
    return float(cost.min())


def map_edge(background: Float64, lows: Float64, s: int, position: float) -> float:
    """The larger change of the map to the lines EDGE_PX away, at the same pixel of the image."""

    def value(line: int) -> float:
        place = np.clip(int(position) - lows[line], 0, background.shape[1] - 1)
        return float(background[line, place])

    others = [value(line) for line in (s - EDGE_PX, s + EDGE_PX) if 0 <= line < len(background)]
    return float(np.nanmax([0.0, *(abs(other - value(s)) for other in others)]))


class LineModel:
    """One scan line's stripe over the map: its penalised likelihood and what that says of each parameter.

    The pixel's law is the quasi-likelihood whose variance is mean + dark (a Poisson count with dark noise on
    top), -integral (d - mu) / V(mu) d(mu); a censored pixel that lies below the model says nothing.
    Parameters: amplitude, position, ln width, offset and slope of the background at that position.
    """

    def __init__(
        self,
        charge: Float64,
        background: Float64,
        censored: Bool,
        width: float,
        dark: float,
        map_sigma: float,
        base_sigma: float,
        edge: float,
        window: tuple[int, int],
    ) -> None:
        self.r = np.arange(window[0], window[1] + 1, dtype=np.float64)
        part = slice(window[0], window[1] + 1)
        self.charge, self.censored = charge[part].astype(np.float64), censored[part]
        self.background = background[part].astype(np.float64)
        self.dark, self.ln_width = dark, math.log(width)
        smooth = math.hypot(map_sigma * float(self.background.mean()), base_sigma)
        slope = math.hypot(smooth / CORRELATION_PX, edge / (WINDOW_SIGMAS * width))
        self.prior = np.array([0.0, 0.0, WIDTH_SIGMA_LN**-2, math.hypot(smooth, edge) ** -2, slope**-2])

    def mean(self, x: Float64) -> Float64:
        away = self.r - x[1]
        return x[0] * np.exp(-0.5 * (away / np.exp(x[2])) ** 2) + self.background + x[3] + x[4] * away

    def cost(self, x: Float64) -> float:
        mean = self.mean(x)
        mean = np.where(self.censored, np.minimum(mean, self.charge), mean)
        lit, dim = np.maximum(mean, 0.0), np.minimum(mean, 0.0)
        gained = (self.charge + self.dark) * np.log1p(lit / self.dark) - lit
        gained += (self.charge * dim - 0.5 * dim**2) / self.dark
        off = x - np.array([0.0, 0.0, self.ln_width, 0.0, 0.0])
        return float(0.5 * self.prior @ off**2 - gained.sum())

    def information(self, x: Float64) -> Float64:
        """The Fisher information (5, 5) at x, priors included, by numerical derivatives of the mean."""
        steps = np.maximum(np.abs(x), 1.0) * 1e-6
        moves = np.diag(steps)
        columns = [(self.mean(x + move) - self.mean(x - move)) / (2.0 * move.sum()) for move in moves]
        J, mean = np.stack(columns, axis=1), self.mean(x)
        counts = ~(self.censored & (self.charge <= mean))
        weight = counts / (np.maximum(mean, 0.0) + self.dark)
        return J.T @ (weight[:, None] * J) + np.diag(self.prior)

    def fit(self, start: Float64) -> Float64:
        """The parameters of the lowest cost, sought from a start near it."""
        scale = np.sqrt(np.diag(np.linalg.inv(self.information(start))))
        at = start
        for _ in range(20):
            found = minimize(
                lambda t, at=at: self.cost(at + scale * t) - self.cost(at),
                np.zeros(5),
                method="Nelder-Mead",
                options={"xatol": 1e-7, "fatol": 1e-12, "maxiter": 6000, "maxfev": 6000},
            )
            at = at + scale * found.x
            # A simplex may have shrunk before it was there.
            if np.abs(found.x).max() < 1e-3:
                break
        return at


def line_bound(
    amplitude: float,
    width: float,
    level: float,
    dark: float,
    map_sigma: float,
    base_sigma: float,
    reach_sigmas: float,
) -> float:
    """The Cramer-Rao bound of the position, px: all else unknown, width, offset and slope with priors.

    Read from the pixels within `reach_sigmas` of a stripe that stands on a level map.
    """
    reach = int(reach_sigmas * width)
    r = np.arange(-reach, reach + 1)
    model = LineModel(
        np.zeros(len(r)),
        np.full(len(r), level),
        np.zeros(len(r), dtype=bool),
        width,
        dark,
        map_sigma,
        base_sigma,
        0.0,
        (0, len(r) - 1),
    )
    at = np.array([amplitude, float(reach), math.log(width), 0.0, 0.0])
    return float(np.sqrt(np.linalg.inv(model.information(at))[1, 1]))


def seam_prior(apart_mm: Float64, wide: float, bend: float, length: float) -> Float64:
    """The covariance of a seam's displacements, written as the Matern 3/2 kernel stands in the book."""
    r = np.sqrt(3.0) * np.abs(apart_mm) / length
    return wide**2 + bend**2 * (1.0 + r) * np.exp(-r)


def groove_height(p: Float64, y: Float64) -> Float64:
    """The height of a groove's faces over y (n,): how far out of the root's middle a place lies decides."""
    y_s, z_s, gap, tan_left, tan_right, depth_left, depth_right, slope_left, slope_right = p
    left, outward = y >= y_s, np.abs(y - y_s)
    tan, depth = np.where(left, tan_left, tan_right), np.where(left, depth_left, depth_right)
    slope = np.where(left, slope_left, -slope_right)
    shoulder = 0.5 * gap + depth * tan
    wall = np.maximum(outward - 0.5 * gap, 0.0) / tan
    return np.asarray(z_s + np.where(outward < shoulder, wall, depth + slope * (outward - shoulder)))


def sheets_height(p: Float64, y: Float64) -> Float64:
    """The height of an upper sheet before the step at p[4] and a lower one behind it."""
    z, step, slope_lower, slope_upper, y_0 = p
    return np.where(y < y_0, z + step + slope_upper * (y - y_0), z + slope_lower * (y - y_0))


def half_groove_height(p: Float64, y: Float64) -> Float64:
    """The height of a half groove's faces over y (n,): a plate up to p[7], then root, bevel and plate."""
    gap, z_s, tan, depth_left, depth_right, slope_left, slope_right, wall = p
    out = y - wall
    shoulder = gap + depth_left * tan
    inside = z_s + np.maximum(out - gap, 0.0) / tan
    left = z_s + depth_left + slope_left * (out - shoulder)
    right = z_s + depth_right + slope_right * out
    return np.asarray(np.where(out < 0.0, right, np.where(out < shoulder, inside, left)))


def round_groove_height(p: Float64, y: Float64) -> Float64:
    """The height of a round groove's faces over y (n,): root, circle, the bevel that touches it, plate."""
    y_s, z_s, gap, tan_left, tan_right, depth_left, depth_right, slope_left, slope_right, radius = p
    left, outward = y >= y_s, np.abs(y - y_s) - 0.5 * gap
    bevel = np.arctan(np.where(left, tan_left, tan_right))
    depth, slope = np.where(left, depth_left, depth_right), np.where(left, slope_left, -slope_right)
    out = np.maximum(outward, 0.0)
    circle = radius - np.sqrt(np.maximum(radius**2 - out**2, 0.0))
    touches_at, touches_z = radius * np.cos(bevel), radius * (1.0 - np.sin(bevel))
    line = touches_z + (out - touches_at) / np.tan(bevel)
    shoulder = touches_at + (depth - touches_z) * np.tan(bevel)
    inside = np.where(out < touches_at, circle, line)
    return np.asarray(z_s + np.where(out < shoulder, inside, depth + slope * (out - shoulder)))


def corner_height(p: Float64, y: Float64) -> Float64:
    """The height of two plates over y (n,) that meet at (p[0], p[1])."""
    y_s, z_s, slope_left, slope_right = p
    return np.asarray(z_s + np.where(y >= y_s, slope_left, slope_right) * (y - y_s))


def bisquare_fit(
    height: Callable[[Float64, Float64], Float64],
    y: Float64,
    z: Float64,
    move: tuple[Float64, Float64],
    sigma: Float64,
    used: Bool,
    start: Float64,
    prior_sigma: Float64,
    wide: float,
) -> tuple[Float64, Float64, float, Float64]:
    """Tukey's bisquare fit of heights, all derivatives numerical: parameters, covariance, chi2, weights."""
    n, p, h = len(prior_sigma), start.copy(), 1e-7

    def off(p: Float64) -> tuple[Float64, Float64]:
        slope = (height(p, y + h) - height(p, y - h)) / (2.0 * h)
        unit = (move[1] - slope * move[0]) * sigma
        return (z - height(p, y)) / unit, unit

    weights, information = used.astype(np.float64), np.eye(n)
    for _ in range(20):
        r, unit = off(p)
        steps = h * np.eye(len(p))[:n]
        J = np.stack([(height(p, y) - height(p + step, y)) / (h * unit) for step in steps], axis=1)
        scale = max(1.0, 1.4826 * float(np.median(np.abs(r[used]))), wide)
        weights = np.where(used, np.clip(1.0 - (r / (4.685 * scale)) ** 2, 0.0, None) ** 2, 0.0)
        pull = (scale / prior_sigma) ** 2
        information = J.T @ (weights[:, None] * J) + np.diag(pull)
        step = np.linalg.solve(information, -J.T @ (weights * r) - pull * (p - start)[:n])
        p[:n] += step
        if wide < 1.0 and np.abs(step).max() < 1e-5:
            break
        wide /= 2.0
    r, _ = off(p)
    chi2 = float(np.sum(weights * r**2) / max(weights.sum() - n, 1.0))
    return p, np.linalg.inv(information) * max(1.0, chi2), chi2, weights


def best_shift(
    y: Float64, z: Float64, corners: Float64, shifts: Float64, limit: float
) -> tuple[float, float]:
    """The shift of a polyline with the least sum of cut residuals about their own median."""
    left_over = np.stack([z - np.interp(y - shift, corners[:, 0], corners[:, 1]) for shift in shifts])
    rise = np.median(left_over, axis=1)
    best = int(np.argmin(np.minimum(np.abs(left_over - rise[:, None]), limit).sum(axis=1)))
    return float(shifts[best]), float(rise[best])


def arc_level(
    map_e: Float64, charge: Float64, dark: float, black_sigma: float, start: float
) -> tuple[float, float, float, Float64]:
    """Huber's fit of a level and a black level by matrices: level, its 1 sigma, black, |residual| / sigma."""
    A, prior = np.column_stack([map_e, np.ones_like(map_e)]), np.diag([0.0, black_sigma**-2])
    x, scaled, information = np.array([start, 0.0]), np.zeros_like(map_e), prior
    for _ in range(100):
        mean = A @ x
        sigma = np.sqrt(np.maximum(mean, 0.0) + dark + (MAP_SIGMA * x[0] * map_e) ** 2)
        scaled = (charge - mean) / sigma
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(scaled), 1e-9)) / sigma**2
        information = A.T @ (weight[:, None] * A) + prior
        x = x + np.linalg.solve(information, A.T @ (weight * (charge - mean)) - prior @ x)
        x[0] = max(x[0], 0.0)
    return float(x[0]), float(np.linalg.inv(information)[0, 0] ** 0.5), float(x[1]), np.abs(scaled)
