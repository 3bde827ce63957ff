"""A corrugation's height at sixteen stations at once; see `faces.raised`."""

from __future__ import annotations

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.lanes import Lanes, floor, greater, spread
from noise_model.surface.faces import RAISED_COSINE

Corrugation = tuple[float, float, float]
"""Height, width and pitch, mm; height 0 where there is none."""


@kernel(inline=True)
def corrugation_of(sizes: Float64) -> Corrugation:
    """Return the corrugation of a `joint.Section`'s array (3,)."""
    return sizes[0], sizes[1], sizes[2]


@kernel(inline=True)
def from_crest(x: float, corrugation: Corrugation) -> float:
    """Return a station, mm, counted from the nearest crest: single precision holds it better there."""
    height, _, pitch = corrugation
    return float(x - pitch * np.floor(x / pitch + 0.5)) if height > 0.0 else x


@kernel(inline=True)
def _share(x: Lanes, corrugation: Corrugation) -> Lanes:
    """Return the distance of stations, mm, from the nearest crest, in half widths."""
    _, width, pitch = corrugation
    offset = x - spread(pitch) * floor(x * spread(1.0 / pitch) + spread(0.5))
    return offset * spread(2.0 / width)


@kernel(inline=True)
def wave(x: Lanes, corrugation: Corrugation) -> Lanes:
    """Return the corrugation's height, mm, at stations, mm."""
    height, _, _ = corrugation
    if height == 0.0:
        return spread(0.0)
    share = _share(x, corrugation)
    rest = greater(spread(1.0) - share * share, spread(0.0))
    v = spread(1.0) - rest
    g = spread(RAISED_COSINE[5]) + v * (spread(RAISED_COSINE[6]) + v * spread(RAISED_COSINE[7]))
    g = spread(RAISED_COSINE[3]) + v * (spread(RAISED_COSINE[4]) + v * g)
    g = spread(RAISED_COSINE[1]) + v * (spread(RAISED_COSINE[2]) + v * g)
    return spread(height) * rest * rest * (spread(RAISED_COSINE[0]) + v * g)


@kernel(inline=True)
def wave_and_slope(x: Lanes, corrugation: Corrugation) -> tuple[Lanes, Lanes]:
    """Return the corrugation's height, mm, and slope at stations, mm."""
    height, width, _ = corrugation
    share = _share(x, corrugation)
    rest = greater(spread(1.0) - share * share, spread(0.0))
    v = spread(1.0) - rest
    g, dg = spread(RAISED_COSINE[7]), spread(0.0)
    for i in range(6, -1, -1):
        dg = dg * v + g
        g = g * v + spread(RAISED_COSINE[i])
    # c = H rest^2 g(v), v the share squared.
    by_v = rest * (rest * dg - (g + g))
    return spread(height) * rest * rest * g, spread(4.0 * height / width) * share * by_v
