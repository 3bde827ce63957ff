"""Reasons for which each scan line holds the stripe or not, and the parts of its sigma."""

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Float64
from tracker.state import N_LINES
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.line_fit.block import CORRELATION_PX, MIN_SIGMA_E, WIDTH_SIGMA_LN, WINDOW_SIGMAS
from tracker.stripe.line_fit.first_guess import line_window
from tracker.stripe.line_fit.lines import map_edge
from tracker.stripe.read import StripeReading

READ, UNLIT, NO_PATH, NO_FIT = "", "unlit", "no path", "no fit"
TOO_WEAK, ODD_WIDTH = "too weak", "odd width"
"""Why a scan line holds no stripe: it is beyond the fan, the path found none, the fit ran away, or what it
found is none."""


@dataclass(frozen=True, eq=False)
class Refusals:
    """Reason for which each scan line (n_scan,) holds no stripe, `READ` where it does, and its refused fit.

    `height_e` and `width_ratio`, over the expected width, are NaN where no fit converged.
    """

    why: npt.NDArray[np.str_]
    height_e: Float64
    width_ratio: Float64


@dataclass(frozen=True, eq=False)
class SigmaParts:
    """Parts of the variance of each line's position, px^2, (n_scan,), NaN where there is no stripe.

    The fit is linear in the pixels about its end: with the Jacobian J, the weights W = V^-1 and the priors'
    information P its covariance C = (J'WJ + P)^-1 is C J'W V W J C + C P C, so the position's variance is a
    sum over what V and P are made of: `stripe` and `arc` are their light's shot noise, `dark` read noise and
    steps of the DN, `map` the priors of the background's offset and slope, `width` that of the stripe's
    width. `misfit` is by how much chi2 widens all of it, and what the lines scatter by beyond.

    `arc_share` is 1 - (variance without the arc) / variance: its shot noise and its map's uncertainty gone.
    `offset_e`, `slope_e_per_px` are what the fit adds to the background, the slope about the position.
    """

    stripe: Float64
    arc: Float64
    dark: Float64
    map: Float64
    width: Float64
    misfit: Float64
    arc_share: Float64
    offset_e: Float64
    slope_e_per_px: Float64

    @property
    def variance_px2(self) -> Float64:
        """The parts' sum (n_scan,), the variance that the fit states."""
        return self.stripe + self.arc + self.dark + self.map + self.width + self.misfit


def refusals(reading: StripeReading, expected: ExpectedStripe) -> Refusals:
    """Return why scan lines hold no stripe, and what the fit found that was refused."""
    n_scan = len(reading.start_px)
    why, height, width_ratio = np.full(n_scan, READ, dtype="<U12"), *np.full((2, n_scan), np.nan)
    for s in map(int, np.flatnonzero(np.isnan(reading.stripe.position_px))):
        if math.isnan(reading.start_px[s]):
            why[s] = NO_PATH if expected.is_sought[s] else UNLIT
            continue
        height[s] = reading.tried[s, 2]
        width_ratio[s] = reading.tried[s, 3] / (expected.sigma_px[s] * reading.learned.width_factor)
        if math.isnan(width_ratio[s]):
            why[s] = NO_FIT
        else:
            is_odd = abs(math.log(width_ratio[s])) > reading.learned.width_limit_ln
            why[s] = ODD_WIDTH if is_odd else TOO_WEAK
    return Refusals(why, height, width_ratio)


def sigma_parts(reading: StripeReading, expected: ExpectedStripe) -> SigmaParts:
    """Return what each scan line's sigma is made of."""
    n_scan = len(reading.start_px)
    parts = SigmaParts(*np.full((len(fields(SigmaParts)), n_scan), np.nan))
    for s in np.flatnonzero(np.isfinite(reading.stripe.position_px)):
        line = _line(reading, expected, int(s))
        for f, value in zip(fields(SigmaParts), line, strict=True):
            getattr(parts, f.name)[s] = value
    return parts


def _line(reading: StripeReading, expected: ExpectedStripe, s: int) -> tuple[float, ...]:
    """Return one line's numbers in the order of `SigmaParts`' fields."""
    band, low, both = reading.band, int(reading.band.lows[s // CELL]), read_with(reading, s)
    position, _, amplitude, width, chi2 = reading.fits[both, :5].mean(axis=0)
    window, half = window_of(reading, expected, s)
    charge, background, censored = (
        image[both, window].mean(axis=0) for image in (band.charge, band.background, band.censored)
    )
    share = 1.0 / reading.lines[N_LINES, s]
    shot, dark_e2 = share * reading.noise.shot, share * reading.noise.dark_e2
    u = np.arange(window.start, window.stop) + low - position
    t = u / width
    stripe = amplitude * np.exp(-0.5 * t**2)
    learned = reading.learned
    grains = ((learned.weighing_contrast if share == 1.0 else learned.pair_contrast) * stripe) ** 2

    smooth = max(math.hypot(reading.noise.map_rel * background.mean(), reading.noise.base_e), MIN_SIGMA_E)
    edge = map_edge(band.background, reading.band.lows, both.start, float(reading.start_px[both].mean()))
    known = _information(math.hypot(smooth, edge), math.hypot(smooth / CORRELATION_PX, edge / half))
    beside = np.column_stack([np.ones_like(u), u])
    b = np.zeros(2)
    # Steps in which the background's two numbers settle: their weights change little from step to step.
    for _ in range(6):
        mean = stripe + background + beside @ b
        counts = (censored == 0.0) | (charge > mean)
        weight = counts / (shot * np.maximum(mean, 0.0) + dark_e2 + grains)
        H = beside.T @ (weight[:, None] * beside) + np.diag(known[3:])
        b += np.linalg.solve(H, beside.T @ (weight * (charge - mean)) - known[3:] * b)

    J = np.column_stack([stripe / amplitude, stripe * t / width - b[1], stripe * t**2, beside])
    shot_stripe = shot * stripe
    shot_arc = shot * np.maximum(background + beside @ b, 0.0)
    dark = np.full_like(u, dark_e2)
    weight = counts / (shot_stripe + shot_arc + dark + grains)
    C = _covariance(J, weight, known)
    pull = (J @ C[1]) ** 2 * weight**2
    of_priors = C[1] ** 2 * known
    told = float(pull @ (shot_stripe + shot_arc + dark)) + float(of_priors[2:].sum())
    excess = max(chi2 - math.sqrt(2.0 / (counts.sum() - 2.0)), 1.0)
    beyond = reading.stripe.sigma_px[s] ** 2 - share * reading.fits[s, 1] ** 2 + C[1, 1] * excess - told

    without = _information(*(2 * [max(reading.noise.base_e, MIN_SIGMA_E)]))
    without[4] *= CORRELATION_PX**2
    alone = _covariance(J, counts / (shot_stripe + dark + grains), without)
    return (
        float(pull @ shot_stripe),
        float(pull @ shot_arc),
        float(pull @ dark),
        float(of_priors[3] + of_priors[4]),
        float(of_priors[2]),
        float(beyond),
        float(1.0 - alone[1, 1] / C[1, 1]),
        float(b[0]),
        float(b[1]),
    )


def read_with(reading: StripeReading, s: int) -> slice:
    """Return the scan lines that one was read with, itself and, where they are a pair, its neighbour."""
    n_lines = int(reading.lines[N_LINES, s])
    first = s - s % n_lines
    return slice(first, first + n_lines)


def window_of(reading: StripeReading, expected: ExpectedStripe, s: int) -> tuple[slice, float]:
    """Return which of a band's pixels a line's fit read, and how far it reached from the path, px."""
    both = read_with(reading, s)
    start = float(reading.start_px[both].mean()) - int(reading.band.lows[s // CELL])
    width = float(expected.sigma_px[both.start]) * reading.learned.width_factor
    return slice(*line_window(start, width, reading.band.charge.shape[1])), WINDOW_SIGMAS * width


def _information(offset_sigma_e: float, slope_sigma_e_per_px: float) -> Float64:
    """Return the priors' information (5,) on amplitude, position, ln width, offset and slope."""
    sigma = np.array([np.inf, np.inf, WIDTH_SIGMA_LN, offset_sigma_e, slope_sigma_e_per_px])
    return np.asarray(1.0 / sigma**2)


def _covariance(J: Float64, weight: Float64, known: Float64) -> Float64:
    return np.asarray(np.linalg.inv(J.T @ (weight[:, None] * J) + np.diag(known)))
