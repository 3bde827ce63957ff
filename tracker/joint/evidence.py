"""Is it a joint? A plain plate is asked the same, at the scatter that the stripe shows.

A shape of eight parameters can be laid into the scatter of any plate. So a joint counts only where the
likelihood of its section over that of a plate without one is beyond what chance makes anywhere in the
search. The plate may be bowed: it is the cubic that fits the same points best.

Neighbours are correlated, by speckle and by the metal's texture: their residuals are each one's own noise, of
variance v, and a wander of variance q of which rho is left from line to line (an ARMA(1, 1)). Both are read
off the autocovariances of the section's own residuals. Of either hypothesis' residuals that counts which is
new in each, the innovation of a Kalman filter, over its sigma: texture's long waves are foreseen, and a
joint's corners are not (Schweppe 1965, IEEE Trans. Inf. Theory 11, 61). Both losses are Tukey's of that, so
that spatter speaks for neither. Twice what the section gains is a chi^2 on a plate, with as many degrees of
freedom k as it has parameters more (Wilks 1938, Annals of Mathematical Statistics 9, 60); of k = 5 it exceeds
x with the probability

    P = erfc(sqrt(x / 2)) + sqrt(2 x / pi) exp(-x / 2) (1 + x / 3),

and anywhere among N places with N P at most. The evidence is -ln of that.

Two lines that were read as one (`stripe.neighbours`) speak as often as two that were not: their mean's
innovation stands for both, that spread about it as independent lines are, or as correlated as their sigma
says.

A gap shows by lines that hold no plate. Lines are lost by chance too, and in runs. With the rate r at which
runs begin and the probability q that one goes on, a run of n lines or more is somewhere among N by chance
with the probability N r q^(n - 1), at most. Few lines next to the gap determine q: where a of them went on
with a run and b began one, Bayes' predictive probability stands for q^(n - 1), the product over j < n - 1 of
(a + j) / (a + b + j).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64
from noise_model.compiled.cholesky import factorise, solve
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.median import median_of, numbers_for
from noise_model.robust import MAD_SIGMA
from tracker.joint.measured import section_at
from tracker.joint.section_fit import BISQUARE_WIDTH, MIN_ALONG_MM
from tracker.joint.wander import MIN_CORRELATION, innovations, points_as_one, wander_of
from tracker.state import DY_MM, DZ_MM, N_LINES, SCAN, SIGMA_PX, Y_MM, Z_MM
from tracker.stripe.neighbours import usual_of

MIN_EVIDENCE_NATS = math.log(1e3)
"""Least evidence of a joint against a plate, nats: chance reaches it in one frame of 1000 at most."""

PLATE_PARAMETERS = 4
"""A plate is a cubic: a bow, and what is left of the lens, but no corner."""

FIRM = 1e-12
"""Share of the points' weight that holds each parameter of a plate at 0."""

PLATE_STEPS = 8
"""Steps of the plate's fit by Tukey's weights."""

RUN_PRIOR = 1.0, 9.0
"""Lines that are lost where a run has begun, and that are not, before any is seen: a run is short."""


@kernel(allocates=True)
def section_evidence_nats(points: Float64, corners_mm: Float64, reach_mm: float) -> float:
    """Return the evidence, nats, that points (n,) show the section of corners (k, 2) and not a plate.

    The seam was sought within a reach.
    """
    y_mm, z_mm, dy_mm, dz_mm = points[Y_MM], points[Z_MM], points[DY_MM], points[DZ_MM]
    scan, sigma_px, n_lines = points[SCAN], points[SIGMA_PX], points[N_LINES]
    n = y_mm.shape[0]
    off, off_plate = np.empty(n), np.empty(n)
    height_mm, slope = section_at(corners_mm, y_mm)
    for i in range(n):
        unit_mm = max(abs(dz_mm[i] - slope[i] * dy_mm[i]), MIN_ALONG_MM) * sigma_px[i]
        off[i] = (z_mm[i] - height_mm[i]) / (unit_mm * math.sqrt(n_lines[i]))
    fit_plate(y_mm, z_mm, dy_mm, dz_mm, sigma_px, n_lines, off_plate)
    seen = wander_of(off, n_lines)
    new = innovations(off, scan, n_lines, seen)
    new_of_plate = innovations(off_plate, scan, n_lines, seen)
    # A section that explains no more than the plate gains nothing. erfc is less than its exponential.
    pairs = pair_correlation(sigma_px, n_lines)
    gain = max(loss(new_of_plate, n_lines, pairs.correlation) - loss(new, n_lines, pairs.correlation), 0.0)
    x = 2.0 * gain / (points_as_one(new) * (1.0 + pairs.share * pairs.correlation))
    chance = math.log(1.0 + math.sqrt(2.0 * x / math.pi) * (1.0 + x / 3.0)) - 0.5 * x
    # Places of a section that lie so near to each other are one.
    return -chance - math.log(places_of(y_mm, reach_mm, 0.5))


@kernel
def places_of(y_mm: Float64, reach_mm: float, apart_mm: float) -> float:
    """Return at how many places, so far apart, a profile's points (n,) are searched within a reach.

    That is one at least.
    """
    searched_mm: float = min(2.0 * reach_mm, y_mm[-1] - y_mm[0])
    return max(searched_mm / apart_mm, 1.0)


@kernel(fastmath=REDUCTION)
def _plate_sums(
    t: Float64, z_mm: Float64, unit_mm: Float64, weights: Float64, H: Float64, g: Float64
) -> None:
    """Write the normal equations of a cubic in t (n,) through heights of weights and units (n,)."""
    s_0, s_1, s_2, s_3, s_4, s_5, s_6 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    g_0, g_1, g_2, g_3 = 0.0, 0.0, 0.0, 0.0
    for i in range(t.shape[0]):
        p_0 = weights[i] / (unit_mm[i] * unit_mm[i])
        p_1 = p_0 * t[i]
        p_2, p_3 = p_1 * t[i], p_1 * t[i] * t[i]
        s_0 += p_0
        s_1 += p_1
        s_2 += p_2
        s_3 += p_3
        s_4 += p_2 * t[i] * t[i]
        s_5 += p_3 * t[i] * t[i]
        s_6 += p_3 * t[i] * t[i] * t[i]
        g_0 += p_0 * z_mm[i]
        g_1 += p_1 * z_mm[i]
        g_2 += p_2 * z_mm[i]
        g_3 += p_3 * z_mm[i]
    sums = s_0, s_1, s_2, s_3, s_4, s_5, s_6
    for k in range(PLATE_PARAMETERS):
        for m in range(PLATE_PARAMETERS):
            H[k, m] = sums[k + m]
    g[0], g[1], g[2], g[3] = g_0, g_1, g_2, g_3


@kernel
def _off_plate(t: Float64, z_mm: Float64, unit_mm: Float64, p: Float64, off: Float64, sizes: Float32) -> None:
    """Write the residuals of points (n,) from a cubic of t (n,), in their units."""
    for i in range(t.shape[0]):
        height = p[0] + t[i] * (p[1] + t[i] * (p[2] + t[i] * p[3]))
        off[i] = (z_mm[i] - height) / unit_mm[i]
        sizes[i] = abs(off[i])


@kernel
def _units(
    t: Float64, dy_mm: Float64, dz_mm: Float64, sigma_px: Float64, slopes: Float64, unit_mm: Float64
) -> None:
    """Write points' 1 sigma (n,), mm, about a cubic whose slope is a quadratic in t (n,)."""
    for i in range(t.shape[0]):
        slope = slopes[0] + t[i] * (slopes[1] + t[i] * slopes[2])
        unit_mm[i] = max(abs(dz_mm[i] - slope * dy_mm[i]), MIN_ALONG_MM) * sigma_px[i]


@kernel(allocates=True)
def fit_plate(
    y_mm: Float64,
    z_mm: Float64,
    dy_mm: Float64,
    dz_mm: Float64,
    sigma_px: Float64,
    n_lines: Float64,
    off: Float64,
) -> None:
    """Fit a cubic z(y) to points (n,) by Tukey's weights; write how far they lie off it, in a line's sigmas.

    A point's sigma is the change of its height about the cubic with 1 sigma of its stripe's centre.
    """
    n, middle, low, high = y_mm.shape[0], 0.0, math.inf, -math.inf
    for i in range(n):
        middle += y_mm[i] / n
        low, high = min(low, y_mm[i]), max(high, y_mm[i])
    half = 0.5 * max(high - low, MIN_ALONG_MM)
    H, g = np.empty((PLATE_PARAMETERS, PLATE_PARAMETERS)), np.empty(PLATE_PARAMETERS)
    p = np.zeros(PLATE_PARAMETERS)
    weights, line_px, sizes = np.empty(n), np.empty(n), np.empty(numbers_for(n), np.float32)
    t, unit_mm, slopes = np.empty(n), np.empty(n), np.zeros(PLATE_PARAMETERS - 1)
    for i in range(n):
        t[i] = (y_mm[i] - middle) / half
        weights[i], line_px[i] = n_lines[i], sigma_px[i] * math.sqrt(n_lines[i])
    for _ in range(PLATE_STEPS):
        _units(t, dy_mm, dz_mm, line_px, slopes, unit_mm)
        _plate_sums(t, z_mm, unit_mm, weights, H, g)
        for k in range(PLATE_PARAMETERS):
            # Points at one place leave a cubic open.
            H[k, k] += FIRM * H[0, 0]
        if factorise(H):
            solve(H, g)
            p, g = g, p
        _off_plate(t, z_mm, unit_mm, p, off, sizes)
        for k in range(PLATE_PARAMETERS - 1):
            slopes[k] = (k + 1) * p[k + 1] / half
        # A wide scale first: a plate with a few points of its own is not the few.
        narrow = 1.0 / (BISQUARE_WIDTH * max(1.0, MAD_SIGMA * median_of(sizes, n)))
        for i in range(n):
            kept = max(1.0 - (off[i] * narrow) ** 2, 0.0)
            weights[i] = n_lines[i] * kept * kept


class Pairs(NamedTuple):
    """Correlation of the innovations of two lines that were read as one, and the share of such lines."""

    correlation: float
    share: float


@kernel(allocates=True)
def pair_correlation(sigma_px: Float64, n_lines: Float64) -> Pairs:
    """Return `Pairs` of points (n,) that stand for 1 or 2 lines each, as their sigmas have it.

    The mean of two with correlation r has (1 + r) / 2 of either's variance. Of r the first line tells
    MIN_CORRELATION beforehand; what is new in both is correlated by the rest.
    """
    room = np.empty(numbers_for(len(sigma_px)), np.float32)
    n_pairs, pair_px = usual_of(sigma_px, n_lines, 2, room)
    n_alone, alone_px = usual_of(sigma_px, n_lines, 1, room)
    if n_pairs == 0 or n_alone == 0:
        return Pairs(0.0, 0.0)
    correlation = 2.0 * (pair_px / alone_px) ** 2 - 1.0 - MIN_CORRELATION
    return Pairs(min(max(correlation, 0.0), 1.0), 2.0 * n_pairs / (2.0 * n_pairs + n_alone))


@kernel
def loss(new: Float64, n_lines: Float64, correlation: float) -> float:
    """Return Tukey's loss of what is new in residuals (n,), sigmas, in nats.

    Where two lines were read as one, `n_lines` is 2, it is what both would lose on average. Correlated by r,
    theirs lie about the root of (1 + r) / 2 of it with a variance of (1 - r) / 2, whose moments make the
    loss' terms.
    """
    total = 0.0
    for i in range(new.shape[0]):
        square = (new[i] / BISQUARE_WIDTH) ** 2
        if n_lines[i] > 1.0:
            m, h = 0.5 * (1.0 + correlation) * square, 0.5 * (1.0 - correlation) / BISQUARE_WIDTH**2
            second, fourth = m + h, m * m + 6.0 * m * h + 3.0 * h * h
            sixth = m**3 + 15.0 * m * m * h + 45.0 * m * h * h + 15.0 * h**3
            total += 2.0 * min(3.0 * second - 3.0 * fourth + sixth, 1.0) if m < 1.0 else 2.0
        else:
            total += 1.0 - max(1.0 - square, 0.0) ** 3
    return BISQUARE_WIDTH**2 / 6.0 * total


@kernel
def runs_of(is_lost: Bool, first: int, last: int) -> tuple[int, int, int]:
    """Return lines (n,), begun runs and lines that go on with one, of those not from `first` to `last`."""
    lines, begun, gone_on = 0, 0, 0
    was_lost = False
    for i in range(is_lost.shape[0]):
        if first <= i <= last:
            was_lost = False
            continue
        lines += 1
        if is_lost[i]:
            begun += not was_lost
            gone_on += was_lost
        was_lost = is_lost[i]
    return lines, begun, gone_on


@kernel
def gap_evidence_nats(is_lost: Bool, first: int, last: int, places: float) -> float:
    """Return the evidence, nats, that the lost lines from `first` to `last` are a gap's and not chance's.

    `is_lost` (n,) says of each scan line whether it holds no plate; the gap is sought at so many `places`.
    The longest run within the gap counts.
    """
    lines, begun, gone_on = runs_of(is_lost, first, last)
    longest, run = 0, 0
    for i in range(first, last + 1):
        run = run + 1 if is_lost[i] else 0
        longest = max(longest, run)
    if longest == 0:
        return -math.inf
    anywhere = (begun + 0.5) / (lines + 1.0) * places
    went_on, lost = gone_on + RUN_PRIOR[0], gone_on + begun + RUN_PRIOR[0] + RUN_PRIOR[1]
    goes_on = 0.0
    for j in range(longest - 1):
        goes_on += math.log((went_on + j) / (lost + j))
    return -math.log(anywhere) - goes_on
