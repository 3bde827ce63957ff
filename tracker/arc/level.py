"""Level of the light of a frame apart from the laser's, from pixels off the stripe, robustly.

Where the arc is on, its output and the map's fit: an arc breathes. Where it is off, the light of the hall.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float32, Float64, Int64, Integers
from noise_model.compiled.kernel import REDUCTION, kernel
from tracker.arc.transmission import ArcLight, Transmission, seen_arc
from tracker.geometry import ImageSource, SensorGeometry, dark_variance_at

MAP_SIGMA = 0.05
"""The map's stated relative 1 sigma: hand-eye, material and arc shape within their tolerance."""

HUBER = 2.0
"""Residuals beyond this many sigmas pull no harder."""

MISFIT_QUANTILE, NORMAL_QUANTILE = 0.9, 1.6449
"""The quantile of |residual| that the misfit is, and a normal law's."""

MIN_PIXELS = 40
"""Fewer pixels tell nothing of the arc."""

MAX_SIGMA = 0.2
"""A level less certain than this, over the larger of itself and the expected one, is not known."""

MIN_BLACK_SIGMA_E = 1e-3
"""No black level is known better."""

MAX_STEPS, LEVEL_SETTLED = 20, 1e-6
"""Steps of the level's fit at most, and the relative one that is the last."""

CHANCE = 3.5
"""Chance excess of the quantile of n pixels' noise, over 1 / sqrt(n): 4 sigma of it."""


class ArcLevel(NamedTuple):
    """The arc's output over the expected one, its 1 sigma, the black level's offset (e-) and the misfit.

    `is_on` says whether the frame is said to have an arc; without one the level is 0. `ambient_e` is the
    1 sigma, e-, of what other light is left beyond the offset, known for frames without an arc. `misfit` is
    the residual's 90 % quantile over that of its stated uncertainty, 1 or less where the map is right:
    spatter over a twentieth of the pixels leaves it, a map that is wrong over an eighth does not. NaN where
    too few pixels can be used.
    """

    level: float
    sigma: float
    black_e: float
    misfit: float
    is_on: bool = True
    ambient_e: float = 0.0


UNKNOWN = ArcLevel(math.nan, math.nan, 0.0, math.nan)
"""Prior of the arc's level, which stands where the pixels do not determine it."""


class Unlit(NamedTuple):
    """Pixels that the laser does not light: the arc's light at its expected output, and the charge, (n,) e-.

    The charge is less the other light that is stated. `pixels` (n,) are counted by scan line.
    """

    arc_e: Float64
    charge_e: Float64
    pixels: Int64


def unlit_by_the_laser(
    geometry: SensorGeometry,
    light: ArcLight,
    transmission: Transmission | None,
    image_dn: Integers,
    stripe_px: Float64 | None,
    keep_off_px: float,
) -> Unlit:
    """Read an even sample's pixels that see metal, are not saturated and lie off the stripe.

    `light` is the arc's at its expected output, `transmission` what effects make of it. Off the stripe is
    farther than `keep_off_px` from `stripe_px` (n_scan,); without a stripe every pixel is.
    """
    pixels, charge_e = off_stripe(
        geometry.image_source, image_dn, NOWHERE if stripe_px is None else stripe_px, keep_off_px
    )
    arc_e, other_e = seen_arc(light, transmission, pixels)
    unlit: Unlit = only_seen(arc_e, charge_e, other_e, pixels)
    return unlit


def estimate_arc_level(image: ImageSource, unlit: Unlit) -> ArcLevel:
    """Fit charge = level * map + black to pixels off the stripe.

    Weighted least squares with Huber weights; the variance is the pixel's at the fitted mean plus (MAP_SIGMA
    level map)^2, the black level's prior is its tolerance. Where the pixels ask for one far beyond that,
    light of the hall is in it, and nothing is known of it before.
    """
    dark_e2 = dark_variance_at(image, unlit.charge_e)
    black_sigma_e = max(image.black_sigma_e, MIN_BLACK_SIGMA_E)
    full_well_e = image.response.full_well_e
    level: ArcLevel = fit_level(unlit.arc_e, unlit.charge_e, dark_e2, black_sigma_e, full_well_e)
    return level


def estimate_ambient_light(image: ImageSource, unlit: Unlit) -> ArcLevel:
    """Read the light of a frame whose arc is off.

    The offset is the median of what effects leave unexplained: the black level's, and even light of the hall.
    That light has the scene's texture. Its 1 sigma is by how much the residuals scatter, by the quantile that
    sets the misfit, beyond what the pixels' noise makes.
    """
    e, n = unlit.charge_e, unlit.charge_e.shape[0]
    if n < MIN_PIXELS:
        return ArcLevel(0.0, 0.0, 0.0, math.nan, False, 0.0)
    black = quantile(e, 0.5)
    noise_e = math.sqrt(max(black, 0.0) + dark_variance_at(image, e)) * (1.0 + CHANCE / math.sqrt(n))
    spread_e = quantile(np.abs(e - black), MISFIT_QUANTILE) / NORMAL_QUANTILE
    return ArcLevel(0.0, 0.0, black, math.nan, False, math.sqrt(max(spread_e**2 - noise_e**2, 0.0)))


NOWHERE = np.empty(0)
"""No stripe's place, as the kernel takes it."""


@kernel(allocates=True)
def off_stripe(
    image: ImageSource, image_dn: Integers, stripe_px: Float64, keep_off_px: float
) -> tuple[Int64, Float64]:
    """Return those pixels of the level's sample that are neither saturated nor near the stripe.

    With them comes their charge (n,), e-. `stripe_px` (n_scan,) is the stripe's place, empty for none. The
    pixels are counted by scan line.
    """
    n, count = 0, image.level_scan.shape[0]
    pixels, charge_e = np.empty(count, np.int64), np.empty(count)
    for i in range(count):
        s, r = image.level_scan[i], image.level_position[i]
        dn = image_dn[r, s] if image.along_rows else image_dn[s, r]
        if dn < image.saturation_dn and (stripe_px.shape[0] == 0 or abs(r - stripe_px[s]) > keep_off_px):
            pixels[n], charge_e[n] = s * image.n_pos + r, image.charge_e[dn]
            n += 1
    return pixels[:n], charge_e[:n]


@kernel(allocates=True)
def only_seen(arc_e: Float32, charge_e: Float64, other_e: Float32, pixels: Int64) -> Unlit:
    """Return the pixels (n,) whose `arc_e` is known, other light (n,) taken off, or none if that is empty."""
    n, count = 0, arc_e.shape[0]
    seen_e, unlit_e, seen = np.empty(count), np.empty(count), np.empty(count, np.int64)
    for i in range(count):
        if math.isfinite(arc_e[i]):
            seen_e[n], seen[n] = arc_e[i], pixels[i]
            unlit_e[n] = charge_e[i] - (other_e[i] if other_e.shape[0] > 0 else np.float32(0.0))
            n += 1
    return Unlit(seen_e[:n], unlit_e[:n], seen[:n])


@kernel(allocates=True)
def quantile(values: Float64, share: float) -> float:
    """Return the value (n,) that so large a share of all is not above."""
    rank, held = math.ceil(share * (len(values) - 1)), values.copy()
    low, high = 0, len(values) - 1
    # Hoare's selection, in place: what lies before i is not above the pivot, what lies behind j not below.
    while low < high:
        pivot, i, j = held[(low + high) // 2], low, high
        while i <= j:
            while held[i] < pivot:
                i += 1
            while held[j] > pivot:
                j -= 1
            if i <= j:
                held[i], held[j] = held[j], held[i]
                i, j = i + 1, j - 1
        if j < rank < i:
            break
        low, high = (low, j) if rank <= j else (i, high)
    return float(held[rank])


@kernel(allocates=True)
def fit_level(
    map_e: Float64, charge_e: Float64, dark_e2: float, black_sigma_e: float, full_well_e: float
) -> ArcLevel:
    """Return the arc's level by pixels (n,); NaN where they do not determine it."""
    if len(map_e) < MIN_PIXELS or not (map_e > 0.0).any():
        return UNKNOWN
    size = np.empty(len(map_e))
    start = max(0.0, quantile(charge_e, 0.5) / (quantile(map_e, 0.5) + 1e-9))
    level, sigma, black = _fit_level(map_e, charge_e, dark_e2, black_sigma_e, start, size)
    # An offset of more of the black level's sigmas is light of the hall: no black level is stated so wrongly.
    if black > 5.0 * black_sigma_e:
        level, sigma, black = _fit_level(map_e, charge_e, dark_e2, full_well_e, level, size)
    # Where the sheet hides the arc, its level may be anything.
    if not sigma < MAX_SIGMA * max(level, 1.0):
        return UNKNOWN
    return ArcLevel(level, sigma, black, quantile(size, MISFIT_QUANTILE) / NORMAL_QUANTILE, True, 0.0)


@kernel(fastmath=REDUCTION)
def _fit_level(
    map_e: Float64,
    charge_e: Float64,
    dark_variance_e2: float,
    black_sigma_e: float,
    start: float,
    size: Float64,
) -> tuple[float, float, float]:
    """Fit charge = level * map + black to pixels (n,); return the level, its 1 sigma and the black level.

    Weighted least squares with Huber weights; the black level's prior is 0 +- `black_sigma_e`. Writes the
    residuals' `size` (n,), in their sigmas.
    """
    level, black = start, 0.0
    prior = 1.0 / black_sigma_e**2
    h_ll, determinant = 0.0, 1.0
    h_bb = prior
    for _ in range(MAX_STEPS):
        h_ll, h_lb, h_bb, g_l, g_b = 0.0, 0.0, prior, 0.0, -prior * black
        for i in range(map_e.shape[0]):
            m = map_e[i]
            mean = level * m + black
            off = charge_e[i] - mean
            variance = max(mean, 0.0) + dark_variance_e2 + (MAP_SIGMA * level * m) ** 2
            size[i] = abs(off) / math.sqrt(variance)
            weight = min(1.0, HUBER / max(size[i], 1e-9)) / variance
            h_ll += weight * m * m
            h_lb += weight * m
            h_bb += weight
            g_l += weight * m * off
            g_b += weight * off
        determinant = h_ll * h_bb - h_lb * h_lb
        step = (h_bb * g_l - h_lb * g_b) / determinant
        level = max(level + step, 0.0)
        black += (h_ll * g_b - h_lb * g_l) / determinant
        if abs(step) < LEVEL_SETTLED * max(level, 1e-3):
            break
    return level, math.sqrt(h_bb / determinant), black
