"""Light at a cell's sixteen nodes at once, a lane a node, and faces and places on a plain section.

What the table's cells do not hold the caller asks node by node.
"""

from __future__ import annotations

import numpy as np

from noise_model.arc.face_lookup import VisibleFaces
from noise_model.arc.node_rays import along, places_on_plane, tell_places
from noise_model.arc.patch_borders import seen_strip
from noise_model.arc.ray import ArcKernel
from noise_model.arc.scratch import ArcScratch, Record
from noise_model.arc.table import DEGREE, FaceTable, cell_at, light_at_places
from noise_model.compiled.arrays import Float32, Float64
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import N_LANES, Lanes, any_lane, load, spread, store, where

LEVEL = 1e-6
"""A ray that goes down by less is level."""


@kernel(fastmath=REDUCTION)
def write_faces(k: ArcKernel, seen: VisibleFaces, rays: Record) -> bool:
    """Write the faces of a plain section that rays meet, `ray_casting.MISS` for none.

    False if one of them is level. See `face_lookup.face_seen`: a ray through an edge may meet either face.
    """
    down, zero, unity = along(k, 2, rays), spread(0.0), spread(1.0)
    if any_lane(down > spread(-LEVEL)):
        return False
    slope, place = zero - along(k, 1, rays) / down, zero
    for i in range(seen.slopes.shape[0]):
        place += where(slope > spread(seen.slopes[i]), unity, zero)
    store(rays.ray_places, 0, place)
    for i in range(N_LANES):
        rays.ray_faces[i] = seen.faces[int(rays.ray_places[i])]
    return True


@kernel(fastmath=REDUCTION)
def write_places(k: ArcKernel, face: int, rays: Record) -> bool:
    """Write the rays' places on a plain face, seen or not; False where one runs away from it."""
    y_0, z_0, ty, tz, _ = seen_strip(face, k.vertices)
    d_x, d_y, d_z = along(k, 0, rays), along(k, 1, rays), along(k, 2, rays)
    over = ty * (z_0 - k.eye[2]) - tz * (y_0 - k.eye[1])
    way = spread(over) / (spread(ty) * d_z - spread(tz) * d_y)
    if any_lane(way <= spread(0.0)):
        return False
    s = (spread(k.eye[1] - y_0) + way * d_y) * spread(ty) + (spread(k.eye[2] - z_0) + way * d_z) * spread(tz)
    store(rays.ray_places, 0, way * d_x)
    store(rays.ray_places, N_LANES, s)
    return True


@kernel(inline=True)
def write_light(k: ArcKernel, table: FaceTable, face: int, work: ArcScratch) -> bool:
    """Write the light, e- without the lens' fall-off, that rays receive from their places on a face.

    False where one is in none of the table's cells. See `table.light_at_places`, whose numbers these are in
    single precision.
    """
    rays = work.records[0]
    y_0, z_0, ty, tz, _ = seen_strip(face, k.vertices)
    x, s = load(rays.ray_places, 0), load(rays.ray_places, N_LANES)
    zero, unity = spread(0.0), spread(1.0)
    value, done = zero, zero
    store(rays.ray_light_e, 0, done)
    for i in range(N_LANES):
        if rays.ray_light_e[i] > 0.0:
            continue
        first_x, first_s = k.eye[0] + rays.ray_places[i], np.float64(rays.ray_places[N_LANES + i])
        cell = cell_at(k, table, face, first_x, first_s, 0.0, work)
        if cell < 0:
            return False
        t = (x - spread(table.middle[cell, 0] - k.eye[0])) * spread(table.inverse[cell, 0])
        u = (s - spread(table.middle[cell, 1])) * spread(table.inverse[cell, 1])
        is_within = (t * t <= unity) & (u * u <= unity) & (done == zero)
        value = where(is_within, _polynomial(table.powers[cell], t, u), value)
        done = where(is_within, unity, done)
        store(rays.ray_light_e, 0, done)
    if any_lane(done == zero):
        return False
    # From the arc's centre; see `table.fall_off`.
    x -= spread(k.center[0] - k.eye[0])
    y, z = spread(y_0 - k.center[1]) + s * spread(ty), spread(z_0 - k.center[2]) + s * spread(tz)
    square = x * x + y * y + z * z + spread(k.radius * k.radius)
    store(rays.ray_light_e, 0, value / (square * square))
    return True


@kernel(fastmath=REDUCTION)
def _polynomial(powers: Float64, t: Lanes, u: Lanes) -> Lanes:
    """Return a polynomial (5, 5) at (t, u), each -1 to 1."""
    value = spread(0.0)
    for a in range(DEGREE, -1, -1):
        row = spread(powers[a, 3]) + u * spread(powers[a, 4])
        row = spread(powers[a, 0]) + u * (spread(powers[a, 1]) + u * (spread(powers[a, 2]) + u * row))
        value = value * t + row
    return value


@kernel(inline=True)
def light_of_face(
    k: ArcKernel, table: FaceTable, face: int, xy: Float32, cos4: Float32, work: ArcScratch
) -> None:
    """Write the light (16,), e-, that nodes receive from a plain face, seen or not; NaN where none can come.

    The scratch holds the nodes' pixels and rays, and takes light, faces and places.
    """
    room = work.records[0]
    if write_places(k, face, room):
        tell_places(k, 0, N_LANES, room)
        light_of_nodes(k, table, face, cos4, work)
        return
    places_on_plane(k, face, xy, N_LANES, room)
    light_at_places(k, table, cos4, N_LANES, 0.0, work)


@kernel(fastmath=REDUCTION)
def light_of_nodes(k: ArcKernel, table: FaceTable, face: int, cos4: Float32, work: ArcScratch) -> None:
    """Write the light (16,), e-, that nodes receive from their places on one face, in the scratch too."""
    room = work.records[0]
    if not write_light(k, table, face, work):
        for i in range(N_LANES):
            room.faces[i] = face
        light_at_places(k, table, cos4, N_LANES, 0.0, work)
        return
    for i in range(N_LANES):
        room.light_e[i] = cos4[room.pixels[i]] * room.ray_light_e[i]
