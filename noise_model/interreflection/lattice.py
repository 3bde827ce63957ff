"""Points spread over the joint's faces, at which light is known, and what lies between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Float32, Float64, Int32, Int64
from noise_model.compiled.kernel import kernel
from noise_model.surface.faces import across, face_point, ridge, slanted, strip

GRADING = 3.0
"""The power by which a lattice is drawn together towards a corner that faces enclose."""

FAR_MM = 150.0
"""Distance along the seam from the source within which bounced light is followed closely."""

OFF_CORNER_MM = 0.003
"""Distance of a face's points from its ends: in the corner itself the other face is not seen."""


class Lattice(NamedTuple):
    """Stations `x` (n_x,) and on each face places `s` across it (n_faces, most), the first `n_s` of them; mm.

    Point i n_s + j of face f, from `start[f]` on, lies at x[i] and s[f, j]: `points`, `normals` (n, 3) and
    `faces` (n,) in the joint frame.
    """

    x: Float64
    s: Float64
    n_s: Int64
    start: Int64
    points: Float64
    normals: Float64
    faces: Int32


def lattice(
    x: Float64, ranges: Float64, n_s: npt.ArrayLike, vertices: Float64, corrugation: Float64
) -> Lattice:
    """Spread points over the stations x and over a range (n_faces, 2) of s on each face, mm.

    `n_s` points a face, or one number of them for all; none on a face whose range is empty or NaN.
    """
    n_faces = len(vertices) - 1
    wanted = np.broadcast_to(np.asarray(n_s), n_faces)
    counts = np.where(ranges[:, 1] > ranges[:, 0], wanted, 0).astype(np.int64)
    s = np.zeros((n_faces, int(counts.max(initial=1))))
    for face in np.flatnonzero(counts):
        s[face, : counts[face]] = _across(vertices, int(face), ranges[face], int(counts[face]))
    start = np.concatenate([[0], np.cumsum(counts * len(x))])
    points, normals = np.empty((start[-1], 3)), np.empty((start[-1], 3))
    faces = np.repeat(np.arange(n_faces, dtype=np.int32), counts * len(x))
    _place(
        x=x,
        s=s,
        n_s=counts,
        start=start,
        vertices=vertices,
        corrugation=corrugation,
        points=points,
        normals=normals,
    )
    return Lattice(x, s, counts, start, points, normals, faces)


def _across(vertices: Float64, face: int, s_range: Float64, n: int) -> Float64:
    """Return places over `s_range` across a face, closer towards its ends that other faces enclose."""
    width = float(np.hypot(*(vertices[face + 1] - vertices[face])))
    low, high = _encloses(vertices, face), _encloses(vertices, face + 1)

    def graded(t: Float64) -> Float64:
        if low and high:
            return width * np.where(t < 0.5, 4.0 * t**GRADING, 1.0 - 4.0 * (1.0 - t) ** GRADING)
        if low:
            return width * t**GRADING
        return width * (1.0 - (1.0 - t) ** GRADING) if high else width * t

    fine = np.linspace(0.0, 1.0, 20001)
    # On a face that is hardly wider than that the places would coincide.
    off_corner_mm = min(OFF_CORNER_MM, 0.25 * width)
    ends = np.clip(s_range, off_corner_mm, width - off_corner_mm)
    first, last = np.interp(ends, graded(fine), fine)
    across = graded(np.linspace(first, last, n))
    across[0], across[-1] = ends
    return np.asarray(across)


def _encloses(vertices: Float64, i: int) -> bool:
    """Return True if the faces that meet at a vertex turn towards each other."""
    if not 0 < i < len(vertices) - 1:
        return False
    before, after = vertices[i] - vertices[i - 1], vertices[i + 1] - vertices[i]
    return bool(before[0] * after[1] - before[1] * after[0] > 0.0)


def stations(focus_x: float, x_range: tuple[float, float], finest: float, coarsest: float) -> Float64:
    """Return stations over a range, `finest` apart at the focus, a quarter of the way there elsewhere; mm.

    No more than `coarsest` apart up to `FAR_MM` from the focus; beyond, where hardly any light bounces, a
    quarter of the way there again. Nowhere more than a quarter of the range, so that a cubic finds its four.
    """
    widest = 0.25 * (x_range[1] - x_range[0])

    def step(away: float) -> float:
        return min(max(min(coarsest, max(finest, 0.25 * away)), 0.25 * (away - FAR_MM)), widest)

    ahead, behind = [focus_x], [focus_x]
    while ahead[-1] < x_range[1]:
        ahead.append(ahead[-1] + step(ahead[-1] - focus_x))
    while behind[-1] > x_range[0]:
        behind.append(behind[-1] - step(focus_x - behind[-1]))
    kept = np.array([*behind[:0:-1], *ahead])
    inside = np.flatnonzero((kept >= x_range[0]) & (kept <= x_range[1]))
    # One station beyond either end.
    low, high = max(0, int(inside[0]) - 1), min(len(kept), int(inside[-1]) + 2)
    return kept[low:high]


@kernel
def _place(
    x: Float64,
    s: Float64,
    n_s: Int64,
    start: Int64,
    vertices: Float64,
    corrugation: Float64,
    points: Float64,
    normals: Float64,
) -> None:
    for face in range(n_s.shape[0]):
        on = strip(face, vertices)
        for i in range(x.shape[0]):
            _, slope = ridge(x[i], corrugation)
            normal, _ = slanted(slope, on)
            for j in range(n_s[face]):
                point = start[face] + i * n_s[face] + j
                points[point, 0], points[point, 1], points[point, 2] = face_point(
                    x[i], s[face, j], on, corrugation
                )
                normals[point, 0], normals[point, 1], normals[point, 2] = normal


@kernel(inline=True)
def _left_of(grid: Float64, n: int, value: float) -> int:
    """Return the index of the last of a grid's first n - 1 values not above one; 0 if all are above."""
    low, high = 0, n - 1
    while high - low > 1:
        middle = (low + high) // 2
        if grid[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@kernel(inline=True)
def _cell(grid: Float64, n: int, value: float) -> tuple[int, float]:
    """Return the cell of a grid's first n values that a value lies in, and where in it; -1 outside."""
    if value < grid[0] or value > grid[n - 1]:
        return -1, 0.0
    low = _left_of(grid, n, value)
    return low, (value - grid[low]) / (grid[low + 1] - grid[low])


@kernel(inline=True)
def _cubic(grid: Float64, n: int, value: float, weights: Float64) -> int:
    """Write Lagrange's weights of the four values of a grid about one; return the first of them."""
    first = min(max(_left_of(grid, n, value) - 1, 0), n - 4)
    for i in range(4):
        weight = 1.0
        for j in range(4):
            if j != i:
                weight *= (value - grid[first + j]) / (grid[first + i] - grid[first + j])
        weights[i] = weight
    return first


@kernel
def around(mesh: Lattice, face: int, s: float, x: float, which: Int64, weights: Float64) -> int:
    """Write the eight points of a lattice about a place and their weights; return how many, 8, or 0 outside.

    Straight along, cubic across: there light falls off fast next to a corner.
    """
    n = mesh.n_s[face]
    if n < 4 or not mesh.s[face, 0] - 2.0 * OFF_CORNER_MM <= s <= mesh.s[face, n - 1] + 2.0 * OFF_CORNER_MM:
        return 0
    i, b = _cell(mesh.x, mesh.x.shape[0], x)
    if i < 0:
        return 0
    first = _cubic(mesh.s[face], n, s, weights[:4])
    for j in range(4):
        which[j] = mesh.start[face] + i * n + first + j
        which[4 + j] = which[j] + n
        weights[4 + j] = weights[j] * b
        weights[j] *= 1.0 - b
    return 8


@kernel(allocates=True)
def interpolate(
    mesh: Lattice,
    values: Float64,
    points: Float64,
    faces: Int32,
    vertices: Float64,
    corrugation: Float64,
    image: Float32,
) -> None:
    """Fill an image (n_orders, n) at surface points (n, 3) of faces (n,) from values (n_lattice, n_orders).

    Cubic along and across; 0 on faces without a lattice. Points must lie in the lattice.
    """
    x_weights, s_weights = np.empty(4), np.empty(4)
    for i in range(faces.shape[0]):
        face = faces[i]
        image[:, i] = 0.0
        if face < 0 or mesh.n_s[face] < 4:
            continue
        n = mesh.n_s[face]
        s = across(points[i], strip(face, vertices), corrugation)
        first_x = _cubic(mesh.x, mesh.x.shape[0], points[i, 0], x_weights)
        first_s = _cubic(mesh.s[face], n, s, s_weights)
        for a in range(4):
            for b in range(4):
                weight = x_weights[a] * s_weights[b]
                from_point = mesh.start[face] + (first_x + a) * n + first_s + b
                for order in range(image.shape[0]):
                    image[order, i] += weight * values[from_point, order]
        for order in range(image.shape[0]):
            image[order, i] = max(image[order, i], 0.0)
