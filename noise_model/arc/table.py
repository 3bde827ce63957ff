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

from noise_model.arc.face_lookup import VisibleFaces, sight
from noise_model.arc.patch_borders import MAX_BORDERS, borders_across, borders_along, seen_strip
from noise_model.arc.ray import ArcKernel, light_at
from noise_model.arc.scratch import ArcScratch
from noise_model.compiled.arrays import Bool, Float32, Float64, Int32, Int64
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.surface.faces import Strip, face_point
from noise_model.surface.ray_casting import MISS

DEGREE = 4
NODES = DEGREE + 1

SMALLEST_MM = 0.3
"""A cell this small is not halved any more."""

MAX_CELLS = 6000
"""Room for the cells of all faces; where it is used up, light is integrated point by point."""

SMOOTH, NONE, NEW = 2, 3, 4
"""State of a cell that is not halved along x (0) or s (1): it holds a polynomial; it holds none; it is not
made yet and lacks every other node along x (4), along s (5) or all of them (6)."""

SHARE = 0.5
"""The share of the tolerance that a cell's polynomial may use up."""

ASKED = -1.0
"""The light of a point that is yet to be integrated."""

CHECK = 0.8
"""Places between the nodes, -1 to 1, at which a cell's polynomial is compared with the light."""

_V = np.vander(np.linspace(-1.0, 1.0, NODES), increasing=True)
TO_POWERS = np.ascontiguousarray(np.linalg.inv(_V))
"""From the values at equidistant nodes of [-1, 1] to the coefficients of 1, t ... t^4."""


class FaceTable(NamedTuple):
    """The patches of all faces.

    `x_borders` (n_x,) and `s_borders` (n_faces, MAX_BORDERS) with `n_s` (n_faces,) are the patches' borders,
    `roots` (n_faces, n_x - 1, MAX_BORDERS) their first cells, -1 where none is made yet. A cell has an
    `axis` (along which it is halved, `SMOOTH` ...), its `middle` (n, 2) and `inverse` half widths (n, 2), a
    `child` (the other one is the next) and `powers` (n, 5, 5), the values at its nodes while it has no
    polynomial. `n_cells` (1,) there are; those that are baked (`baked`) are `is_ready` (n,). `check` (5, 5)
    is scratch, `seen` says which face a ray meets.
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
    is_ready: Bool
    check: Float64
    to_powers: Float64
    rel: float
    floor_e: float
    seen: VisibleFaces


Patches = tuple[Float64, Float64, Int32, Int32]
"""A table's borders along the seam, those across its faces and how many, and the first cells between them."""


@kernel(inline=True)
def _place(borders: Float64, n: int, value: float) -> int:
    """Return in which of the n - 1 intervals between sorted borders `value` lies, -1 for none."""
    if not borders[0] <= value <= borders[n - 1]:
        return -1
    low, high = 0, n - 1
    while high - low > 1:
        middle = (low + high) // 2
        if value < borders[middle]:
            high = middle
        else:
            low = middle
    return low


@kernel
def _highest(values: Float64) -> tuple[float, float]:
    """Return the largest Chebyshev coefficients of degree 4 along x and along s of a cell's values (5, 5)."""
    worst_x, worst_s = 0.0, 0.0
    for i in range(NODES):
        x = values[0, i] - 4.0 * values[1, i] + 6.0 * values[2, i] - 4.0 * values[3, i] + values[4, i]
        s = values[i, 0] - 4.0 * values[i, 1] + 6.0 * values[i, 2] - 4.0 * values[i, 3] + values[i, 4]
        worst_x, worst_s = max(worst_x, abs(x) / 12.0), max(worst_s, abs(s) / 12.0)
    return worst_x, worst_s


@kernel
def fit(values: Float64, to_powers: Float64, powers: Float64) -> None:
    """Write the coefficients (5, 5) of the polynomial through a cell's values (5, 5), which may be there."""
    for j in range(NODES):
        v_0, v_1, v_2, v_3, v_4 = values[0, j], values[1, j], values[2, j], values[3, j], values[4, j]
        for a in range(NODES):
            low = to_powers[a, 0] * v_0 + to_powers[a, 1] * v_1 + to_powers[a, 2] * v_2
            powers[a, j] = low + to_powers[a, 3] * v_3 + to_powers[a, 4] * v_4
    for i in range(NODES):
        v_0, v_1, v_2, v_3, v_4 = powers[i, 0], powers[i, 1], powers[i, 2], powers[i, 3], powers[i, 4]
        for b in range(NODES):
            low = to_powers[b, 0] * v_0 + to_powers[b, 1] * v_1 + to_powers[b, 2] * v_2
            powers[i, b] = low + to_powers[b, 3] * v_3 + to_powers[b, 4] * v_4


@kernel(inline=True)
def _value(powers: Float64, t: float, u: float) -> float:
    """Return a polynomial (5, 5) at (t, u), each -1 to 1."""
    value = 0.0
    for a in range(DEGREE, -1, -1):
        row = powers[a, 3] + u * powers[a, 4]
        row = powers[a, 0] + u * (powers[a, 1] + u * (powers[a, 2] + u * row))
        value = value * t + row
    return value


@kernel(inline=True)
def fall_off(k: ArcKernel, on: Strip, x: float, s: float) -> float:
    """Return by what a cell's light is multiplied, mm^4, so that it hardly varies along a face.

    Light falls off with the distance from the arc's centre, on a plate that it grazes with its fourth power.
    """
    y_0, z_0, ty, tz, _ = on
    x, y, z = x - k.center[0], y_0 + s * ty - k.center[1], z_0 + s * tz - k.center[2]
    square = x * x + y * y + z * z + k.radius * k.radius
    return square * square


@kernel(fastmath=REDUCTION)
def integrate(
    k: ArcKernel, faces: Int64, places: Float64, n: int, light_e: Float64, work: ArcScratch
) -> None:
    """Integrate the light (n,), e- without the lens' fall-off, at those places (n, 2) where it is ASKED.

    One call serves many: to hand on the records takes a fifth of one point's integral.
    """
    for i in range(n):
        if light_e[i] == ASKED:
            # A sum with a literal is what kernels take faces as: 64 bits.
            face = 0 + int(faces[i])
            on = seen_strip(face, k.vertices)
            light_e[i] = light_at(k, face_point(places[i, 0], places[i, 1], on, k.corrugation), face, work)


@kernel(inline=True)
def _node(table: FaceTable, cell: int, t: float, u: float) -> tuple[float, float]:
    """Return a face's coordinates at (t, u) of a cell, each -1 to 1."""
    middle, inverse = table.middle, table.inverse
    return middle[cell, 0] + t / inverse[cell, 0], middle[cell, 1] + u / inverse[cell, 1]


@kernel(inline=True)
def _is_missing(missing: int, row: int, column: int) -> bool:
    """Return True if a new cell lacks a node: every other row (0), every other column (1) or all (2)."""
    return missing == 2 or (missing == 0 and row % 2 == 1) or (missing == 1 and column % 2 == 1)


@kernel
def make_cell(k: ArcKernel, table: FaceTable, face: int, cell: int, work: ArcScratch) -> None:
    """Integrate the light at a new cell's missing nodes; make it a polynomial's, or halve it."""
    axis, child, middle, inverse, powers = table.axis, table.child, table.middle, table.inverse, table.powers
    on, n_cells = seen_strip(face, k.vertices), table.n_cells
    values, missing = powers[cell], axis[cell] - NEW
    room = work.records[0]
    faces, places, light_e = room.node_faces[:], room.node_places[:], room.node_light_e[:]
    for i in range(NODES * NODES):
        row, column = i // NODES, i % NODES
        places[i, 0], places[i, 1] = _node(table, cell, 0.5 * (row - 2), 0.5 * (column - 2))
        faces[i], light_e[i] = face, ASKED if _is_missing(missing, row, column) else 0.0
    integrate(k, faces, places, NODES * NODES, light_e, work)
    allowed = math.inf
    for i in range(NODES * NODES):
        row, column, times = i // NODES, i % NODES, fall_off(k, on, places[i, 0], places[i, 1])
        if _is_missing(missing, row, column):
            values[row, column] = times * light_e[i]
        allowed = min(allowed, SHARE * max(table.rel * values[row, column], table.floor_e * times))
    worst_x, worst_s = _highest(values)
    is_smooth = max(worst_x, worst_s) <= allowed
    if is_smooth:
        # The differences may be small by chance: two points between the nodes are looked at.
        check = table.check
        fit(values, table.to_powers, check)
        for i in range(2):
            offset = CHECK * (2.0 * i - 1.0)
            places[i, 0], places[i, 1] = _node(table, cell, offset, offset)
            light_e[i] = ASKED
        integrate(k, faces, places, 2, light_e, work)
        for i in range(2):
            offset = CHECK * (2.0 * i - 1.0)
            light = fall_off(k, on, places[i, 0], places[i, 1]) * light_e[i]
            is_smooth = is_smooth and abs(_value(check, offset, offset) - light) <= allowed
    half_x, half_s = 1.0 / inverse[cell, 0], 1.0 / inverse[cell, 1]
    along = 0 if worst_x > worst_s else 1
    is_small = (half_x if along == 0 else half_s) < 0.5 * SMALLEST_MM
    # In a cell this small the polynomial may be off by so many times what it may elsewhere.
    if is_smooth or (is_small and max(worst_x, worst_s) <= 4.0 * allowed):
        fit(values, table.to_powers, values)
        axis[cell] = SMOOTH
        return
    if is_small or n_cells[0] + 2 > MAX_CELLS:
        axis[cell] = NONE
        return
    axis[cell], child[cell] = along, n_cells[0]
    for side in range(2):
        new = n_cells[0] + side
        axis[new] = NEW + along
        for c in range(2):
            middle[new, c], inverse[new, c] = middle[cell, c], inverse[cell, c]
        middle[new, along] += (side - 0.5) * (half_x if along == 0 else half_s)
        inverse[new, along] *= 2.0
        for i in range(NODES):
            for j in range(3):
                if along == 0:
                    powers[new, 2 * j, i] = values[2 * side + j, i]
                else:
                    powers[new, i, 2 * j] = values[i, 2 * side + j]
    n_cells[0] += 2


@kernel(inline=True)
def root_cell(table: FaceTable, face: int, i: int, j: int) -> int:
    """Return the first cell of a patch, begun if need be; -1 where there is no room."""
    # A sum with a literal is what `make_cell` takes cells as: 64 bits.
    cell = 0 + int(table.roots[face, i, j])
    if cell < 0 and table.n_cells[0] < MAX_CELLS:
        cell = 0 + int(table.n_cells[0])
        table.n_cells[0] += 1
        table.roots[face, i, j] = cell
        table.axis[cell] = NEW + 2
        x_low, x_high = table.x_borders[i], table.x_borders[i + 1]
        s_low, s_high = table.s_borders[face, j], table.s_borders[face, j + 1]
        table.middle[cell, 0], table.middle[cell, 1] = 0.5 * (x_low + x_high), 0.5 * (s_low + s_high)
        table.inverse[cell, 0], table.inverse[cell, 1] = 2.0 / (x_high - x_low), 2.0 / (s_high - s_low)
    return cell


@kernel(inline=True)
def cell_at(
    k: ArcKernel, table: FaceTable, face: int, x: float, s: float, min_mm2: float, work: ArcScratch
) -> int:
    """Return the cell at a face's coordinates, made if need be.

    -1 if there is none, or where it has not been ready from the first and is smaller.
    """
    i = _place(table.x_borders, table.x_borders.shape[0], x)
    j = _place(table.s_borders[face], table.n_s[face], s)
    if i < 0 or j < 0:
        return -1
    axis, middle, inverse = table.axis, table.middle, table.inverse
    cell = root_cell(table, face, i, j)
    if cell < 0:
        return -1
    while True:
        if not table.is_ready[cell] and min_mm2 * inverse[cell, 0] * inverse[cell, 1] > 4.0:
            return -1
        if axis[cell] >= NEW:
            make_cell(k, table, face, cell, work)
        along = axis[cell]
        if along >= SMOOTH:
            return cell if along == SMOOTH else -1
        cell = 0 + int(table.child[cell]) + (1 if (x if along == 0 else s) > middle[cell, along] else 0)


@kernel
def light_at_places(
    k: ArcKernel, table: FaceTable, cos4: Float32, n: int, min_mm2: float, work: ArcScratch
) -> None:
    """Write the arc's light, e-, that the first n pixels receive from their places on faces.

    It is integrated where there is no cell or none of at least `min_mm2`; NaN where a place is.
    """
    room = work.records[0]
    pixels, faces, places, light_e = room.pixels[:], room.faces[:], room.places[:], room.light_e[:]
    middle, inverse, powers = table.middle, table.inverse, table.powers
    cell, cells_face, on, is_asked = -1, MISS, seen_strip(0, k.vertices), False
    for i in range(n):
        face, x, s = faces[i], places[i, 0], places[i, 1]
        if math.isnan(x):
            light_e[i] = math.nan
            continue
        # Neighbours mostly share a cell.
        t, u = math.inf, math.inf
        if face != cells_face:
            on, cell, cells_face = seen_strip(face, k.vertices), -1, face
        elif cell >= 0:
            t, u = (x - middle[cell, 0]) * inverse[cell, 0], (s - middle[cell, 1]) * inverse[cell, 1]
        if not (abs(t) < 1.0 and abs(u) < 1.0):
            cell = cell_at(k, table, face, x, s, min_mm2, work)
        if cell >= 0:
            t, u = (x - middle[cell, 0]) * inverse[cell, 0], (s - middle[cell, 1]) * inverse[cell, 1]
            light_e[i] = _value(powers[cell], t, u) / fall_off(k, on, x, s)
        else:
            light_e[i], is_asked = ASKED, True
    if is_asked:
        integrate(k, faces, places, n, light_e, work)
    for i in range(n):
        light_e[i] *= cos4[pixels[i]]


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
    roots = np.full((n_faces, len(x_borders), MAX_BORDERS), -1, dtype=np.int32)
    return table_within(k, (x_borders, s_borders, n_s, roots), rel, floor_e, to_powers)


@kernel(allocates=True)
def table_within(k: ArcKernel, patches: Patches, rel: float, floor_e: float, to_powers: Float64) -> FaceTable:
    """Return a table without cells for patches; see `new_table` for the tolerance."""
    x_borders, s_borders, n_s, roots = patches
    return FaceTable(
        x_borders=x_borders,
        s_borders=s_borders,
        n_s=n_s,
        roots=roots,
        axis=np.empty(MAX_CELLS, dtype=np.int32),
        child=np.empty(MAX_CELLS, dtype=np.int32),
        middle=np.empty((MAX_CELLS, 2)),
        inverse=np.empty((MAX_CELLS, 2)),
        powers=np.empty((MAX_CELLS, NODES, NODES)),
        n_cells=np.zeros(1, dtype=np.int32),
        is_ready=np.zeros(MAX_CELLS, dtype=np.bool_),
        check=np.empty((NODES, NODES)),
        to_powers=to_powers,
        rel=rel,
        floor_e=floor_e,
        seen=sight(k),
    )
