"""Intersections of the camera's rays with the workpiece: sixteen at once on a corrugated lap."""

from __future__ import annotations

import math

from noise_model.arc.face_lookup import VisibleFaces, face_seen, meet_plane
from noise_model.arc.patch_borders import seen_strip
from noise_model.arc.ray import ArcKernel, follow
from noise_model.arc.scratch import Record
from noise_model.compiled.arrays import Float32, Point
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.lanes import N_LANES, Lanes, any_lane, greater, lesser, load, spread, store, where
from noise_model.surface.faces import across
from noise_model.surface.ray_casting import MISS
from noise_model.surface.wave import Corrugation, corrugation_of, from_crest, wave, wave_and_slope

MEETS_MM = 2e-5
"""So near over or under a sheet a ray has met it."""


@kernel
def take_rays(xy: Float32, first: int, n: int, room: Record) -> None:
    """Take the rays of n pixels, at most sixteen, from `first` on; the last one's fill the rest."""
    for i in range(N_LANES):
        pixel = room.pixels[first + min(i, n - 1)]
        room.ray_x[i], room.ray_y[i] = xy[pixel, 0], xy[pixel, 1]


@kernel(inline=True)
def along(k: ArcKernel, row: int, rays: Record) -> Lanes:
    """Return a coordinate of the rays' directions, joint frame; see `ray.direction`."""
    R = k.rotation
    return (
        spread(R[row, 0]) * load(rays.ray_x, 0) + spread(R[row, 1]) * load(rays.ray_y, 0) + spread(R[row, 2])
    )


@kernel(inline=True)
def _size(a: Lanes) -> Lanes:
    """Return each lane without its sign."""
    return greater(a, spread(0.0) - a)


@kernel(inline=True)
def _meet(x_0: float, down: float, d_x: Lanes, d_z: Lanes, corrugation: Corrugation) -> tuple[Lanes, Lanes]:
    """Return the length of rays to a corrugated sheet that goes on for ever, and their misses of it, mm.

    They come from `down` mm over the sheet's level, and meet it once. `x_0` is the eye's station, mm, from a
    crest.
    """
    # Between the crests' height and the sheet's level a ray meets the sheet.
    first, last = spread(corrugation[0] - down) / d_z, spread(-down) / d_z
    way, gap = spread(0.5) * (first + last), spread(0.0)
    # The most steps in which rays are followed to a sheet: three are usual.
    for _ in range(8):
        height, slope = wave_and_slope(spread(x_0) + way * d_x, corrugation)
        gap = spread(down) + way * d_z - height
        if not any_lane(_size(gap) > spread(MEETS_MM)):
            break
        way = lesser(greater(way - gap / (d_z - slope * d_x), first), last)
    return way, gap


@kernel(fastmath=REDUCTION)
def follow_to_lap(k: ArcKernel, rays: Record) -> bool:
    """Write the faces of a corrugated lap that rays meet, and their places; see `ray.follow`.

    False where one ray is not resolved: it may meet a ridge twice, or looks past the workpiece. Else a ray
    meets the upper sheet, as if that went on beyond its edge, before the lower one, and each once. It ends on
    the upper sheet if it meets that on this side of the edge, on the lower one if it meets that beyond the
    edge, and else on the edge itself.
    """
    d_x, d_y, d_z = along(k, 0, rays), along(k, 1, rays), along(k, 2, rays)
    corrugation = corrugation_of(k.corrugation)
    height, width, _ = corrugation
    edge_y, upper, lower = k.vertices[1, 0], k.vertices[1, 1], k.vertices[2, 1]
    zero = spread(0.0)
    # Slope over the corrugation's from which a ray meets each sheet once.
    steepest = spread(1.05 * math.pi * height / width)
    if k.eye[2] <= upper + height or any_lane(_size(d_x) * steepest + d_z >= zero):
        return False
    x_0 = from_crest(k.eye[0], corrugation)
    way_u, miss_u = _meet(x_0, k.eye[2] - upper, d_x, d_z, corrugation)
    way_l, miss_l = _meet(x_0, k.eye[2] - lower, d_x, d_z, corrugation)
    if any_lane((_size(miss_u) > spread(MEETS_MM)) | (_size(miss_l) > spread(MEETS_MM))):
        return False
    away = k.eye[1] - edge_y
    s_u, s_l = spread(away) + way_u * d_y, spread(away) + way_l * d_y
    if any_lane((s_u < spread(k.vertices[0, 0] - edge_y)) | (s_l > spread(k.vertices[3, 0] - edge_y))):
        return False
    on_upper = s_u <= zero
    way = where(on_upper, way_u, way_l)
    s, face = where(on_upper, s_u, s_l), where(on_upper, zero, spread(2.0))
    on_edge = (s_u > zero) & (s_l < zero)
    if any_lane(on_edge):
        way_e = spread(-away) / d_y
        down = spread(upper - k.eye[2]) + wave(spread(x_0) + way_e * d_x, corrugation) - way_e * d_z
        way, s, face = where(on_edge, way_e, way), where(on_edge, down, s), where(on_edge, spread(1.0), face)
    store(rays.ray_places, 0, way * d_x)
    store(rays.ray_places, N_LANES, s)
    store(rays.ray_faces, 0, face)
    return True


@kernel
def tell_faces(first: int, n: int, room: Record) -> None:
    """Write the faces that the first n rays meet, as those of pixels from `first` on."""
    for i in range(n):
        room.faces[first + i] = int(room.ray_faces[i])


@kernel
def tell_places(k: ArcKernel, first: int, n: int, room: Record) -> None:
    """Write the places x and s where the first n rays meet faces, as those of pixels from `first` on."""
    for i in range(n):
        room.places[first + i, 0] = k.eye[0] + room.ray_places[i]
        room.places[first + i, 1] = room.ray_places[N_LANES + i]


@kernel
def places_on_rays(k: ArcKernel, seen: VisibleFaces, xy: Float32, n: int, room: Record) -> None:
    """Write the faces that the rays of the first n pixels meet, and their places, x and s.

    `ray_casting.MISS` and NaN for a ray that looks past the workpiece.
    """
    if k.corrugation[0] > 0.0:
        _places_on_lap(k, xy, n, room)
        return
    for i in range(n):
        x, y = xy[room.pixels[i], 0], xy[room.pixels[i], 1]
        face = face_seen(k, seen, x, y)
        P, _ = meet_plane(k, x, y, seen_strip(max(face, 0), k.vertices))
        _write_place(k, P, face, i, room)


@kernel
def _places_on_lap(k: ArcKernel, xy: Float32, n: int, room: Record) -> None:
    """Write `places_on_rays` of a corrugated lap, sixteen at a time where each ray meets a sheet once."""
    for first in range(0, n, N_LANES):
        count = min(N_LANES, n - first)
        take_rays(xy, first, count, room)
        if follow_to_lap(k, room):
            tell_faces(first, count, room)
            tell_places(k, first, count, room)
            continue
        for i in range(first, first + count):
            P, face = follow(k, xy[room.pixels[i], 0], xy[room.pixels[i], 1])
            _write_place(k, P, face, i, room)


@kernel(inline=True)
def _write_place(k: ArcKernel, P: Point, face: int, i: int, room: Record) -> None:
    """Write the i-th face, and a point's place on it."""
    room.faces[i], room.places[i, 0], room.places[i, 1] = face, math.nan, math.nan
    if face != MISS:
        room.places[i, 0], room.places[i, 1] = P[0], across(P, seen_strip(face, k.vertices), k.corrugation)


@kernel
def places_on_plane(k: ArcKernel, face: int, xy: Float32, n: int, room: Record) -> None:
    """Write the places of the first n pixels' rays in a plain face's plane, x and s, seen or not.

    NaN where a ray runs away from it. The pixels' faces are all this one.
    """
    on = seen_strip(face, k.vertices)
    for i in range(n):
        P, is_ahead = meet_plane(k, xy[room.pixels[i], 0], xy[room.pixels[i], 1], on)
        room.faces[i], room.places[i, 0], room.places[i, 1] = face, math.nan, math.nan
        if is_ahead:
            room.places[i, 0], room.places[i, 1] = P[0], across(P, on, k.corrugation)
