"""Is it a joint? A plain plate is asked the same, at the scatter that the stripe shows.

A shape of eight parameters can be laid into the scatter of any plate. So a joint counts only where the
likelihood of its section over that of a plate without one is beyond what chance makes anywhere in the
search. The plate may be bowed: it is the cubic that fits the same points best.

Neighbours scatter alike, by speckle and by the metal's texture: their residuals are each one's own noise, of
variance v, and a wander of variance q of which rho is left from line to line (an ARMA(1, 1)). Both are read
off the autocovariances of the section's own residuals. Of either hypothesis' residuals that counts which is
new in each, the innovation of a Kalman filter, over its sigma: texture's long waves are foreseen, and a
joint's corners are not (Schweppe 1965, IEEE Trans. Inf. Theory 11, 61). Both losses are Tukey's of that, so
that spatter speaks for neither. Twice what the section gains is a chi^2 on a plate, with as many degrees of
freedom k as it has parameters more (Wilks 1938, Annals of Mathematical Statistics 9, 60); of k = 5 it exceeds
x with the probability

    P = erfc(sqrt(x / 2)) + sqrt(2 x / pi) exp(-x / 2) (1 + x / 3),

and anywhere among N places with N P at most. The evidence is -ln of that.

A gap shows by lines that hold no plate. Lines are lost by chance too, and in runs. With the rate r at which
runs begin and the probability q that one goes on, a run of n lines or more is somewhere among N by chance
with the probability N r q^(n - 1), at most. Few lines beside the gap tell q: where a of them went on with a
run and b began one, Bayes' predictive probability stands for q^(n - 1), the product over j < n - 1 of
(a + j) / (a + b + j).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float64
from noise_model.kernel import kernel
from noise_model.median import median
from tracker.joint.measured import section_at
from tracker.joint.section_fit import BISQUARE_WIDTH, MAD_SIGMA, MIN_ALONG_MM, tukey_loss
from tracker.profile import Profile

MIN_EVIDENCE_NATS = math.log(1e3)
"""A joint must be told from a plate by so much: chance does so in one frame of a thousand at most."""

PLACE_MM = 0.5
"""Places of a section that lie so near to each other are one."""

LAGS, CHANCE_SIGMAS = 8, 2.0
"""Over so many lines a wander is read; an autocorrelation of less than so many sigmas is chance."""

MIN_KEPT, MAX_KEPT, OWN_SHARE = 0.1, 0.98, 0.01
"""What is kept of a wander from line to line, at least and at most, and each line's own share of all."""

MAX_LAG_SHARE = 4
"""Residuals are compared over a quarter of a profile at most."""

PLATE_PARAMETERS = 4
"""A plate is a cubic: a bow, and what is left of the lens, but no corner."""

FIRM = 1e-12
"""So much of the points' weight holds each parameter of a plate at 0."""

PLATE_STEPS = 8
"""Steps of the plate's fit by Tukey's weights."""

RUN_PRIOR = 1.0, 9.0
"""Lines that are lost where a run has begun, and that are not, before any is seen: a run is short."""


def evidence_nats(profile: Profile, corners_mm: Float64) -> float:
    """Return the evidence, nats, that a profile shows the section of corners (n, 2) and not a plate."""
    height_mm, slope = section_at(corners_mm, profile.y_mm)
    off = (profile.z_mm - height_mm) / _unit_mm(profile, slope)
    off_plate = off_the_plate(profile)
    wander = wander_of(off)
    new, new_of_plate = (innovations(residuals, profile.scan, *wander) for residuals in (off, off_plate))
    alike = points_alike(new)
    # A section that explains no more than the plate gains nothing. erfc is less than its exponential.
    gain = max(_loss(new_of_plate) - _loss(new), 0.0)
    x = 2.0 * gain / alike
    chance = math.log(1.0 + math.sqrt(2.0 * x / math.pi) * (1.0 + x / 3.0)) - 0.5 * x
    return -chance - math.log(places_of(profile, PLACE_MM))


class Wander(NamedTuple):
    """Residuals' own variance, that of their wander, and the share of it that is left from line to line."""

    own: float
    wander: float
    kept: float


def wander_of(off: Float64) -> Wander:
    """Return what residuals (n,), in sigmas and in order, consist of, by their autocovariances c_k.

    The wander's share that is kept is sum(c_k c_(k+1)) / sum(c_k^2) over LAGS, its variance c_1 over that.
    Outliers are left out. Residuals smaller than their sigmas are taken for as large.
    """
    width = BISQUARE_WIDTH * max(1.0, MAD_SIGMA * median(np.abs(off)))
    core = np.where(np.abs(off) < width, off, 0.0)
    n = len(core)
    c = np.array([core[lag:] @ core[: n - lag] for lag in range(LAGS + 2)]) / n
    if not c[1] > CHANCE_SIGMAS / math.sqrt(n) * c[0]:
        return Wander(max(float(c[0]), 1.0), 0.0, 0.0)
    kept = float(np.clip(c[1:-1] @ c[2:] / (c[1:-1] @ c[1:-1]), MIN_KEPT, MAX_KEPT))
    wander = min(float(c[1]) / kept, float(c[0]))
    scale = max(1.0, 1.0 / float(c[0]))
    return Wander(max(float(c[0]) - wander, OWN_SHARE * float(c[0])) * scale, wander * scale, kept)


@kernel(allocates=True)
def innovations(off: Float64, scan: Float64, own: float, wander: float, kept: float) -> Float64:
    """Return what is new in residuals (n,) on scan lines (n,), in order, over its sigma: see `Wander`."""
    new, foreseen, variance = np.empty(off.shape[0]), 0.0, wander
    for i in range(off.shape[0]):
        if i > 0:
            shared = kept ** abs(scan[i] - scan[i - 1])
            foreseen *= shared
            variance = shared * shared * variance + (1.0 - shared * shared) * wander
        total = variance + own
        surprise = off[i] - foreseen
        new[i] = surprise / math.sqrt(total)
        foreseen += variance / total * surprise
        variance *= own / total
    return new


def points_alike(off: Float64) -> float:
    """Return how many neighbouring residuals (n,), in sigmas and in order, count as one; 1 at least.

    It is 1 + 2 sum of their autocorrelations, up to where those of two lags together are no longer above 0
    (Geyer 1992, Statistical Science 7, 473).
    """
    core = np.where(np.abs(off) < BISQUARE_WIDTH, off, 0.0)
    power = float(core @ core)
    if power == 0.0:
        return 1.0
    total = 0.0
    for lag in range(1, len(core) // MAX_LAG_SHARE, 2):
        pair = float(core[lag:] @ core[:-lag] + core[lag + 1 :] @ core[: -lag - 1]) / power
        if pair <= 0.0:
            break
        total += pair
    return 1.0 + 2.0 * total


def places_of(profile: Profile, apart_mm: float) -> float:
    """Return at how many places, so far apart, a profile is searched for its seam; one at least."""
    reach_mm = min(2.0 * profile.reach_mm, float(profile.y_mm[-1] - profile.y_mm[0]))
    return max(reach_mm / apart_mm, 1.0)


def off_the_plate(profile: Profile) -> Float64:
    """Return how far points (n,) lie off the plate, a cubic z(y), that fits them best, in their sigmas."""
    off = np.empty(len(profile.y_mm))
    fit_plate(profile.y_mm, profile.z_mm, profile.dy_mm, profile.dz_mm, profile.sigma_px, off)
    return off


@kernel(allocates=True)
def fit_plate(
    y_mm: Float64, z_mm: Float64, dy_mm: Float64, dz_mm: Float64, sigma_px: Float64, off: Float64
) -> None:
    """Fit a cubic z(y) to points (n,) by Tukey's weights; write how far they lie off it, in their sigmas.

    A point's sigma is by how much its height changes beside the cubic with 1 sigma of its stripe's centre.
    """
    n, middle, half = y_mm.shape[0], y_mm.mean(), 0.5 * max(y_mm.max() - y_mm.min(), MIN_ALONG_MM)
    p, H, g = (
        np.zeros(PLATE_PARAMETERS),
        np.empty((PLATE_PARAMETERS, PLATE_PARAMETERS)),
        np.empty(PLATE_PARAMETERS),
    )
    sums = np.empty(2 * PLATE_PARAMETERS - 1)
    weights, sizes, slope = np.ones(n), np.empty(n), np.zeros(n)
    for _ in range(PLATE_STEPS):
        sums[:], g[:] = 0.0, 0.0
        for i in range(n):
            unit = max(abs(dz_mm[i] - slope[i] * dy_mm[i]), MIN_ALONG_MM) * sigma_px[i]
            t, power = (y_mm[i] - middle) / half, weights[i] / (unit * unit)
            for k in range(len(sums)):
                sums[k] += power
                if k < PLATE_PARAMETERS:
                    g[k] += power * z_mm[i]
                power *= t
        for k in range(PLATE_PARAMETERS):
            H[k] = sums[k : k + PLATE_PARAMETERS]
        for k in range(PLATE_PARAMETERS):
            # Points at one place leave a cubic open: the solver would raise.
            H[k, k] += FIRM * H[0, 0]
        p[:] = np.linalg.solve(H, g)
        for i in range(n):
            t, height, steepness = (y_mm[i] - middle) / half, 0.0, 0.0
            for k in range(PLATE_PARAMETERS - 1, -1, -1):
                steepness = steepness * t + height
                height = height * t + p[k]
            unit = max(abs(dz_mm[i] - slope[i] * dy_mm[i]), MIN_ALONG_MM) * sigma_px[i]
            off[i] = (z_mm[i] - height) / unit
            sizes[i], slope[i] = abs(off[i]), steepness / half
        # A wide scale first: a plate with a few points of its own is not the few.
        narrow = 1.0 / (BISQUARE_WIDTH * max(1.0, MAD_SIGMA * np.median(sizes)))
        for i in range(n):
            kept = max(1.0 - (off[i] * narrow) ** 2, 0.0)
            weights[i] = kept * kept


def _unit_mm(profile: Profile, slope: Float64) -> Float64:
    """Return how far points (n,) lie off a face of a slope, mm, if their centre is off by its 1 sigma."""
    return np.asarray(
        np.maximum(np.abs(profile.dz_mm - slope * profile.dy_mm), MIN_ALONG_MM) * profile.sigma_px
    )


def _loss(off: Float64) -> float:
    """Return Tukey's loss of residuals (n,), sigmas, in nats."""
    return tukey_loss(np.maximum(1.0 - (off / BISQUARE_WIDTH) ** 2, 0.0) ** 2)


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
    went_on, lost = gone_on + RUN_PRIOR[0], gone_on + begun + sum(RUN_PRIOR)
    goes_on = sum(math.log((went_on + j) / (lost + j)) for j in range(longest - 1))
    return -math.log(anywhere) - goes_on
