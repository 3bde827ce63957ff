"""The band of the image around the expected stripe: its pixels as charge, and the arc map there."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Bool, Float32, Float64, Int64, Integers
from noise_model.compiled.kernel import kernel
from tracker.geometry import ImageSource

FIT_SIGMAS = 5.0
"""Background of the band beyond the reach of the search, in stripe sigmas: the fit reads four, and
a second stripe next to them has to be seen."""


_NEAR_PX = np.uint64(64)


class Band(NamedTuple):
    """A band's pixels (n_scan, depth), e-, that begin at `lows` (n_cells,) for each CELL scan lines.

    `background` is the arc's light and the black level, later with a second stripe's `light`; `plain` is room
    for it without that.
    """

    charge: Float32
    background: Float32
    light: Float32
    plain: Float32
    censored: Bool
    lows: Int64


@kernel
def place(center_px: Float64, n_pos: int, half_px: int, lows: Int64) -> int:
    """Write the start of the band that holds +-half_px for each CELL scan lines; return its depth."""
    n_scan, n, spread = center_px.shape[0], lows.shape[0], 0.0
    for i in range(n):
        lowest, highest = _ends(center_px, i * CELL, min((i + 1) * CELL, n_scan))
        spread = max(spread, highest - lowest)
    depth = min(n_pos, 2 * half_px + math.ceil(min(spread, float(half_px))) + 1)
    for i in range(n):
        lowest, highest = _ends(center_px, i * CELL, min((i + 1) * CELL, n_scan))
        lows[i] = min(max(round(0.5 * (lowest + highest) - 0.5 * depth), 0), n_pos - depth)
    return depth


@kernel(inline=True)
def _ends(values: Float64, first: int, end: int) -> tuple[float, float]:
    """Return the least and the largest of some values."""
    lowest, highest = values[first], values[first]
    for s in range(first, end):
        lowest, highest = min(lowest, values[s]), max(highest, values[s])
    return lowest, highest


@kernel
def gather(
    image_dn: Integers,
    along_rows: bool,
    lows: Int64,
    charge_e: Float32,
    saturation_dn: int,
    band: Float32,
    censored: Bool,
) -> None:
    """Copy a band (n_scan, depth) out of an image, linearised by the table `charge_e`.

    A code beyond the sensor's bits counts as the table's last.
    """
    # Unsigned, so that no index is asked whether it counts from the end.
    n_scan, depth, cell_lines = np.uint64(band.shape[0]), np.uint64(band.shape[1]), np.uint64(CELL)
    first, max_dn, saturation = np.uint64(0), np.uint64(len(charge_e) - 1), np.uint64(saturation_dn)
    for cell in range(lows.shape[0]):
        low, end = np.uint64(lows[cell]), min(first + cell_lines, n_scan)
        # Lines of so few positions at a time that the image's pixels stay in the nearest cache.
        for top in range(np.uint64(0), depth, _NEAR_PX):
            bottom = min(top + _NEAR_PX, depth)
            for s in range(first, end):
                for j in range(top, bottom):
                    dn = np.uint64(image_dn[low + j, s] if along_rows else image_dn[s, low + j])
                    band[s, j] = charge_e[min(dn, max_dn)]
                    censored[s, j] = dn >= saturation
        first = end


class LightLevel(NamedTuple):
    """By what light is to be multiplied, and the charge, e-, that is to be added."""

    level: float
    black_e: float


@kernel
def at_level(background_e: Float32, to: LightLevel) -> None:
    """Bring light (n_scan, depth), e-, to a level."""
    per_e, black = np.float32(to.level), np.float32(to.black_e)
    for s in range(background_e.shape[0]):
        for j in range(background_e.shape[1]):
            background_e[s, j] = background_e[s, j] * per_e + black


@kernel
def weigh(
    charge_e: Float32,
    background_e: Float32,
    shot: float,
    dark_variance_e2: float,
    residual_e: Float32,
    variance_e2: Float32,
) -> None:
    """Write a line's charge (n,) less its background, and its variance without a stripe.

    That is `shot` times the background, which counts as 0 where it is less, plus `dark_variance_e2`.
    """
    per_e, dark = np.float32(shot), np.float32(dark_variance_e2)
    for j in range(charge_e.shape[0]):
        mean = background_e[j]
        residual_e[j] = charge_e[j] - mean
        variance_e2[j] = per_e * (np.float32(0.0) if mean < 0.0 else mean) + dark


@kernel(allocates=True)
def median_background(band: Float32, half: int, background: Float32) -> None:
    """Write the running median over 2 half + 1 pixels of each scan line: a background without an arc map."""
    n_scan, depth = band.shape
    held = np.empty(2 * half + 1, np.float32)
    for s in range(n_scan):
        n = 0
        for j in range(min(half, depth)):
            n = _insert(held, n, band[s, j])
        for j in range(depth):
            if j + half < depth:
                n = _insert(held, n, band[s, j + half])
            middle = n // 2
            both = held[middle] + (held[middle] if n % 2 == 1 else held[middle - 1])
            background[s, j] = np.float32(0.5) * both
            if j >= half:
                n = _remove(held, n, band[s, j - half])


@kernel
def _insert(held: Float32, n: int, value: np.float32) -> int:
    """Put a value among the first n, which rise; return how many there are then."""
    k = n
    while k > 0 and held[k - 1] > value:
        held[k] = held[k - 1]
        k -= 1
    held[k] = value
    return n + 1


@kernel
def _remove(held: Float32, n: int, value: np.float32) -> int:
    """Take a value out of the first n; return how many are left."""
    k = 0
    while held[k] < value:
        k += 1
    for i in range(k, n - 1):
        held[i] = held[i + 1]
    return n - 1


def gather_band(image_dn: Integers, image: ImageSource, center_px: Float64, half_px: int, room: Band) -> Band:
    """Return the band of +-`half_px` about a stripe's expected centres (n_scan,), its charge in e-.

    The `room` is flat, for any depth.
    """
    depth = place(center_px, image.n_pos, half_px, room.lows)
    shape = center_px.shape[0], depth
    n = shape[0] * depth
    band = Band(
        room.charge[:n].reshape(shape),
        room.background[:n].reshape(shape),
        room.light[:n].reshape(shape),
        room.plain[:n].reshape(shape),
        room.censored[:n].reshape(shape),
        room.lows,
    )
    codes = image.charge_e, image.saturation_dn
    gather(image_dn, image.along_rows, room.lows, *codes, band.charge, band.censored)
    return band
