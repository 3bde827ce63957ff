"""What real pictures show beside stripe and arc: light of the hall, the plates' look, ghosts and glints.

The look is one reflectance for all light: a texture that lies on the metal, plates that are unlike, and bands
along the seam. A closed butt is such a band on a flat plate: no light comes back out of a slit so narrow and
so deep. Bands are averaged over each pixel's footprint, so that they may be far narrower than a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter, shift

from noise_model.compiled.arrays import Float64, Integers
from validation.anywhere.swept_joint import SweptJoint, normal_at, place
from validation.anywhere.swept_welding import Welding

TILE = 512
"""Cells of the texture to each side; it repeats."""

CELLS_PER_GRAIN = 2.0
DARKEST = 0.05
"""No part of a texture reflects less of what its mean does."""

GLINT_WELLS, GLINT_SIGMA_PX = (1.5, 6.0), (0.7, 4.0)
"""Peaks of glints in full wells, and their sizes."""

NEAR_PEAK = 0.3
"""Glints lie about pixels with so much of the stripe's peak."""


class SlitBand(NamedTuple):
    """A band along the seam: its y from the seam and width, mm, and its reflectance over the plate's."""

    y_mm: float
    width_mm: float
    share: float


@dataclass(frozen=True)
class Look:
    """How the metal reflects, over its mean.

    The texture's contrast, grain, mm, and seed; by how much the plate at y > 0 is brighter; bands along the
    seam.
    """

    contrast: float = 0.0
    grain_mm: float = 1.0
    seed: int = 0
    unlike: float = 0.0
    bands: tuple[SlitBand, ...] = ()


@dataclass(frozen=True)
class Ghost:
    """A second stripe: the first one's light moved by (du, dv), px, at a share of its strength."""

    shift_px: tuple[float, float]
    strength: float


@dataclass(frozen=True)
class SceneSurroundings:
    """What else is in the picture.

    The metal's look; the hall's light that a level plate sends to the image's middle, e-; a ghost; so many
    glints a frame, within `glint_reach_px` of the stripe; and what a burning arc adds.
    """

    look: Look = Look()
    hall_e: float = 0.0
    ghost: Ghost | None = None
    n_glints: int = 0
    glint_reach_px: float = 0.0
    welding: Welding | None = None


def texture(look: Look) -> Float64:
    """Return a look's texture (TILE, TILE), which repeats: its mean is 1."""
    grains = np.random.default_rng([look.seed, 3]).standard_normal((TILE, TILE))
    field = gaussian_filter(grains, 1.0, mode="wrap")
    return np.asarray(np.maximum(1.0 + look.contrast * field / field.std(), DARKEST))


def seen_metal(
    met: Float64, faces: Integers, joint: SweptJoint, shape: tuple[int, int], look: Look, tile: Float64
) -> tuple[Float64, Float64]:
    """Return the metal's reflectance and the share of an even sky above it, (H, W) each; 0 off the metal.

    The pixels' rays meet the metal at `met` (H W, 3), on `faces` (H W,).
    """
    places = np.zeros((len(met), 4))
    _surface(met, faces, joint.corners, joint.bend, places)
    x, along, y, sky = (places[:, i].reshape(shape) for i in range(4))
    cells = (CELLS_PER_GRAIN / look.grain_mm * np.stack([x, along])) % TILE
    u, v = cells.astype(np.float32)
    # Of single precision: scenes are the same to the bit.
    share: Any = cv2.remap(tile, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    footprint = np.maximum(*np.abs(np.gradient(y)))
    share *= 1.0 + look.unlike * _covered(y, footprint, 0.0, math.inf)
    for band in look.bands:
        low, high = band.y_mm - 0.5 * band.width_mm, band.y_mm + 0.5 * band.width_mm
        share *= 1.0 + (band.share - 1.0) * _covered(y, footprint, low, high)
    return share, sky


def _covered(y: Float64, footprint: Float64, low: float, high: float) -> Float64:
    """Return which share of each pixel lies between two y."""
    half = 0.5 * np.maximum(footprint, 1e-9)
    covered = np.clip(np.minimum(y + half, high) - np.maximum(y - half, low), 0.0, None)
    return np.asarray(covered / (2.0 * half))


@njit(cache=True)
def _surface(met, faces, corners, bend, places):  # type: ignore[no-untyped-def]
    """Write x, the way along the section, y from the seam's middle, and the sky's share (n, 4)."""
    starts = np.zeros(corners.shape[0])
    for k in range(1, corners.shape[0]):
        dy, dz = corners[k, 0] - corners[k - 1, 0], corners[k, 1] - corners[k - 1, 1]
        starts[k] = starts[k - 1] + math.hypot(dy, dz)
    for i in range(met.shape[0]):
        k, p = faces[i], met[i]
        if k < 0:
            continue
        station, y, z, _, _ = place(p, bend)
        places[i, 0] = station
        places[i, 1] = starts[k] + math.hypot(y - corners[k, 0], z - corners[k, 1])
        places[i, 2] = y
        # Of an even sky a slope sees (1 + cos) / 2.
        places[i, 3] = 0.5 * (1.0 + normal_at(p, k, corners, bend)[2])


def with_ghost(stripe: Float64, ghost: Ghost) -> Float64:
    """Return a stripe's light (H, W) with its ghost's."""
    du, dv = ghost.shift_px
    return stripe + ghost.strength * np.asarray(shift(stripe, (dv, du), order=1))


def glints(
    stripe: Float64, around: SceneSurroundings, full_well_e: float, draw: np.random.Generator
) -> Float64:
    """Return the light (H, W), e-, of round glints about a stripe, each beyond the full well."""
    light = np.zeros_like(stripe)
    rows, columns = np.nonzero(stripe > NEAR_PEAK * stripe.max())
    v, u = np.indices(stripe.shape)
    for _ in range(around.n_glints):
        near = draw.integers(len(rows))
        du, dv = around.glint_reach_px * draw.uniform(-1.0, 1.0, 2)
        sigma, wells = draw.uniform(*GLINT_SIGMA_PX), draw.uniform(*GLINT_WELLS)
        far2 = (u - columns[near] - du) ** 2 + (v - rows[near] - dv) ** 2
        light += wells * full_well_e * np.exp(-0.5 * far2 / sigma**2)
    return light
