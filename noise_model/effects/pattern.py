"""Patterns fixed to the part: they move with it, and stay while robot and part stand still."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.special import ndtri

from noise_model.compiled.arrays import Bool, Float64, Int64
from noise_model.stripe import stripe_depth_mm
from noise_model.view import View

REACH = 3
"""Number of nodes to either side of a point that contribute: a node is one sigma of the kernel from the next.
"""

_GOLDEN, _ROW, _FIRST, _SECOND = (
    0x9E3779B97F4A7C15,
    0xC2B2AE3D27D4EB4F,
    0xBF58476D1CE4E5B9,
    0x94D049BB133111EB,
)
"""Odd multipliers: of the seed, of a row, and splitmix64's own (Steele, Lea and Flood 2014, OOPSLA)."""


def part_seed(view: View, draw: np.random.Generator) -> int:
    """Return the seed of a view's part; where it has none, another one at each call."""
    return int(draw.integers(2**32)) if view.part_seed is None else view.part_seed


def in_image_px(view: View, where: Bool) -> Float64:
    """Return the places (n, 2), px, at which the level camera sees the surface points of some pixels (...,).

    It is a parallel projection along the camera's axis, at the scale of the stripe on a plate at tool height.
    A point of the part has the same place from every pose. What is even in these places looks even in the
    image, however a face is inclined. NaN past the workpiece.
    """
    camera = view.setup.camera
    per_mm = np.array([camera.fx, camera.fy]) / stripe_depth_mm(view.setup)
    axes = camera.T_tool_camera[:3, :2] * per_mm
    return np.asarray(view.surface[0][where] @ axes)


def normal_field(places: Float64, grain: float, seed: int) -> Float64:
    """Return a Gaussian field (n,) of unit variance at places (n, 2), of correlation exp(-d^2 / 4 grain^2).

    White noise on a square lattice, `grain` apart, seen through a Gaussian of 1 sigma `grain`. Each node's
    number comes from its row, its column and the seed alone. 0 at a place that is NaN.
    """
    field = np.zeros(len(places))
    is_known = ~np.isnan(places[:, 0])
    if not is_known.any():
        return field
    scaled = places[is_known] / grain
    nearest = np.rint(scaled)
    apart = scaled - nearest
    # Only the nodes that are needed: a view far along the seam is far from the lattice's origin.
    first = nearest.min(axis=0).astype(np.int64) - REACH
    last = nearest.max(axis=0).astype(np.int64) + REACH
    noise = _white(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1), seed)
    i, j = (nearest.astype(np.int64) - first).T
    total, square = np.zeros((2, len(scaled)))
    for di, dj in product(range(-REACH, REACH + 1), repeat=2):
        weight = np.exp(-0.5 * ((apart[:, 0] - di) ** 2 + (apart[:, 1] - dj) ** 2))
        total += weight * noise[i + di, j + dj]
        square += weight**2
    field[is_known] = total / np.sqrt(square)
    return field


def _white(rows: Int64, columns: Int64, seed: int) -> Float64:
    """Return independent normal numbers (n_rows, n_columns) of a lattice's nodes."""
    x = rows.astype(np.uint64)[:, np.newaxis] * np.uint64(_ROW) + columns.astype(np.uint64)
    for multiplier in (_GOLDEN * (2 * seed + 1) % 2**64, _FIRST, _SECOND):
        x = (x ^ (x >> np.uint64(30))) * np.uint64(multiplier)
    x ^= x >> np.uint64(31)
    return np.asarray(ndtri((x >> np.uint64(11)).astype(np.float64) * 2.0**-53 + 2.0**-54))
