"""The arc's light on each face as a piecewise polynomial in the face's own coordinates, made where asked for.

A face's coordinates are the station x and the way s across it, mm. There edges, the ends of a ridge and, on
plain sections, the borders of penumbrae lie along s = const or x = const: a penumbra ends where a plane
through a vertex line touches the arc, and that plane holds the direction of x. So patches that are cut there
and halved along one coordinate at a time hold the light with few nodes, and the image can be read off them
at the cost of a few multiplications a pixel.

A patch's cells hold polynomials of degree 4 in x and s on 5 by 5 equidistant nodes; a cell whose highest
Chebyshev coefficient is too large, or that misses the light between its nodes, is halved. A
cell that is still rough at `SMALLEST_MM` holds no polynomial: its light is integrated where asked for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from noise_model.arc_borders import MAX_BORDERS, borders_across, borders_along, seen_strip
from noise_model.arc_ray import ArcKernel, Scratch, follow, light_at
from noise_model.faces import across, face_point
from noise_model.frames import Float64
from noise_model.kernel import kernel
from noise_model.visibility import MISS

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]

DEGREE = 4
NODES = DEGREE + 1

SMALLEST_MM = 0.3
"""A cell this small is not halved any more."""

ROUGH = 4.0
"""In a cell this small the polynomial may be off by so many times what it may elsewhere."""

MAX_CELLS = 6000
"""Room for the cells of all faces; where it is used up, light is integrated point by point."""

MAX_WAITING = 64
"""Room for the cells that wait while a patch is made."""

SHARE = 0.5
"""The share of the tolerance that a cell's polynomial may use up."""

CHECK = 0.8
"""Where between the nodes, -1 to 1, a cell's polynomial is compared with the light."""

_V = np.vander(np.linspace(-1.0, 1.0, NODES), increasing=True)
TO_POWERS = np.ascontiguousarray(np.linalg.inv(_V))
"""From the values at equidistant nodes of [-1, 1] to the coefficients of 1, t ... t^4."""


class FaceTable(NamedTuple):
    """The patches of all faces.

    `x_borders` (n_x,) and `s_borders` (n_faces, MAX_BORDERS) with `n_s` (n_faces,) are the patches' borders,
    `roots` (n_faces, n_x - 1, MAX_BORDERS) their first cells, -1 where none is made yet. A cell has an
    `axis` (0 along x, 1 along s: halved; 2 a polynomial; 3 none), its `middle` (n, 2) and `inverse` half
    widths (n, 2), a `child` (the other one is the next) and `powers` (n, 5, 5). `n_cells` (1,) are made.
    """

    x_borders: Float64
    s_borders: Float64
    n_s: Int32
    roots: Int32
    axis: Int32
    child: Int32
    middle: Float64
    inverse: Float64
    powers: Float64
    n_cells: Int32
    waiting: Float64
    to_powers: Float64
    rel: float
    floor_e: float


@kernel(inline=True)
def _place(borders: Float64, n: int, at: float) -> int:
    """Return in which of the n - 1 intervals between sorted borders `at` lies, -1 for none."""
    if not borders[0] <= at <= borders[n - 1]:
        return -1
    low, high = 0, n - 1
    while high - low > 1:
        middle = (low + high) // 2
        if at < borders[middle]:
            high = middle
        else:
            low = middle
    return low


@kernel
def _highest(values: Float64) -> tuple[float, float]:
    """Return the largest Chebyshev coefficients of degree 4 along x and along s of a cell's values (25,)."""
    worst_x, worst_s = 0.0, 0.0
    for i in range(NODES):
        x = values[i] - 4.0 * values[5 + i] + 6.0 * values[10 + i] - 4.0 * values[15 + i] + values[20 + i]
        j = 5 * i
        s = values[j] - 4.0 * values[j + 1] + 6.0 * values[j + 2] - 4.0 * values[j + 3] + values[j + 4]
        worst_x, worst_s = max(worst_x, abs(x) / 12.0), max(worst_s, abs(s) / 12.0)
    return worst_x, worst_s


@kernel
def _fit(values: Float64, to_powers: Float64, powers: Float64) -> None:
    """Write the coefficients (5, 5) of the polynomial through a cell's values (25,)."""
    for a in range(NODES):
        for j in range(NODES):
            total = 0.0
            for i in range(NODES):
                total += to_powers[a, i] * values[5 * i + j]
            powers[a, j] = total
    for a in range(NODES):
        c_0, c_1, c_2, c_3, c_4 = powers[a, 0], powers[a, 1], powers[a, 2], powers[a, 3], powers[a, 4]
        for b in range(NODES):
            powers[a, b] = (
                to_powers[b, 0] * c_0
                + to_powers[b, 1] * c_1
                + to_powers[b, 2] * c_2
                + to_powers[b, 3] * c_3
                + to_powers[b, 4] * c_4
            )


@kernel(inline=True)
def _value(powers: Float64, cell: int, t: float, u: float) -> float:
    """Return a cell's polynomial at (t, u), each -1 to 1."""
    value = 0.0
    for a in range(DEGREE, -1, -1):
        row = powers[cell, a, 3] + u * powers[cell, a, 4]
        row = powers[cell, a, 0] + u * (powers[cell, a, 1] + u * (powers[cell, a, 2] + u * row))
        value = value * t + row
    return value


@kernel
def _make_patch(
    k: ArcKernel, table: FaceTable, face: int, x: tuple[float, float], s: tuple[float, float], work: Scratch
) -> int:
    """Make the cells of a patch and return its first one."""
    axis, child, middle, inverse = table.axis, table.child, table.middle, table.inverse
    n_cells, waiting, powers, to_powers = table.n_cells, table.waiting, table.powers, table.to_powers
    on, corrugation = seen_strip(face, k.vertices), k.corrugation
    root: int = n_cells[0]
    n_cells[0] += 1
    # Waiting cells: number, half widths, which nodes are missing (all, every other along x, or along s).
    n = 1
    waiting[0, 25], waiting[0, 26], waiting[0, 27], waiting[0, 28] = (
        root,
        0.5 * (x[1] - x[0]),
        0.5 * (s[1] - s[0]),
        2.0,
    )
    middle[root, 0], middle[root, 1] = 0.5 * (x[0] + x[1]), 0.5 * (s[0] + s[1])
    while n > 0:
        n -= 1
        values = waiting[n]
        cell, half_x, half_s, missing = int(values[25]), values[26], values[27], int(values[28])
        inverse[cell, 0], inverse[cell, 1] = 1.0 / half_x, 1.0 / half_s
        least = math.inf
        for i in range(NODES):
            for j in range(NODES):
                if missing == 2 or (missing == 0 and i % 2 == 1) or (missing == 1 and j % 2 == 1):
                    x_node = middle[cell, 0] + 0.5 * (i - 2) * half_x
                    s_node = middle[cell, 1] + 0.5 * (j - 2) * half_s
                    P = face_point(x_node, s_node, on, corrugation)
                    values[5 * i + j] = light_at(k, P, face, work)
                least = min(least, values[5 * i + j])
        allowed = SHARE * max(table.rel * least, table.floor_e)
        worst_x, worst_s = _highest(values)
        along = 0 if worst_x > worst_s else 1
        if max(worst_x, worst_s) <= allowed:
            # The differences may be small by chance: two points between the nodes are looked at.
            _fit(values, to_powers, powers[cell])
            along_if_off, along = along, 2
            for at in (-CHECK, CHECK):
                x_node, s_node = middle[cell, 0] + at * half_x, middle[cell, 1] + at * half_s
                P = face_point(x_node, s_node, on, corrugation)
                if abs(_value(powers, cell, at, at) - light_at(k, P, face, work)) > allowed:
                    along = along_if_off
                    break
        if along < 2:
            half = half_x if along == 0 else half_s
            if half < 0.5 * SMALLEST_MM and max(worst_x, worst_s) <= ROUGH * allowed:
                along = 2
                _fit(values, to_powers, powers[cell])
            elif half < 0.5 * SMALLEST_MM or n + 2 > MAX_WAITING or n_cells[0] + 2 > MAX_CELLS:
                axis[cell] = 3
                continue
        if along < 2:
            axis[cell], child[cell] = along, n_cells[0]
            for side in range(2):
                half_cell = waiting[MAX_WAITING + side]
                new = n_cells[0] + side
                middle[new, 0], middle[new, 1] = middle[cell, 0], middle[cell, 1]
                middle[new, along] += (side - 0.5) * half
                for i in range(NODES):
                    for j in range(3):
                        if along == 0:
                            half_cell[10 * j + i] = values[5 * (2 * side + j) + i]
                        else:
                            half_cell[5 * i + 2 * j] = values[5 * i + 2 * side + j]
                half_cell[25], half_cell[26], half_cell[27] = new, half_x, half_s
                half_cell[26 + along] = 0.5 * half
                half_cell[28] = along
            n_cells[0] += 2
            for side in range(2):
                for i in range(29):
                    waiting[n, i] = waiting[MAX_WAITING + side, i]
                n += 1
            continue
        axis[cell] = 2
    return root


@kernel(inline=True)
def _light_on(k: ArcKernel, table: FaceTable, face: int, x: float, s: float, work: Scratch) -> float:
    """Return the arc's light, e- without the lens' fall-off, at a face's coordinates; NaN off the table."""
    i, j = (
        _place(table.x_borders, table.x_borders.shape[0], x),
        _place(table.s_borders[face], table.n_s[face], s),
    )
    if i < 0 or j < 0:
        return math.nan
    cell = table.roots[face, i, j]
    if cell < 0:
        if table.n_cells[0] >= MAX_CELLS:
            return light_at(k, face_point(x, s, seen_strip(face, k.vertices), k.corrugation), face, work)
        borders = table.s_borders[face]
        cell = _make_patch(
            k,
            table,
            face,
            (table.x_borders[i], table.x_borders[i + 1]),
            (borders[j], borders[j + 1]),
            work,
        )
        table.roots[face, i, j] = cell
    along = table.axis[cell]
    while along < 2:
        at = x if along == 0 else s
        cell = table.child[cell] + (1 if at > table.middle[cell, along] else 0)
        along = table.axis[cell]
    if along == 3:
        return light_at(k, face_point(x, s, seen_strip(face, k.vertices), k.corrugation), face, work)
    t = (x - table.middle[cell, 0]) * table.inverse[cell, 0]
    u = (s - table.middle[cell, 1]) * table.inverse[cell, 1]
    return _value(table.powers, cell, t, u)


@kernel
def light_on_rays(
    k: ArcKernel,
    table: FaceTable,
    xy: Float32,
    cos4: Float32,
    pixels: Int64,
    n: int,
    light_e: Float64,
    faces: Int64,
    work: Scratch,
) -> None:
    """Write the arc's light (n,), e-, on the rays of some pixels and the faces (n,) they meet.

    NaN and `visibility.MISS` for a ray that looks past the workpiece.
    """
    for i in range(n):
        pixel = pixels[i]
        P, face = follow(k, xy[pixel, 0], xy[pixel, 1])
        faces[i] = face
        light = math.nan
        if face != MISS:
            s = across(P, seen_strip(face, k.vertices), k.corrugation)
            light = _light_on(k, table, face, P[0], s, work)
            if math.isnan(light):
                light = light_at(k, P, face, work)
        light_e[i] = cos4[pixel] * light


@kernel
def light_on_plane(
    k: ArcKernel,
    table: FaceTable,
    face: int,
    xy: Float32,
    cos4: Float32,
    pixels: Int64,
    n: int,
    light_e: Float64,
    work: Scratch,
) -> None:
    """Write the light (n,), e-, where the rays of some pixels meet a plain face's plane, seen or not.

    NaN where a ray runs away from it or meets it off the table.
    """
    R, eye = k.rotation, k.eye
    y_0, z_0, dy, dz, _ = seen_strip(face, k.vertices)
    for i in range(n):
        pixel = pixels[i]
        x, y = xy[pixel, 0], xy[pixel, 1]
        d_y, d_z = R[1, 0] * x + R[1, 1] * y + R[1, 2], R[2, 0] * x + R[2, 1] * y + R[2, 2]
        t = (dy * (z_0 - eye[2]) - dz * (y_0 - eye[1])) / (dy * d_z - dz * d_y)
        light = math.nan
        if t > 0.0:
            x_at = eye[0] + t * (R[0, 0] * x + R[0, 1] * y + R[0, 2])
            s = (eye[1] + t * d_y - y_0) * dy + (eye[2] + t * d_z - z_0) * dz
            light = _light_on(k, table, face, x_at, s, work)
        light_e[i] = cos4[pixel] * light


@kernel(allocates=True)
def new_table(k: ArcKernel, margin_mm: float, rel: float, floor_e: float, to_powers: Float64) -> FaceTable:
    """Return an empty table for what the camera sees (`ArcKernel.reach`), faces continued by a margin.

    Cells may be off by `SHARE` of `rel` of their least light or of `floor_e`, whichever is more.
    """
    n_faces = k.vertices.shape[0] - 1
    x_borders = borders_along(k)
    s_borders, n_s = np.empty((n_faces, MAX_BORDERS)), np.empty(n_faces, dtype=np.int32)
    for face in range(n_faces):
        n_s[face] = borders_across(k, face, margin_mm, s_borders[face])
    return FaceTable(
        x_borders,
        s_borders,
        n_s,
        np.full((n_faces, len(x_borders), MAX_BORDERS), -1, dtype=np.int32),
        np.empty(MAX_CELLS, dtype=np.int32),
        np.empty(MAX_CELLS, dtype=np.int32),
        np.empty((MAX_CELLS, 2)),
        np.empty((MAX_CELLS, 2)),
        np.empty((MAX_CELLS, NODES, NODES)),
        np.zeros(1, dtype=np.int32),
        np.empty((MAX_WAITING + 2, 29)),
        to_powers,
        rel,
        floor_e,
    )
