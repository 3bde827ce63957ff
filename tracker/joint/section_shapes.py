"""The shapes that a section's fit knows: polylines over y whose corners follow from a few parameters."""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel

GROOVE, SHEETS, HALF_GROOVE, ROUND_GROOVE, CORNER = 0, 1, 2, 3, 4
"""The shapes: a groove with two bevels and a root; two sheets with a step between them; a groove with an
upright side and a bevel; one whose root is rounded; two plates that meet."""

CHORDS = 24
"""The chords of a rounding: of 3 mm and through 70 degrees they lie off it by 1 um on average."""

N_CORNERS = (6, 4, 6, 4 + 2 * CHORDS, 3)
"""The corners of each shape."""

FAR_MM = 1000.0
"""Width of the outer faces."""


@kernel
def corners_of(shape: int, p: Float64, corners: Float64) -> None:
    """Write the corners (n, 2) as (y, z), mm, y rising, that parameters put a shape's faces between.

    The left is where y is larger; slopes are dz/dy. Of a groove: root middle y and z, root gap, tan of the
    left and right bevel angle, left and right depth, slopes of the left and right plate, and if it is round
    the rounding's radius. Of a half groove: root gap, root z, tan of the left bevel angle, left and right
    depth, slopes of the left and right plate, y of the upright side. Of sheets: the left one's z at the
    step, the step up to the right one, the slopes of the left and the right sheet, and the step's y. Of a
    corner: its y and z, the slopes of the left and the right plate.
    """
    if shape == GROOVE:
        y, z, gap = p[0], p[1], p[2]
        # Less than no gap: the bevels meet above the root's place.
        half, closed = 0.5 * max(gap, 0.0), 0.5 * max(-gap, 0.0)
        left, right = y + 0.5 * gap + p[5] * p[3], y - 0.5 * gap - p[6] * p[4]
        corners[0, 0], corners[0, 1] = right - FAR_MM, z + p[6] - p[8] * FAR_MM
        corners[1, 0], corners[1, 1] = right, z + p[6]
        corners[2, 0], corners[2, 1] = y - half, z + closed / p[4]
        corners[3, 0], corners[3, 1] = y + half, z + closed / p[3]
        corners[4, 0], corners[4, 1] = left, z + p[5]
        corners[5, 0], corners[5, 1] = left + FAR_MM, z + p[5] + p[7] * FAR_MM
    elif shape == SHEETS:
        z, step, y = p[0], p[1], p[4]
        corners[0, 0], corners[0, 1] = y - FAR_MM, z + step - p[3] * FAR_MM
        corners[1, 0], corners[1, 1] = y, z + step
        corners[2, 0], corners[2, 1] = y, z
        corners[3, 0], corners[3, 1] = y + FAR_MM, z + p[2] * FAR_MM
    elif shape == HALF_GROOVE:
        gap, z, wall = p[0], p[1], p[7]
        open_gap, closed = max(gap, 0.0), max(-gap, 0.0)
        left = wall + gap + p[3] * p[2]
        corners[0, 0], corners[0, 1] = wall - FAR_MM, z + p[4] - p[6] * FAR_MM
        corners[1, 0], corners[1, 1] = wall, z + p[4]
        corners[2, 0], corners[2, 1] = wall, z + closed / p[2]
        corners[3, 0], corners[3, 1] = wall + open_gap, z + closed / p[2]
        corners[4, 0], corners[4, 1] = left, z + p[3]
        corners[5, 0], corners[5, 1] = left + FAR_MM, z + p[3] + p[5] * FAR_MM
    elif shape == ROUND_GROOVE:
        y, z, half = p[0], p[1], 0.5 * max(p[2], 0.0)
        _rounded_side((y + half, z), 1.0, p[3], p[5], p[9], p[7], corners)
        _rounded_side((y - half, z), -1.0, p[4], p[6], p[9], p[8], corners)
    else:
        y, z = p[0], p[1]
        corners[0, 0], corners[0, 1] = y - FAR_MM, z - p[3] * FAR_MM
        corners[1, 0], corners[1, 1] = y, z
        corners[2, 0], corners[2, 1] = y + FAR_MM, z + p[2] * FAR_MM


@kernel
def _rounded_side(
    end: tuple[float, float],
    side: float,
    tan: float,
    depth: float,
    radius: float,
    slope: float,
    corners: Float64,
) -> None:
    """Write one side of a round groove from the root's end (y, z): `side` 1 for the left, -1 the right.

    The rounding is the polygon about it, whose first and last sides are the root's and the bevel's.
    """
    (y, z), bevel = end, math.atan(tan)
    half_step = 0.5 * (0.5 * math.pi - bevel) / CHORDS
    cos_half, sin_half = math.cos(half_step), math.sin(half_step)
    cos_step, sin_step = cos_half * cos_half - sin_half * sin_half, 2.0 * sin_half * cos_half
    reach = radius / cos_half
    middle = N_CORNERS[ROUND_GROOVE] // 2
    corner, onward = (middle, 1) if side > 0.0 else (middle - 1, -1)
    cos_a, sin_a = cos_half, sin_half
    for _ in range(CHORDS):
        corners[corner, 0], corners[corner, 1] = y + side * reach * sin_a, z + radius - reach * cos_a
        cos_a, sin_a = cos_a * cos_step - sin_a * sin_step, sin_a * cos_step + cos_a * sin_step
        corner += onward
    # The bevel's line touches the rounding; it is followed up to the plate.
    cos_b, sin_b = math.cos(bevel), math.sin(bevel)
    out = radius * cos_b + (depth - radius * (1.0 - sin_b)) * tan
    corners[corner, 0], corners[corner, 1] = y + side * out, z + depth
    corner += onward
    corners[corner, 0], corners[corner, 1] = y + side * (out + FAR_MM), z + depth + side * slope * FAR_MM


@kernel(allocates=True)
def opening(shape: int, p: Float64, gradient: Float64) -> float:
    """Return the area, mm^2, of the opening below the line from one plate's edge to the other's.

    `gradient` (len(p),) gets its derivatives with the parameters.
    """
    corners, step = np.empty((N_CORNERS[shape], 2)), 1e-6
    for i in range(p.shape[0] + 1):
        if i < p.shape[0]:
            kept = p[i]
            p[i] = kept + step
        corners_of(shape, p, corners)
        if i < p.shape[0]:
            p[i] = kept
        twice = 0.0
        n = N_CORNERS[shape]
        for k in range(1, n - 1):
            onward = k + 1 if k < n - 2 else 1
            twice += corners[k, 0] * corners[onward, 1] - corners[onward, 0] * corners[k, 1]
        if i < p.shape[0]:
            gradient[i] = 0.5 * twice
    area = 0.5 * twice
    for i in range(p.shape[0]):
        gradient[i] = (gradient[i] - area) / step
    return area
