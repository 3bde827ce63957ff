"""Visibility of the arc: kernels over a section that is drawn along the seam.

Because a section runs straight along x and a corrugation straight along y, whatever hides a part of the sky
from a surface point does so along a plane through that point: its own tangent plane, the plane through a
section's vertex line, the plane that touches a corrugation. Visibility of the arc is therefore a short list
of half-spaces of directions, exact for plain sections and to first order where a vertex line follows a
corrugation. Where a seam bends on its way to the arc, edges are parabolas in plan and a half-space that of a
tangent.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Float64, Int64, Vector
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import COUNT, N_LANES, greater, least, load, spread, where
from noise_model.surface.faces import ridge, strip
from noise_model.surface.joint import MAX_CHORDS, SurfaceSection
from noise_model.surface.wave import corrugation_of, from_crest, wave

Bend = tuple[float, float]
"""Bend of edges on their way to the arc: dy/dx at P, and their offset to the left at the arc, mm."""

MAX_PLANES = 12
"""Room for the half-spaces of one surface point."""

MAX_LEDGES = 2 * MAX_CHORDS + 4
"""Room for the faces that cut into the arc, as one surface point sees them: a rounding's chords are most."""

HORIZON_STEP_MM = 0.25
"""The horizon table's step along x; the touching point is a maximum, so the error is of second order."""


@kernel
def write_horizon(
    heights: Float64,
    x_start: float,
    rows: tuple[int, int],
    arc: tuple[float, float],
    lift: float,
    foot: float,
    table: Float64,
    hull: Int64,
) -> None:
    """Write rows first ... last - 1 of a table (n, 2): the steepest slope towards the arc, and where it is.

    Each row is a station, HORIZON_STEP_MM after the one before. `heights` (n,) are the corrugation's c(x)
    there, `arc` is the arc's center_x and radius. Seen from height c(x) for terrain that lies `lift` mm
    higher than the surface the point is on: all of it up to the arc's near side, and up to its far side what
    rises towards it to no more than c = `foot`, the arc's own level: no part of the arc stands in front of
    that and below its top. -inf where nothing lies between. `hull` (n,) is written over.

    Stations are taken from the arc outwards, and those of the upper convex hull are kept: on it the slope as
    seen from farther out rises to the steepest and falls again.
    """
    (center_x, radius), n = arc, len(heights)
    place = math.floor((center_x - x_start) / HORIZON_STEP_MM)
    for towards in (1, -1):
        # The station next to the arc's centre on this side.
        i = min(place, n - 1) if towards > 0 else max(place + 1, 0)
        # The first station past the far side, and the outermost one under the arc so far.
        beyond, under, highest = i, i + towards, -math.inf
        while 0 <= beyond < n and (center_x - (x_start + beyond * HORIZON_STEP_MM)) * towards >= -radius:
            if heights[beyond] <= foot:
                highest = max(highest, heights[beyond])
            beyond += towards
        count = 0
        while rows[0] <= i if towards > 0 else i < rows[1]:
            is_before = (center_x - (x_start + i * HORIZON_STEP_MM)) * towards >= radius
            if rows[0] <= i < rows[1]:
                steepest, touched = _touched(heights, i, lift, hull, count)
                if highest + lift > heights[i]:
                    j = under if is_before else i + towards
                    steepest, touched = _over_foot(
                        heights, i, (j, beyond, towards), lift, foot, (steepest, touched)
                    )
                where = x_start + touched * HORIZON_STEP_MM if touched >= 0 else math.nan
                table[i, 0], table[i, 1] = steepest, where
            if is_before:
                count = _onto_hull(heights, i, hull, count)
            else:
                under = i
                if heights[i] <= foot:
                    highest = max(highest, heights[i])
            i -= towards


@kernel
def _slope(heights: Float64, i: int, j: int, lift: float) -> float:
    """Return the slope from station i to terrain that lies `lift` mm higher, at station j."""
    slope: float = (heights[j] + lift - heights[i]) / (abs(j - i) * HORIZON_STEP_MM)
    return slope


@kernel
def _touched(heights: Float64, i: int, lift: float, hull: Int64, count: int) -> tuple[float, int]:
    """Return the steepest slope from station i to the first `count` stations of a hull, and the station.

    -inf and -1 without any.
    """
    if count == 0:
        return -math.inf, -1
    first, last = 0, count - 1
    while first < last:
        middle = (first + last) // 2
        if _slope(heights, i, hull[middle], lift) > _slope(heights, i, hull[middle + 1], lift):
            last = middle
        else:
            first = middle + 1
    return _slope(heights, i, hull[first], lift), hull[first]


@kernel
def _over_foot(
    heights: Float64,
    i: int,
    stations: tuple[int, int, int],
    lift: float,
    foot: float,
    steepest: tuple[float, int],
) -> tuple[float, int]:
    """Return the steepest of `steepest` and of stations under the arc that rise to its foot at most."""
    max_slope, touched = steepest
    (j, end, step), min_slope = stations, max(max_slope, 0.0)
    while j != end:
        slope = _slope(heights, i, j, lift)
        if heights[j] <= foot and slope > min_slope:
            min_slope, max_slope, touched = slope, slope, j
        j += step
    return max_slope, touched


@kernel
def _onto_hull(heights: Float64, i: int, hull: Int64, count: int) -> int:
    """Add a station, farther out than `count` others, to their upper convex hull; return how many it has."""
    while count >= 2:
        far, near = hull[count - 2], hull[count - 1]
        if (heights[near] - heights[far]) * abs(i - far) > (heights[i] - heights[far]) * abs(near - far):
            break
        count -= 1
    hull[count] = i
    return count + 1


@kernel(inline=True)
def touch(horizon: Float64, x_start: float, x: float) -> tuple[float, float]:
    """Look a station up in a horizon table: slope (interpolated) and place of the touching point."""
    position = (x - x_start) / HORIZON_STEP_MM
    i = int(position)
    if i < 0 or i >= horizon.shape[0] - 1:
        return -math.inf, math.nan
    share = position - i
    if horizon[i, 0] == -math.inf or horizon[i + 1, 0] == -math.inf:
        return horizon[i, 0], horizon[i, 1]
    slope = (1.0 - share) * horizon[i, 0] + share * horizon[i + 1, 0]
    return slope, (1.0 - share) * horizon[i, 1] + share * horizon[i + 1, 1]


@kernel(fastmath=REDUCTION)
def steepest(P: Vector, sheet_z: float, center: Vector, radius: float, corrugation: Float64) -> float:
    """Return the steepest slope from P over one sheet on the way to the arc, as in `write_horizon`.

    Sixteen stations are looked at together. -inf where nothing lies between.
    """
    towards = 1.0 if center[0] > P[0] else -1.0
    n = int((abs(center[0] - P[0]) + radius) / HORIZON_STEP_MM)
    sizes = corrugation_of(corrugation)
    x_0 = from_crest(P[0], sizes)
    zero, none, highest = spread(0.0), spread(-math.inf), spread(-math.inf)
    for first in range(1, n + 1, N_LANES):
        count = load(COUNT, 0) + spread(float(first))
        way = count * spread(HORIZON_STEP_MM)
        height = spread(sheet_z) + wave(spread(x_0) + spread(towards) * way, sizes)
        slope = (height - spread(P[2])) / way
        is_before = way <= spread((center[0] - P[0]) * towards - radius)
        counts = is_before | ((slope > zero) & (height <= spread(center[2])))
        highest = greater(where(counts & (count <= spread(float(n))), slope, none), highest)
    return float(-least(zero - highest))


@kernel(inline=True)
def is_curved_lap(vertices: Float64, corrugation: Float64, bend: Bend) -> bool:
    """Return True if a section is a lap with no straight edge: `arc.slices` has what it hides of the arc."""
    is_lap = vertices.shape[0] == 4 and vertices[1, 0] == vertices[2, 0] and vertices[1, 1] > vertices[2, 1]
    return is_lap and (corrugation[0] > 0.0 or bend[0] != 0.0 or bend[1] != 0.0)


@kernel(inline=True)
def bent(P: Vector, center: Vector, radius: float, bend: Bend) -> tuple[float, float]:
    """Return slope and curve, 1/mm, of edges at P's station: the parabola that is `bend`'s under the arc."""
    slope, lateral = bend
    way = center[0] - P[0]
    if abs(way) <= radius:
        return 0.0, 0.0
    return slope, 2.0 * (lateral - slope * way) / (way * way)


@kernel
def first_crossing(over: float, across: float, curve: float, from_below: bool) -> float:
    """Return the first t at which over + across t - curve t^2 / 2, a way's distance from an edge, is 0.

    inf for none. On the edge itself a way that comes from the other side than `from_below` says crosses it.
    """
    leaves = (across > 0.0) == from_below and across != 0.0
    if curve == 0.0 or (over == 0.0 and leaves):
        return -over / across if leaves else math.inf
    square = across * across + 2.0 * curve * over
    if square < 0.0:
        return math.inf
    # Without differences of like numbers.
    half = across + math.copysign(math.sqrt(square), across)
    first = math.inf
    for t in (half / curve, -2.0 * over / half if half != 0.0 else math.inf):
        if 0.0 < t < first:
            first = t
    return first


@kernel
def tangent(P: Vector, center: Vector, radius: float, edge_y: float, bend: Bend) -> tuple[float, float]:
    """Return the slope dy/dx of an edge where the way from P to the arc's centre comes to it, and its place.

    What a `bent` edge, at `edge_y` at P's station, hides is what its tangent does where it is passed, or
    passed most closely; that tangent runs off `edge_y` at P's station by the second number, mm.
    """
    slope, curve = bent(P, center, radius, bend)
    if slope == 0.0 and curve == 0.0:
        return 0.0, 0.0
    way = center[0] - P[0]
    over, towards = P[1] - edge_y, (center[1] - P[1]) / way - slope
    share = first_crossing(over, towards * way, curve * way * way, over < 0.0)
    if not share < 1.0:
        nearest = towards / curve if curve != 0.0 else math.inf
        share = min(max(nearest / way, 0.0), 1.0)
    x = share * way
    return slope + curve * x, -0.5 * curve * x * x


@kernel(inline=True)
def _is_low_end(k: int, face: int, z: float, vertices: Float64) -> bool:
    """Return True if vertex k is a plate's far end that hides nothing from a face's point at height z, mm.

    It hides something where the plate rises towards it, as in a fillet's inside corner, or where the face
    stands on the plate, as a lap's edge does.
    """
    last = vertices.shape[0] - 1
    if k == 0:
        return vertices[0, 1] <= vertices[1, 1] and (face != 1 or z <= vertices[0, 1])
    return k == last and vertices[k, 1] <= vertices[k - 1, 1] and (face != k - 2 or z <= vertices[k, 1])


@kernel(inline=True)
def _own_planes(P: Vector, normal: Vector, center: Vector, radius: float, bend: Bend, planes: Float64) -> int:
    """Write the half-spaces that P's own face leaves open; return how many. The first is P's own horizon."""
    planes[0, 0], planes[0, 1], planes[0, 2] = normal[0], normal[1], normal[2]
    lateral, way = bend[1], center[0] - P[0]
    if lateral == 0.0 or abs(way) <= radius or abs(normal[1]) <= 1e-9:
        return 1
    # A face that bends stands in its own way.
    planes[1, 0], planes[1, 1], planes[1, 2] = normal[0] - lateral / way * normal[1], normal[1], normal[2]
    return 2


@kernel(inline=True)
def _add_ridge(slope: float, towards: float, normal: Vector, face: int, planes: Float64, count: int) -> int:
    """Add to `count` half-spaces that over a ridge, unless it is below P's own horizon; return how many."""
    if slope == -math.inf or (face != 1 and towards * normal[0] + slope * normal[2] <= 1e-9):
        return count
    planes[count, 0], planes[count, 1], planes[count, 2] = -towards * slope, 0.0, 1.0
    return count + 1


@kernel(inline=True)
def lap_planes(
    P: Vector,
    normal: Vector,
    face: int,
    center: Vector,
    radius: float,
    bend: Bend,
    vertices: Float64,
    corrugation: Float64,
    horizon_start: float,
    horizons: Float64,
    planes: Float64,
) -> tuple[int, float]:
    """Write the half-spaces m.omega > 0 that a lap's own face and ridges leave open; return how many.

    Returned too is the station at which P's own sheet hides most, NaN for none. The edge is left to
    `arc.slices`, and so is what of the upper sheet stands before an arc that reaches past it. `horizons`
    (2, n, 2), of `horizons_of_scenes`, are for terrain as high as P's sheet, and lower by the sheets' step.
    """
    count, crest_x = _own_planes(P, normal, center, radius, bend, planes), math.nan
    if corrugation[0] == 0.0 or abs(center[0] - P[0]) <= radius:
        return count, crest_x
    # Vertex 1 is the upper sheet's edge, vertex 2 its foot.
    towards, lateral, edge_y = 1.0 if center[0] > P[0] else -1.0, bend[1], vertices[1, 0]
    on_upper = face == 0
    if face == 1:
        # A point of the edge stands over the sheet that the tables are for.
        slope = steepest(P, vertices[2, 1], center, radius, corrugation)
    else:
        slope, crest_x = touch(horizons[0], horizon_start, P[0])
    if not (on_upper and center[1] - lateral + radius > edge_y):
        count = _add_ridge(slope, towards, normal, face, planes, count)
    if on_upper and center[1] - lateral > edge_y:
        # The upper sheet hides up to its edge, beyond the edge the lower one does.
        slope, _ = touch(horizons[1], horizon_start, P[0])
        count = _add_ridge(slope, towards, normal, face, planes, count)
    return count, crest_x


@kernel
def sky_planes(
    P: Vector,
    normal: Vector,
    face: int,
    center: Vector,
    radius: float,
    bend: Bend,
    vertices: Float64,
    planes: Float64,
    ledges: Float64,
) -> tuple[int, int]:
    """Write the half-spaces m.omega > 0 of directions in which P sees the arc; return how many, and ledges.

    `planes` (MAX_PLANES, 3). The first is P's own horizon. `ledges` (2 MAX_LEDGES, 3) are pairs of a
    half-space and a face (n_y, n_z, c) that cuts into the arc: what lies behind it, n_y y + n_z z < c, is
    seen in the half-space alone. Edges that `bend` are taken along their `tangent`; a ledge is written as if
    that ran along x, in coordinates y - shear (x - P_x), with shear in place of the half-space's m_x.
    """
    count, n_ledges = _own_planes(P, normal, center, radius, bend, planes), 0
    lateral, way = bend[1], center[0] - P[0]
    # Of all that stands on one side the steepest hides what the others do; (dy, dz) and shear of those.
    right_dy, right_dz, right_shear, left_dy, left_dz, left_shear = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(vertices.shape[0]):
        if k in (face, face + 1) or _is_low_end(k, face, P[2], vertices):
            continue
        y_k, z_k = vertices[k, 0], vertices[k, 1]
        # A vertex no higher than the arc's foot hides nothing that stands before it, and nothing at all from
        # a point above it.
        low_vertex = z_k <= center[2] + 1e-9
        shear, aside = tangent(P, center, radius, y_k, bend)
        dy, dz = y_k + aside - P[1], z_k - P[2]
        # What lies below P's own horizon hides nothing more, and its half-space would cut the other side.
        if (low_vertex and dz <= 0.0) or dy * normal[1] + dz * normal[2] <= 1e-9:
            continue
        # By the faces' order, so that it holds on a face's plane beyond its edges too.
        side = 1.0 if k > face else -1.0
        if low_vertex:
            if (center[1] - lateral + side * radius - y_k) * side <= 0.0:
                continue
        else:
            # The face below a higher one, on P's side.
            low = k - 1 if side > 0.0 else k
            _, _, along_y, along_z, _ = strip(low, vertices)
            n_y, n_z = -along_z, along_y
            before = n_y * (center[1] - lateral - y_k) + n_z * (center[2] - z_k)
            if before >= radius:
                continue
            if before > -radius and n_ledges < MAX_LEDGES:
                i = 2 * n_ledges
                wall_y = y_k + lateral - shear * way
                ledges[i, 0], ledges[i, 1], ledges[i, 2] = shear, -side * dz, side * dy
                ledges[i + 1, 0], ledges[i + 1, 1], ledges[i + 1, 2] = n_y, n_z, n_y * wall_y + n_z * z_k
                n_ledges += 1
                continue
        if side > 0.0 and left_dy * dz - left_dz * dy >= 0.0:
            left_dy, left_dz, left_shear = dy, dz, shear
        elif side < 0.0 and right_dy * dz - right_dz * dy <= 0.0:
            right_dy, right_dz, right_shear = dy, dz, shear
    if left_dy != 0.0 or left_dz != 0.0:
        planes[count, 0], planes[count, 1], planes[count, 2] = left_shear * left_dz, -left_dz, left_dy
        count += 1
    if right_dy != 0.0 or right_dz != 0.0:
        planes[count, 0], planes[count, 1], planes[count, 2] = -right_shear * right_dz, right_dz, -right_dy
        count += 1
    return count, n_ledges


@kernel(allocates=True)
def _write_horizons(
    starts: Float64,
    counts: Int64,
    x_ranges: Float64,
    centers: Float64,
    radius: float,
    corrugation: Float64,
    terrain: tuple[float, float],
    tables: Float64,
) -> None:
    """Write the tables of `horizons_of_scenes`; the sheets of the lap lie at `terrain`, mm."""
    upper, lower = terrain
    heights, hull = np.empty(tables.shape[2]), np.empty(tables.shape[2], np.int64)
    for s in range(len(starts)):
        start, n, center_x = starts[s], counts[s], centers[s, 0]
        for i in range(n):
            heights[i] = ridge(start + i * HORIZON_STEP_MM, corrugation)[0]
        # A station is looked up between two rows.
        first = max(0, int((x_ranges[s, 0] - start) / HORIZON_STEP_MM) - 1)
        last = min(n, int((x_ranges[s, 1] - start) / HORIZON_STEP_MM) + 3)
        for sheet in range(2):
            lift, level = (0.0, upper) if sheet == 0 else (lower - upper, lower)
            foot = centers[s, 2] - level
            write_horizon(
                heights=heights[:n],
                x_start=start,
                rows=(first, last),
                arc=(center_x, radius),
                lift=lift,
                foot=foot,
                table=tables[s, sheet],
                hull=hull,
            )


def horizons_of_scenes(
    shape: SurfaceSection, x_ranges_mm: Float64, centers: Float64, radius: float, everywhere: bool
) -> tuple[Float64, Float64]:
    """Return the starts (s,), mm, and the (s, 2, n, 2) horizon tables of several scenes, else empty ones.

    They reach from `x_ranges_mm` (s, 2) to the arc, and are filled within these or `everywhere`; else NaN.
    """
    n_scenes = len(centers)
    starts, counts = np.zeros(n_scenes), np.zeros(n_scenes, dtype=np.int64)
    if shape.corrugation[0] == 0.0:
        return starts, np.empty((n_scenes, 2, 0, 2))
    asked_mm = x_ranges_mm.copy()
    lowest_mm, highest_mm = math.inf, -math.inf
    for s in range(n_scenes):
        # At multiples of the step, so that a pose a little on has the same stations.
        lowest = min(x_ranges_mm[s, 0], centers[s, 0] - radius)
        highest = max(x_ranges_mm[s, 1], centers[s, 0] + radius) + HORIZON_STEP_MM
        starts[s] = HORIZON_STEP_MM * (math.floor(lowest / HORIZON_STEP_MM) - 1.0)
        counts[s] = math.ceil((highest - starts[s]) / HORIZON_STEP_MM) + 1
        lowest_mm, highest_mm = min(lowest_mm, lowest), max(highest_mm, highest)
    if everywhere:
        asked_mm[:, 0], asked_mm[:, 1] = lowest_mm, highest_mm
    tables = np.full((n_scenes, 2, counts.max(), 2), np.nan)
    terrain = shape.vertices[1, 1], shape.vertices[2, 1]
    _write_horizons(
        starts=starts,
        counts=counts,
        x_ranges=asked_mm,
        centers=centers,
        radius=radius,
        corrugation=shape.corrugation,
        terrain=terrain,
        tables=tables,
    )
    return starts, tables
