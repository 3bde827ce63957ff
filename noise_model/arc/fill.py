"""The arc map of a band or a frame, filled from the faces' table (`table`).

The image is taken in cells of all the scan lines that share a place of the band. Where the 4 by 4 nodes of a
cell see one face, a bicubic polynomial through their light fills it, if its highest terms are small. Else the
cell is halved along its lines, or taken line by line. A line of at most four pixels holds their own light: so
edges of faces and of shadows are as sharp as the image.
"""

from __future__ import annotations

import numpy as np

from noise_model.arc.node_rays import places_on_rays
from noise_model.arc.ray import ArcKernel
from noise_model.arc.table import FaceTable, light_at_places
from noise_model.arrays import Float32, Float64, Int64
from noise_model.kernel import kernel
from noise_model.lanes import COUNT, N_LANES, load, spread, store
from noise_model.surface.ray_casting import MISS

LARGEST = 192
"""The longest cell, px: in the band about a stripe one is as long as the lines."""

N = 4
"""Nodes of a cell along each direction."""

SHARE, CURVED_SHARE = 0.5, 0.2
"""The share of the tolerance that a polynomial's highest terms may be, and that on a corrugation.

What ridges hide has borders anywhere in a cell, and its nodes show a part of what they do to the light.
"""

DECAY = 0.1
"""The highest coefficient of smooth light over the one before."""

BATCH = 32
"""Cells whose nodes are computed together."""

MAX_HALVINGS, MAX_GROUP = 8, 32
"""LARGEST is halved to N at most so often. No more lines are one cell."""

CELL_WORTH = 20.0
"""So many integrals a cell of the table takes, with what it was halved from."""

Places = tuple[Int64, Int64, Float64, Float64]
"""Pixels (n,), the faces they see, their places (n, 2) there and their light."""

Cubic = tuple[float, float, float, float]
"""A polynomial in Newton's form: its divided differences at the nodes of so many pixels."""


@kernel(allocates=True)
def _places(n: int) -> Places:
    """Return room for n pixels."""
    return np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty((n, 2)), np.empty(n)


@kernel
def _node(i: int, n: int) -> int:
    """Return the i-th node of n pixels, counted from the first."""
    return min(i, n - 1) if n < N else (i * (n - 1) + 1) // (N - 1)


@kernel
def _cubic(n: int, v_0: float, v_1: float, v_2: float, v_3: float) -> Cubic:
    """Return the cubic through the light at the nodes of n pixels, more than three."""
    p_1, p_2, p_3 = float(_node(1, n)), float(_node(2, n)), float(n - 1)
    d_1, d_2, d_3 = (v_1 - v_0) / p_1, (v_2 - v_1) / (p_2 - p_1), (v_3 - v_2) / (p_3 - p_2)
    square, beyond = (d_2 - d_1) / p_2, (d_3 - d_2) / (p_3 - p_1)
    return v_0, d_1, square, (beyond - square) / p_3


@kernel
def _roughness(n: int, cubic: Cubic) -> float:
    """Return the highest term of a cubic over n pixels, e-.

    That is Chebyshev's T_3, or T_2 where it is more than DECAY allows: a kink may show in one of them alone.
    """
    half, centre = 0.5 * (n - 1), _node(1, n) + _node(2, n)
    second = 0.5 * abs(cubic[2] + cubic[3] * (3.0 * half - centre)) * half**2
    return max(0.25 * abs(cubic[3]) * half**3, DECAY * second)


@kernel(fastmath={"contract"})
def _fill_line(n: int, cubic: Cubic, line: Float32) -> None:
    """Fill n pixels of a line from a cubic."""
    c_0, c_1, c_2, c_3 = (
        np.float32(cubic[0]),
        np.float32(cubic[1]),
        np.float32(cubic[2]),
        np.float32(cubic[3]),
    )
    q_1, q_2 = np.float32(_node(1, n)), np.float32(_node(2, n))
    if n < N_LANES:
        for j in range(n):
            p = np.float32(j)
            line[j] = c_0 + p * (c_1 + (p - q_1) * (c_2 + (p - q_2) * c_3))
        return
    for k in range(0, n, N_LANES):
        j = min(k, n - N_LANES)
        u = spread(np.float32(j)) + load(COUNT, 0)
        value = spread(c_2) + (u - spread(q_2)) * spread(c_3)
        store(line, j, spread(c_0) + u * (spread(c_1) + (u - spread(q_1)) * value))


@kernel
def _add_cell(line: int, n_lines: int, first: int, n: int, cells: Int64, n_cells: int) -> int:
    """Add a cell to those still to be filled; return how many there are."""
    cells[n_cells, 0], cells[n_cells, 1], cells[n_cells, 2], cells[n_cells, 3] = line, n_lines, first, n
    return n_cells + 1


@kernel
def _lines_of_one_face(faces: Int64, n_lines: int) -> tuple[bool, bool]:
    """Say whether each line of a cell's nodes sees one face, and whether all see the same one."""
    each = True
    for i in range(0, N * min(n_lines, N), N):
        is_one = faces[i] == faces[i + 1] and faces[i] == faces[i + 2] and faces[i] == faces[i + 3]
        each = each and is_one and faces[i] != MISS
    same = each
    for i in range(N, N * min(n_lines, N), N):
        same = same and faces[i] == faces[0]
    return each, same


@kernel
def _fill_cell(
    cell: tuple[int, int, int, int],
    faces: Int64,
    light_e: Float64,
    allowed: tuple[float, float],
    begin: int,
    band_e: Float32,
) -> tuple[bool, bool]:
    """Fill a cell from the faces and the light (16,) of its nodes; say if it is, else if it is halved along.

    `allowed` is what its highest terms may be, relative and e-; in the band its lines begin at `begin`.
    """
    line, n_lines, _, n = cell
    if n <= N and n_lines == 1:
        for j in range(n):
            band_e[line, begin + j] = light_e[j]
        return True, False
    each, same = _lines_of_one_face(faces, n_lines)
    if not same:
        return False, n > N and (n_lines == 1 or not each)
    v, least = light_e, np.inf
    for i in range(N * min(n_lines, N)):
        least = min(least, v[i])
    limit = max(allowed[0] * least, allowed[1])
    is_smooth_along = n >= N
    for i in range(0, N * min(n_lines, N), N):
        if is_smooth_along:
            rough = _roughness(n, _cubic(n, v[i], v[i + 1], v[i + 2], v[i + 3]))
            is_smooth_along = rough <= limit
    if not is_smooth_along:
        return False, n > N
    if n_lines == 1:
        cubic = _cubic(n, v[0], v[1], v[2], v[3])
        _fill_line(n, cubic, band_e[line, begin : begin + n])
        return True, False
    c_0 = _cubic(n_lines, v[0], v[4], v[8], v[12])
    c_1 = _cubic(n_lines, v[1], v[5], v[9], v[13])
    c_2 = _cubic(n_lines, v[2], v[6], v[10], v[14])
    c_3 = _cubic(n_lines, v[3], v[7], v[11], v[15])
    rough = max(_roughness(n_lines, c_0), _roughness(n_lines, c_1))
    if not max(rough, max(_roughness(n_lines, c_2), _roughness(n_lines, c_3))) <= limit:
        return False, False
    for i in range(n_lines):
        cubic = _cubic(
            n,
            _value(n_lines, c_0, i),
            _value(n_lines, c_1, i),
            _value(n_lines, c_2, i),
            _value(n_lines, c_3, i),
        )
        _fill_line(n, cubic, band_e[line + i, begin : begin + n])
    return True, False


@kernel
def _value(n: int, cubic: Cubic, p: int) -> float:
    """Return a cubic over n pixels at one of them."""
    return cubic[0] + p * (cubic[1] + (p - _node(1, n)) * (cubic[2] + (p - _node(2, n)) * cubic[3]))


@kernel
def _fill_cells(
    k: ArcKernel,
    table: FaceTable,
    xy: Float32,
    cos4: Float32,
    lows: Int64,
    group: int,
    band_e: Float32,
    cells: Int64,
    batch: Int64,
    places: Places,
) -> None:
    """Fill the cells of a band; no array is made here, so that none is counted cell by cell.

    `cells` (n, 4) are still to be filled, the last one next: first line, how many, first position, how many.
    """
    n_scan, depth = band_e.shape
    n_pos = cos4.shape[0] // n_scan
    pixels, faces, spots, light_e = places
    share = SHARE if k.corrugation[0] == 0.0 else CURVED_SHARE
    allowed = share * table.rel, share * table.floor_e
    line, n_cells = 0, 0
    while line < n_scan or n_cells > 0:
        while line < n_scan and n_cells < BATCH:
            low, n_lines = lows[line // group], min(group, n_scan - line)
            n = min(depth, n_pos - low)
            parts = (n + LARGEST - 1) // LARGEST
            for part in range(parts):
                first, end = n * part // parts, n * (part + 1) // parts
                if n_lines >= N:
                    n_cells = _add_cell(line, n_lines, low + first, end - first, cells, n_cells)
                    continue
                for i in range(n_lines):
                    n_cells = _add_cell(line + i, 1, low + first, end - first, cells, n_cells)
            line += n_lines
        n_batch = min(n_cells, BATCH)
        n_cells -= n_batch
        n_nodes = 0
        for i in range(n_batch):
            for c in range(4):
                batch[i, c] = cells[n_cells + i, c]
            for a in range(min(batch[i, 1], N)):
                begin = (batch[i, 0] + _node(a, batch[i, 1])) * n_pos + batch[i, 2]
                for j in range(N):
                    pixels[n_nodes + j] = begin + _node(j, batch[i, 3])
                n_nodes += N
        places_on_rays(k, table.seen, xy, pixels, n_nodes, faces, spots)
        light_at_places(k, table, cos4, pixels, n_nodes, faces, spots, 0.0, light_e)
        n_nodes = 0
        for i in range(n_batch):
            cell = (batch[i, 0], batch[i, 1], batch[i, 2], batch[i, 3])
            begin = cell[2] - lows[cell[0] // group]
            is_filled, is_halved = _fill_cell(
                cell,
                faces[n_nodes : n_nodes + N * N],
                light_e[n_nodes : n_nodes + N * N],
                allowed,
                begin,
                band_e,
            )
            n_nodes += N * min(cell[1], N)
            if is_filled:
                continue
            if is_halved:
                half = cell[3] // 2
                n_cells = _add_cell(cell[0], cell[1], cell[2], half, cells, n_cells)
                n_cells = _add_cell(cell[0], cell[1], cell[2] + half, cell[3] - half, cells, n_cells)
                continue
            for a in range(cell[1]):
                n_cells = _add_cell(cell[0] + a, 1, cell[2], cell[3], cells, n_cells)


@kernel(allocates=True)
def fill_band(
    k: ArcKernel, table: FaceTable, xy: Float32, cos4: Float32, lows: Int64, group: int, band_e: Float32
) -> None:
    """Fill a band (n_scan, depth), e-; `group` scan lines share a place of `lows`. See `map.ArcMap`."""
    # A batch is halved at most so often, and taken line by line once, before its last cells are filled.
    room = BATCH * (MAX_GROUP + MAX_HALVINGS + 2) + MAX_GROUP * (band_e.shape[1] // LARGEST + 1)
    cells, batch = np.empty((room, 4), dtype=np.int64), np.empty((BATCH, 4), dtype=np.int64)
    _fill_cells(k, table, xy, cos4, lows, group, band_e, cells, batch, _places(N * N * BATCH))


@kernel(allocates=True)
def fill_pixels(
    k: ArcKernel, table: FaceTable, xy: Float32, cos4: Float32, pixels: Int64, out: Float32
) -> None:
    """Write the light (n,), e-, at some pixels (n,) of the whole image; NaN past the workpiece.

    Cells that hold less of them than nodes are not worth making.
    """
    n = len(pixels)
    _, faces, places, light_e = _places(n)
    x_low, x_high, y_low, y_high = k.reach
    least_mm2 = CELL_WORTH * (x_high - x_low) * (y_high - y_low) / max(n, 1)
    places_on_rays(k, table.seen, xy, pixels, n, faces, places)
    light_at_places(k, table, cos4, pixels, n, faces, places, least_mm2, light_e)
    out[:] = light_e
