"""Bands in which one stripe ends and another begins, drawn from closed forms, and profiles of their lines."""

from __future__ import annotations

import math

import numpy as np
from profiles import Profile
from scipy.special import ndtr

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Float64
from tracker.stripe.light import NO_LIGHT, EdgeLines, StripeLight

N_SCAN, DEPTH, EDGE = 64, 96, 31
WIDTH_PX, PSF_PX, DARK_E2 = 5.0, 0.8, 100.0


def correlated_lines(rng: np.random.Generator, correlation: float) -> Float64:
    """N_SCAN numbers of variance 1, two neighbours' correlation being `correlation`."""
    numbers = rng.standard_normal(N_SCAN)
    for s in range(1, N_SCAN):
        numbers[s] = correlation * numbers[s - 1] + math.sqrt(1.0 - correlation**2) * numbers[s]
    return numbers


def light_of(
    rng: np.random.Generator,
    ends: float,
    begins: float,
    *,
    apart_px: float = 12.0,
    peak_e: float = 3000.0,
    contrast: float = 0.0,
    correlation: float = 0.0,
    scatter_px: float = 0.0,
    noise: bool = True,
    flipped: bool = False,
    edge: EdgeLines = NO_LIGHT.edge,
    side_share: float = 0.0,
) -> StripeLight:
    """A stripe that ends at a line and one, `apart_px` off and sloped, that begins at another.

    Both end along a parabola `edge` across the stripe, of which the places are those at their own centres;
    between them there is a share of the first.
    """
    s, r = np.arange(N_SCAN, dtype=float), np.arange(DEPTH, dtype=float)
    upper, lower = 40.3 + 0.1031 * (s - EDGE), 40.3 + apart_px - 0.1517 * (s - EDGE)
    moved_px = scatter_px * rng.standard_normal(N_SCAN)
    bells = (np.exp(-0.5 * ((r - (run + moved_px)[:, None]) / WIDTH_PX) ** 2) for run in (upper, lower))
    u, v = (peak_e * np.exp(contrast * correlated_lines(rng, correlation))[:, None] * bell for bell in bells)
    upper_px, lower_px = 40.3 + 0.1031 * (ends - EDGE), 40.3 + apart_px - 0.1517 * (begins - EDGE)
    away = [edge.skew * (r - place) + edge.bend * (r - place) ** 2 for place in (upper_px, lower_px)]
    before, behind = (
        ndtr((ends + away[0] - s[:, None]) / PSF_PX),
        ndtr((s[:, None] - begins - away[1]) / PSF_PX),
    )
    mean = (before + side_share * (1.0 - before - behind)) * u + behind * v + 500.0
    charge = rng.normal(mean, np.sqrt(mean + DARK_E2)) if noise else mean
    position = np.where(s < 0.5 * (ends + begins), upper, lower) + moved_px
    if flipped:
        charge, position = charge[::-1], position[::-1]
    return StripeLight(
        np.ascontiguousarray(charge, dtype=np.float32),
        np.full(charge.shape, 500.0, dtype=np.float32),
        np.zeros(charge.shape, dtype=bool),
        np.zeros(-(-N_SCAN // CELL), dtype=np.int64),
        np.ascontiguousarray(position),
        np.full(N_SCAN, WIDTH_PX),
        1.0,
        DARK_E2,
        contrast,
        correlation,
        PSF_PX,
        edge,
        scatter_px,
    )


def profile_of(light: StripeLight) -> Profile:
    """Points a column of 0.1 mm apart, y = 0 at line EDGE."""
    scan = np.arange(N_SCAN, dtype=float)
    one = np.ones(N_SCAN)
    return Profile(
        0.1 * (scan - EDGE), 0.0 * one, 0.0 * one, 0.1 * one, 0.05 * one, scan, 0.1, 0.05 * one, light=light
    )
