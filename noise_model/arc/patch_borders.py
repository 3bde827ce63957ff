"""Borders of the patches of a face's table, along the station x and along the way s across the face.

Light changes its form where a ridge or the arc begins and ends along x and, across a plain section's faces,
at the borders of penumbrae.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.arc.chords import insert
from noise_model.arc.ray import ArcKernel
from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.surface.faces import Strip, strip
from noise_model.surface.visibility import is_curved_lap

PATCH_MM, CURVED_PATCH_MM = 48.0, 16.0
"""The largest patch, and the largest where borders of shadows may run across the patches, uncut."""

MIN_SEEN_MM = 1.0
"""A face that the camera sees less of is taken to be seen so far."""

MAX_BORDERS = 64
"""Room for the borders between patches, along each coordinate."""


@kernel(inline=True)
def seen_strip(face: int, vertices: Float64) -> Strip:
    """Return a face's strip, s of the first face counted from its edge: its other end is far away."""
    y_0, z_0, ty, tz, width = strip(face, vertices)
    if face == 0:
        return vertices[1, 0], vertices[1, 1], ty, tz, width
    return y_0, z_0, ty, tz, width


@kernel
def _add_border(borders: Float64, n: int, place: float) -> int:
    """Put a border among the n sorted ones unless it is outside or too near to one of them."""
    for i in range(n):
        # Borders nearer to each other than this are one.
        if abs(borders[i] - place) < 0.2:
            return n
    return insert(borders, n, place)


@kernel
def _fill_in(k: ArcKernel, borders: Float64, n: int) -> int:
    """Add borders until no interval is wider than a patch may be."""
    is_straight = k.corrugation[0] == 0.0 and k.bend[0] == 0.0 and k.bend[1] == 0.0
    largest = PATCH_MM if is_straight else CURVED_PATCH_MM
    i = 0
    while i < n - 1 and n < borders.shape[0]:
        width = borders[i + 1] - borders[i]
        if width > largest:
            n = _add_border(borders, n, borders[i] + width / math.ceil(width / largest))
        i += 1
    return n


@kernel
def _penumbrae(k: ArcKernel, face: int, borders: Float64, n: int) -> int:
    """Add the borders of the penumbrae that a plain section's vertices cast on a face.

    In the section the arc is a disc; from a vertex two lines touch it and two pass the ends of its level
    diameter. Where they meet the face, beyond the vertex, a shadow begins or ends.
    """
    cy, cz = k.center[1] - k.bend[1], k.center[2]
    y_0, z_0, dy, dz, _ = seen_strip(face, k.vertices)
    for j in range(1, k.vertices.shape[0] - 1):
        if j in (face, face + 1):
            continue
        vy, vz = k.vertices[j, 0], k.vertices[j, 1]
        to_y, to_z = cy - vy, cz - vz
        square = to_y * to_y + to_z * to_z
        for which in range(4):
            sign = 1.0 if which % 2 == 0 else -1.0
            if which < 2:
                if square <= k.radius * k.radius:
                    continue
                # The direction to the centre, turned by asin(R / distance).
                cos_t, sin_t = math.sqrt(square - k.radius * k.radius), sign * k.radius
                ly, lz = to_y * cos_t - to_z * sin_t, to_y * sin_t + to_z * cos_t
            else:
                ly, lz = to_y + sign * k.radius, to_z
            turn = ly * dz - lz * dy
            if abs(turn) < 1e-12:
                continue
            s = ((z_0 - vz) * ly - (y_0 - vy) * lz) / -turn
            way = (y_0 + s * dy - vy) * ly + (z_0 + s * dz - vz) * lz
            s = s if way < 0.0 else math.nan
            n = _add_border(borders, n, s)
    return n


@kernel(allocates=True)
def borders_along(k: ArcKernel) -> Float64:
    """Return the borders (n,) along the stations that the camera sees: of ridges, and the arc's ends.

    A ridge begins and ends at half its width from its middle. Where the lower sheet of a lap rises over the
    level part of the upper one, its points begin to see the arc's foot past that sheet's edge.
    """
    x_low, x_high, _, _ = k.reach
    borders = np.empty(MAX_BORDERS)
    # An image one pixel high may see no length of a plate.
    borders[0], borders[1] = x_low, max(x_high, x_low + MIN_SEEN_MM)
    n = 2
    if k.corrugation[0] > 0.0:
        height, width, pitch = k.corrugation
        step = k.vertices[1, 1] - k.vertices[2, 1]
        sides = (0.5 * width, 0.5 * width)
        if 0.0 < step < height:
            # Of the height (1 + cos(2 pi x / width)) / 2 of it.
            sides = (0.5 * width, width / (2.0 * math.pi) * math.acos(2.0 * step / height - 1.0))
        for i in range(math.floor(x_low / pitch) - 1, math.ceil(x_high / pitch) + 2):
            for side in sides:
                n = _add_border(borders, n, i * pitch - side)
                n = _add_border(borders, n, i * pitch + side)
        for side in (-1.0, 1.0):
            n = _add_border(borders, n, k.center[0] + side * k.radius)
    n = _fill_in(k, borders, n)
    return borders[:n].copy()


@kernel
def borders_across(k: ArcKernel, face: int, margin_mm: float, borders: Float64) -> int:
    """Write the borders (MAX_BORDERS,) across a face, continued by a margin; return how many."""
    _, _, y_low, y_high = k.reach
    # A curved lap's faces are read where they are seen alone: beyond their edges the light is another.
    margin_mm = -1e-9 if is_curved_lap(k.vertices, k.corrugation, k.bend) else margin_mm
    y, _, _, _, length = seen_strip(face, k.vertices)
    borders[0] = min(y_low - y, -MIN_SEEN_MM) if face == 0 else -margin_mm
    borders[1] = max(y_high - y, MIN_SEEN_MM) if face == k.vertices.shape[0] - 2 else length + margin_mm
    if face == 0:
        borders[1] = margin_mm
    n = 2
    if k.corrugation[0] == 0.0:
        n = _penumbrae(k, face, borders, n)
    return _fill_in(k, borders, n)
