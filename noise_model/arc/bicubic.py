"""A cell of the image as a bicubic polynomial through its nodes."""

from __future__ import annotations

import functools
import math

import numpy as np

from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.lanes import N_LANES, load, spread, store

LARGEST = 64
"""The largest cell, px."""

N = 4
"""Nodes of a cell along each direction."""

DECAY = 0.1
"""Ratio of the highest coefficient of a smooth light to the one before."""


@functools.lru_cache(maxsize=1)
def node_rules() -> tuple[Int64, Float64]:
    """Return by a cell's size (n + 1, 4) the nodes' pixels, and (n + 1, 4, 4) from values to coefficients.

    The coefficients are those of 1, t, t^2, t^3 for t from -1 at the cell's first pixel to 1 at its last.
    """
    places, rules = np.zeros((LARGEST + 1, N), dtype=np.int64), np.zeros((LARGEST + 1, N, N))
    for size in range(N, LARGEST + 1):
        places[size] = np.rint(np.linspace(0.0, size - 1.0, N))
        rules[size] = np.linalg.inv(np.vander(2.0 * places[size] / (size - 1.0) - 1.0, increasing=True))
    return places, rules


@kernel
def to_powers(
    values: Float64, rules: Float64, size: tuple[int, int], powers: Float64
) -> tuple[float, float, float]:
    """Turn a cell's values (16,) into coefficients (4, 4); return its highest terms and its least value.

    The terms are those across the scan lines and along them.
    """
    rows, columns = rules[size[0]], rules[size[1]]
    minimum = math.inf
    for j in range(N):
        for a in range(N):
            powers[a, j] = (
                rows[a, 0] * values[0 + j]
                + rows[a, 1] * values[4 + j]
                + rows[a, 2] * values[8 + j]
                + rows[a, 3] * values[12 + j]
            )
            minimum = min(minimum, values[4 * a + j])
    across, along = 0.0, 0.0
    for i in range(N):
        v_0, v_1, v_2, v_3 = values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]
        cubic = columns[3, 0] * v_0 + columns[3, 1] * v_1 + columns[3, 2] * v_2 + columns[3, 3] * v_3
        square = columns[2, 0] * v_0 + columns[2, 1] * v_1 + columns[2, 2] * v_2 + columns[2, 3] * v_3
        # T_3 = 4 t^3 - 3 t, T_2 = 2 t^2 - 1: a kink may show in one of them alone.
        across = max(across, 0.25 * abs(powers[3, i]), 0.5 * DECAY * abs(powers[2, i]))
        along = max(along, 0.25 * abs(cubic), 0.5 * DECAY * abs(square))
    for a in range(N):
        v_0, v_1, v_2, v_3 = powers[a, 0], powers[a, 1], powers[a, 2], powers[a, 3]
        for b in range(N):
            powers[a, b] = (
                columns[b, 0] * v_0 + columns[b, 1] * v_1 + columns[b, 2] * v_2 + columns[b, 3] * v_3
            )
    # What is not known at a node is in every coefficient.
    if math.isnan(powers[0, 0]):
        return math.inf, math.inf, 0.0
    return across, along, minimum


@kernel(fastmath={"contract"})
def fill_row(
    powers: Float64, t: float, step: float, start: int, ramp: Float32, line: Float32, first: int, last: int
) -> None:
    """Write line[first : last] from a cell's coefficients at t; along the line it begins at `start`."""
    c_0 = np.float32(powers[0, 0] + t * (powers[1, 0] + t * (powers[2, 0] + t * powers[3, 0])))
    c_1 = np.float32(powers[0, 1] + t * (powers[1, 1] + t * (powers[2, 1] + t * powers[3, 1])))
    c_2 = np.float32(powers[0, 2] + t * (powers[1, 2] + t * (powers[2, 2] + t * powers[3, 2])))
    c_3 = np.float32(powers[0, 3] + t * (powers[1, 3] + t * (powers[2, 3] + t * powers[3, 3])))
    along, origin, n = np.float32(step), np.float32(-1.0 + step * (first - start)), last - first
    if n < N_LANES:
        for j in range(n):
            u = origin + along * ramp[j]
            line[first + j] = c_0 + u * (c_1 + u * (c_2 + u * c_3))
        return
    # A loop over numbers leaves what does not fill its vectors to single ones: a row is seldom longer.
    d_0, d_1, d_2, d_3 = spread(c_0), spread(c_1), spread(c_2), spread(c_3)
    for k in range(0, n, N_LANES):
        j = min(k, n - N_LANES)
        v = spread(origin) + spread(along) * load(ramp, j)
        store(line, first + j, d_0 + v * (d_1 + v * (d_2 + v * d_3)))
