"""A plain section's light, integrated before any frame comes, for where the torch is expected.

On a plain section everything moves along the seam with the arc. What a place of it sends to the camera
depends on the arc's lateral offset from the seam, y, and on the camera's place e from the arc's centre. At
each of some y tables of all faces are made (`table`), each cell's polynomial with its derivatives:

    L(y, e) = L_k + (y - y_k) dL/dy + (e - e_0) . dL/de.

What that leaves out is looked at where tables are made. It grows with the square of e - e_0: so each cell
knows how far the camera may be off before it is LINEAR_SHARE of what the cell's polynomial may be off. Beyond
that a cell is made anew for the pose, as all are on a corrugation and along a seam that bends.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from noise_model.arc.patch_borders import MAX_BORDERS, seen_strip
from noise_model.arc.quadrature import DiscRule, gauss_nodes
from noise_model.arc.ray import ArcKernel
from noise_model.arc.scratch import ArcScratch
from noise_model.arc.table import (
    ASKED,
    NEW,
    NODES,
    SHARE,
    SMOOTH,
    TO_POWERS,
    FaceTable,
    fall_off,
    fit,
    integrate,
    make_cell,
    new_table,
    root_cell,
    table_within,
)
from noise_model.compiled.arrays import Float64, Int32, Point
from noise_model.compiled.kernel import kernel
from noise_model.surface.brdf import LobeNumbers

STEP_MM, N_LATERAL = 0.2, 10
"""Spacing of the y at which tables are made, and their number on either side of the seam."""

REACH_MM = 12.0
"""The farthest that the camera may be off its nominal place, along each axis: 5 degrees of tilt at 135 mm."""

LINEAR_SHARE = 0.5
"""Largest error of the linear terms of a cell's light, in shares of the polynomial's allowance."""

BRIGHTEST = 2.0
"""The arc's output over the nominal one up to which the tables' floor in electrons holds."""

DIFFERENCE_MM = 1e-3
"""The way over which derivatives are taken."""

BEYOND_MM = 4.0
"""Reach of the tables beyond the camera's nominal view: a tool that tilts sees other places."""

TERMS = 5
"""The light itself, and its derivatives by y and by the camera's x, y and z."""

MAX_BAKED_CELLS = 400
"""Tables that need more cells are not baked: some 50 are usual. Where the camera sees the spot below the arc,
or its pixels are large on an edge, one takes thousands. No frame asks for most of them, and baking takes 5 to
20 s."""


class BakedLight(NamedTuple):
    """Tables of all faces at some lateral places (n,), the middle one on it; n is 0 where none hold.

    `center_z_mm` is the arc's height, `eye_mm` the camera's nominal place from its centre; radius, radiance,
    `material` and `vertices` are the scene's, see `ArcKernel`. The rest are a `FaceTable`'s arrays, one table
    after another, with stations from the arc's. `powers` (n, cells, TERMS, NODES, NODES) are the polynomials
    for `radiance_e`, and their derivatives by mm; `reach_mm` (n, cells) is how far the camera may be off
    along each axis for them to hold.
    """

    center_z_mm: float
    eye_mm: Point
    radius_mm: float
    radiance_e: float
    material: LobeNumbers
    vertices: Float64
    x_borders: Float64
    s_borders: Float64
    n_s: Int32
    roots: Int32
    axis: Int32
    child: Int32
    middle: Float64
    inverse: Float64
    powers: Float64
    reach_mm: Float64
    n_cells: Int32


@kernel(inline=True)
def moved(k: ArcKernel, y_mm: float, eye_mm: Point) -> ArcKernel:
    """Return a scene whose torch is moved sideways, and its camera besides."""
    (x, y, z), (e_x, e_y, e_z) = k.center, k.eye
    return ArcKernel(
        rotation=k.rotation,
        eye=(e_x + eye_mm[0], e_y + y_mm + eye_mm[1], e_z + eye_mm[2]),
        center=(x, y + y_mm, z),
        bend=k.bend,
        radius=k.radius,
        radiance_e=k.radiance_e,
        vertices=k.vertices,
        corrugation=k.corrugation,
        horizon_start=k.horizon_start,
        horizons=k.horizons,
        metal_cuts=k.metal_cuts,
        reach=k.reach,
        material=k.material,
        rule=k.rule,
    )


@kernel
def _value_at(
    k: ArcKernel, y_mm: float, eye_mm: Point, face: int, x: float, s: float, work: ArcScratch
) -> float:
    """Return the values of a cell's polynomial, light times fall-off, of a scene that is `moved`."""
    there, on = moved(k, y_mm, eye_mm), seen_strip(face, k.vertices)
    room = work.records[0]
    faces, places, light_e = room.node_faces[:], room.node_places[:], room.node_light_e[:]
    faces[0], places[0, 0], places[0, 1], light_e[0] = face, x, s, ASKED
    integrate(there, faces, places, 1, light_e, work)
    return float(fall_off(there, on, x, s) * light_e[0])


@kernel(allocates=True)
def _table_of(
    k: ArcKernel, margin_mm: float, rel: float, floor_e: float, to_powers: Float64, work: ArcScratch
) -> tuple[FaceTable, Float64, Float64]:
    """Return a complete table, and what `_derive` writes of its cells (n,): NaN and 0 of more than may be."""
    table = new_table(k, margin_mm, rel, floor_e, to_powers)
    cells_face = _complete(k, table, work)
    n = len(cells_face)
    powers, reach_mm = np.empty((n, TERMS, NODES, NODES)), np.zeros(n)
    powers[:] = math.nan
    if n <= MAX_BAKED_CELLS:
        _derive(k, table, cells_face, powers, reach_mm, work)
    return table, powers, reach_mm


@kernel(allocates=True)
def _complete(k: ArcKernel, table: FaceTable, work: ArcScratch) -> Int32:
    """Make all cells of an empty table, or some more than MAX_BAKED_CELLS; return the face (n,) of each."""
    cells_face = np.empty(table.axis.shape[0], dtype=np.int32)
    done = 0
    for face in range(table.n_s.shape[0]):
        for i in range(table.x_borders.shape[0] - 1):
            for j in range(table.n_s[face] - 1):
                root_cell(table, face, i, j)
                while done < table.n_cells[0] and done <= MAX_BAKED_CELLS:
                    cells_face[done] = face
                    make_cell(k, table, face, done, work)
                    done += 1
    return cells_face[:done].copy()


@kernel(allocates=True)
def _derive(
    k: ArcKernel, table: FaceTable, cells_face: Int32, powers: Float64, reach_mm: Float64, work: ArcScratch
) -> None:
    """Write the polynomials and their derivatives (n, TERMS, NODES, NODES) of a complete table's cells.

    Written too is how far (n,) the camera may be off. What linear terms leave out is looked at in each cell's
    corners and its middle, with the torch STEP_MM / 2 to either side, and with the camera REACH_MM off along
    each axis.
    """
    values = np.empty((TERMS, NODES, NODES))
    for cell in range(cells_face.shape[0]):
        if table.axis[cell] != SMOOTH:
            continue
        face, worst_y, worst_eye = 0 + int(cells_face[cell]), 0.0, 0.0
        half_x, half_s = 1.0 / table.inverse[cell, 0], 1.0 / table.inverse[cell, 1]
        for i in range(NODES):
            for j in range(NODES):
                x = table.middle[cell, 0] + 0.5 * (i - 2) * half_x
                s = table.middle[cell, 1] + 0.5 * (j - 2) * half_s
                here = _value_at(k, 0.0, (0.0, 0.0, 0.0), face, x, s, work)
                values[0, i, j] = here
                for term in range(1, TERMS):
                    y, eye = _step(term)
                    values[term, i, j] = (_value_at(k, y, eye, face, x, s, work) - here) / DIFFERENCE_MM
                if i % 2 == 1 or j % 2 == 1 or (i == 2) != (j == 2):
                    continue
                on = seen_strip(face, k.vertices)
                allowed = SHARE * max(table.rel * here, table.floor_e * fall_off(k, on, x, s))
                for sign in (-1.0, 1.0):
                    y = 0.5 * sign * STEP_MM
                    value = _value_at(k, y, (0.0, 0.0, 0.0), face, x, s, work)
                    worst_y = max(worst_y, abs(value - here - y * values[1, i, j]) / allowed)
                for which in range(8):
                    eye = _corner(which)
                    linear = eye[0] * values[2, i, j] + eye[1] * values[3, i, j] + eye[2] * values[4, i, j]
                    value = _value_at(k, 0.0, eye, face, x, s, work)
                    worst_eye = max(worst_eye, abs(value - here - linear) / allowed)
        rest = max(0.0, LINEAR_SHARE - worst_y)
        reach_mm[cell] = REACH_MM * (1.0 if worst_eye <= rest else math.sqrt(rest / worst_eye))
        for term in range(TERMS):
            fit(values[term], table.to_powers, powers[cell, term])


@kernel(inline=True)
def _step(term: int) -> tuple[float, Point]:
    """Return the step of a derivative: of the torch sideways, or of the camera along an axis."""
    way = DIFFERENCE_MM
    eye = way if term == 2 else 0.0, way if term == 3 else 0.0, way if term == 4 else 0.0
    return way if term == 1 else 0.0, eye


@kernel(inline=True)
def _corner(which: int) -> Point:
    """Return one of the eight ways REACH_MM along each axis."""
    return (
        REACH_MM if which % 2 == 0 else -REACH_MM,
        REACH_MM if which // 2 % 2 == 0 else -REACH_MM,
        REACH_MM if which // 4 == 0 else -REACH_MM,
    )


class Nominal(NamedTuple):
    """Key of the light about a nominal pose: an `ArcKernel`'s numbers and a table's."""

    eye: Point
    center: Point
    radius: float
    radiance_e: float
    vertices: tuple[tuple[float, ...], ...]
    reach: tuple[float, float, float, float]
    material: LobeNumbers
    nodes: tuple[int, int]
    margin_mm: float
    rel: float
    floor_e: float

    def kernel(self, y_mm: float) -> ArcKernel:
        """Return the scene whose arc has that lateral offset, with what the camera may see there."""
        x_low, x_high, y_low, y_high = self.reach
        aside_mm = y_mm - self.center[1]
        return ArcKernel(
            rotation=np.eye(3),
            eye=(self.eye[0], self.eye[1] + aside_mm, self.eye[2]),
            center=(self.center[0], y_mm, self.center[2]),
            bend=(0.0, 0.0),
            radius=self.radius,
            radiance_e=self.radiance_e,
            vertices=np.array(self.vertices),
            corrugation=np.zeros(3),
            horizon_start=0.0,
            horizons=np.empty((2, 0, 2)),
            metal_cuts=False,
            reach=(
                x_low - BEYOND_MM,
                x_high + BEYOND_MM,
                y_low + aside_mm - BEYOND_MM,
                y_high + aside_mm + BEYOND_MM,
            ),
            material=self.material,
            rule=DiscRule(gauss_nodes(), *self.nodes),
        )


def bake(k: ArcKernel, margin_mm: float, rel: float, floor_e: float) -> BakedLight:
    """Return the light about a nominal pose: tables of a plain section's faces, of others none.

    Faces run on by a margin; `rel` and `floor_e` are the tables' tolerance, see `table.new_table`.
    """
    if k.corrugation[0] > 0.0 or k.bend != (0.0, 0.0) or k.radiance_e == 0.0:
        return NOTHING_BAKED
    vertices = tuple(map(tuple, k.vertices.tolist()))
    return _baked(
        Nominal(
            eye=k.eye,
            center=k.center,
            radius=k.radius,
            radiance_e=k.radiance_e,
            vertices=vertices,
            reach=k.reach,
            material=k.material,
            nodes=(k.rule.n_p, k.rule.n_q),
            margin_mm=margin_mm,
            rel=rel,
            floor_e=floor_e,
        )
    )


@lru_cache(maxsize=8)
def _baked(nominal: Nominal) -> BakedLight:
    """Return `bake`'s tables of a plain section."""
    # No slices: the edge of a plain section is straight.
    tables, work = [], ArcScratch.of(np.array(nominal.vertices))._replace(slices=None)
    for place in range(-N_LATERAL, N_LATERAL + 1):
        k = nominal.kernel(place * STEP_MM)
        tables.append(
            _table_of(k, nominal.margin_mm, nominal.rel, nominal.floor_e / BRIGHTEST, TO_POWERS, work)
        )
        if len(tables[-1][1]) > MAX_BAKED_CELLS:
            return NOTHING_BAKED
    n_faces, n_x = tables[0][0].roots.shape[:2]
    (c_x, c_y, c_z), eye = nominal.center, nominal.eye
    baked = _room(len(tables), n_faces, n_x, max(len(powers) for _, powers, _ in tables))._replace(
        center_z_mm=c_z,
        eye_mm=(eye[0] - c_x, eye[1] - c_y, eye[2] - c_z),
        radius_mm=nominal.radius,
        radiance_e=nominal.radiance_e,
        material=nominal.material,
        vertices=np.array(nominal.vertices),
    )
    for i, (table, powers, reach_mm) in enumerate(tables):
        m = len(powers)
        baked.x_borders[:] = table.x_borders - c_x
        baked.s_borders[i], baked.n_s[i], baked.roots[i] = table.s_borders, table.n_s, table.roots
        baked.axis[i, :m], baked.child[i, :m] = table.axis[:m], table.child[:m]
        baked.middle[i, :m] = table.middle[:m] - [c_x, 0.0]
        baked.inverse[i, :m], baked.powers[i, :m] = table.inverse[:m], powers
        baked.n_cells[i], baked.reach_mm[i, :m] = m, reach_mm
    return baked


def _room(n: int, n_faces: int, n_x: int, n_cells: int) -> BakedLight:
    """Return room for n tables of some faces, borders along the seam, and cells."""
    return BakedLight(
        center_z_mm=0.0,
        eye_mm=(0.0, 0.0, 0.0),
        radius_mm=0.0,
        radiance_e=0.0,
        material=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        vertices=np.empty((n_faces + 1, 2)),
        x_borders=np.empty(n_x),
        s_borders=np.empty((n, n_faces, MAX_BORDERS)),
        n_s=np.empty((n, n_faces), dtype=np.int32),
        roots=np.empty((n, n_faces, n_x, MAX_BORDERS), dtype=np.int32),
        axis=np.empty((n, n_cells), dtype=np.int32),
        child=np.empty((n, n_cells), dtype=np.int32),
        middle=np.empty((n, n_cells, 2)),
        inverse=np.empty((n, n_cells, 2)),
        powers=np.empty((n, n_cells, TERMS, NODES, NODES)),
        reach_mm=np.empty((n, n_cells)),
        n_cells=np.empty(n, dtype=np.int32),
    )


NOTHING_BAKED = _room(0, 1, 1, 0)
"""Tables of no place: all light is integrated as it comes."""


@kernel(inline=True)
def place_baked(k: ArcKernel, baked: BakedLight) -> int:
    """Return the index of the table of a pose's light, -1 for none."""
    place = round(k.center[1] / STEP_MM) + N_LATERAL
    if not 0 <= place < baked.n_cells.shape[0] or k.bend[0] != 0.0 or k.bend[1] != 0.0:
        return -1
    if k.radius != baked.radius_mm or k.material != baked.material or not _is_section(k, baked):
        return -1
    e_x, e_y, e_z = _eye_off(k, baked)
    is_near = max(abs(e_x), abs(e_y), abs(e_z)) <= REACH_MM
    # Heights of the arc's centre that differ by less are one.
    is_as_high = abs(k.center[2] - baked.center_z_mm) <= 1e-9
    return place if is_near and is_as_high and k.radiance_e <= BRIGHTEST * baked.radiance_e else -1


@kernel
def _is_section(k: ArcKernel, baked: BakedLight) -> bool:
    """Return True if a scene's section is the one whose light is baked."""
    if k.vertices.shape[0] != baked.vertices.shape[0]:
        return False
    for i in range(k.vertices.shape[0]):
        if k.vertices[i, 0] != baked.vertices[i, 0] or k.vertices[i, 1] != baked.vertices[i, 1]:
            return False
    return True


@kernel(inline=True)
def _eye_off(k: ArcKernel, baked: BakedLight) -> Point:
    """Return the distance of the camera from its nominal place relative to the arc's centre, mm."""
    return (
        k.eye[0] - k.center[0] - baked.eye_mm[0],
        k.eye[1] - k.center[1] - baked.eye_mm[1],
        k.eye[2] - k.center[2] - baked.eye_mm[2],
    )


@kernel(allocates=True)
def table_from(
    k: ArcKernel, baked: BakedLight, place: int, rel: float, floor_e: float, to_powers: Float64
) -> FaceTable:
    """Return a pose's table with the cells that are baked at a place; see `table.new_table`."""
    x_arc = k.center[0]
    patches = (baked.x_borders + x_arc, baked.s_borders[place], baked.n_s[place], baked.roots[place].copy())
    table = table_within(k, patches, rel, floor_e, to_powers)
    table.n_cells[0] = baked.n_cells[place]
    y_off = k.center[1] - (place - N_LATERAL) * STEP_MM
    e_x, e_y, e_z = _eye_off(k, baked)
    level, off_mm = k.radiance_e / baked.radiance_e, max(abs(e_x), abs(e_y), abs(e_z))
    for cell in range(table.n_cells[0]):
        table.axis[cell], table.child[cell] = baked.axis[place, cell], baked.child[place, cell]
        table.is_ready[cell] = table.axis[cell] != SMOOTH or off_mm <= baked.reach_mm[place, cell]
        if not table.is_ready[cell]:
            table.axis[cell] = NEW + 2
        table.middle[cell, 0] = baked.middle[place, cell, 0] + x_arc
        table.middle[cell, 1] = baked.middle[place, cell, 1]
        for c in range(2):
            table.inverse[cell, c] = baked.inverse[place, cell, c]
        if table.axis[cell] == SMOOTH:
            terms, powers = baked.powers[place, cell], table.powers[cell]
            for a in range(NODES):
                for b in range(NODES):
                    by_eye = e_x * terms[2, a, b] + e_y * terms[3, a, b] + e_z * terms[4, a, b]
                    powers[a, b] = level * (terms[0, a, b] + y_off * terms[1, a, b] + by_eye)
    return table
