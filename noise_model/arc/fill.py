"""The arc map of a band or a frame, filled from the faces' table (`table`).

The image is taken in square cells. Where the 4 by 4 rays of a cell meet one face, a bicubic polynomial
through their light times cos^4 fills it, if its highest Chebyshev coefficients are small. Where ridges hide
the arc it must hold between the nodes too. Else the cell is halved, across or along the scan lines, where it
changes more. Where a plain section shows several faces, each has a polynomial of its own, of the light on its
plane continued beyond its edges, and each scan line is cut where the rays meet another face.
What is left is read off the table pixel by pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from noise_model.arc.bicubic import LARGEST, N, fill_row, to_powers
from noise_model.arc.face_lookup import face_seen
from noise_model.arc.node_light import light_of_face, light_of_nodes, write_faces
from noise_model.arc.node_rays import follow_to_lap, places_on_rays, take_rays, tell_faces, tell_places
from noise_model.arc.ray import ArcKernel
from noise_model.arc.scratch import ArcScratch
from noise_model.arc.table import FaceTable, light_at_places
from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.surface.ray_casting import MISS

MIXED, SMALLEST = 32, 8
"""The cells' size, px, where faces may be mixed, and where they are not halved any more; LARGEST at first."""

SHARE = 0.5
"""The share of the tolerance that a cell's polynomial may use up."""

SURE = 0.5
"""A cell whose highest coefficients are below this share of what they may be is not checked between nodes."""

N_CORNERS = 4

CELL = 8
"""Number of scan lines of a band that share its place."""

FILLED, HALVED_ACROSS, HALVED_ALONG = 0, 1, 2
"""State of a cell: edges and what ridges do to light run along scan lines or across them."""

Box = tuple[int, int, int, int]
"""A cell: its first scan line and position, and their numbers."""


class Image(NamedTuple):
    """A band (n_scan, depth), e-, to be filled, and the camera whose image it is a part of.

    `xy` (n_scan n_pos, 2) and `cos4` are the camera's rays; CELL scan lines share a place of `lows`, where
    the band begins. `node_at` and `rules` are `bicubic.node_rules`, `ramp` (LARGEST,) is 0, 1, 2 ...
    """

    xy: Float32
    cos4: Float32
    n_pos: int
    node_at: Int64
    rules: Float64
    ramp: Float32
    lows: Int64
    band_e: Float32


@kernel(inline=True)
def _line_in_band(image: Image, box: Box, i: int) -> tuple[int, int, int]:
    """Return the band's start on a cell's i-th line, and the positions of the cell in it."""
    scan, pos, _, n_p = box
    low = image.lows[(scan + i) // CELL]
    return low, max(pos, low), min(pos + n_p, low + image.band_e.shape[1])


@kernel(fastmath={"contract"})
def _fill_smooth(powers: Float64, image: Image, box: Box) -> None:
    """Fill the part of a cell that lies in the band from its coefficients."""
    scan, pos, n_s, n_p = box
    for i in range(n_s):
        low, first, last = _line_in_band(image, box, i)
        t, line = -1.0 + 2.0 / (n_s - 1) * i, image.band_e[scan + i]
        fill_row(
            powers=powers,
            t=t,
            step=2.0 / (n_p - 1),
            start=pos - low,
            ramp=image.ramp,
            line=line,
            first=first - low,
            last=last - low,
        )


@kernel
def _fill_apart(k: ArcKernel, table: FaceTable, image: Image, box: Box, work: ArcScratch) -> None:
    """Fill what of a box of at most LARGEST pixels lies in the band, pixel by pixel."""
    n_pos, room = image.n_pos, work.records[0]
    pixels, light_e = room.pixels[:], room.light_e[:]
    n = 0
    for i in range(box[2]):
        _, first, last = _line_in_band(image, box, i)
        for position in range(first, last):
            pixels[n] = (box[0] + i) * n_pos + position
            n += 1
    places_on_rays(k, table.seen, image.xy, n, room)
    light_at_places(k, table, image.cos4, n, 0.0, work)
    n = 0
    for i in range(box[2]):
        low, first, last = _line_in_band(image, box, i)
        for position in range(first, last):
            image.band_e[box[0] + i, position - low] = light_e[n]
            n += 1


@kernel
def _node_pixels(n_pos: int, box: Box, node_at: Int64, pixels: Int64) -> None:
    """Write the pixels (16,) of a cell's nodes."""
    scan, pos, n_s, n_p = box
    for i in range(N):
        for j in range(N):
            pixels[N * i + j] = (scan + node_at[n_s, i]) * n_pos + pos + node_at[n_p, j]


@kernel
def _fill_mixed(k: ArcKernel, table: FaceTable, image: Image, box: Box, work: ArcScratch) -> int:
    """Fill a cell of a plain section that shows several faces, or say how it has to be halved.

    In the scratch the nodes' pixels and which faces they meet are known; the latter are left with those that
    have coefficients.
    """
    xy, n_pos, room = image.xy, image.n_pos, work.records[0]
    light_e, seen, guess = room.light_e[:], room.is_filled[:], room.run_ends[:]
    powers, band_e = room.powers[:], image.band_e
    scan, pos, n_s, n_p = box
    for face in range(k.vertices.shape[0] - 1):
        if not seen[face]:
            continue
        light_of_face(k, table, face, xy, image.cos4, work)
        across, along, minimum = to_powers(light_e, image.rules, (n_s, n_p), powers[face])
        if not max(across, along) <= SHARE * max(table.rel * minimum, table.floor_e):
            halved = _halved(n_s, n_p, across >= along)
            if halved != FILLED:
                return halved
            seen[face] = False
    t_step, u_step = 2.0 / (n_s - 1), 2.0 / (n_p - 1)
    for i in range(guess.shape[0]):
        guess[i] = -1
    for i in range(n_s):
        row = (scan + i) * n_pos
        low, first, end = _line_in_band(image, box, i)
        if first >= end:
            continue
        face = face_seen(k, table.seen, xy[row + first, 0], xy[row + first, 1])
        face_end = face_seen(k, table.seen, xy[row + end - 1, 0], xy[row + end - 1, 1])
        run = 0
        while first < end:
            last = end
            if face != face_end:
                # The last pixel that still shows this face: where it was one line before, or by halving.
                inside, last = first, end - 1
                probe = guess[run]
                for _ in range(2):
                    if inside < probe < last:
                        met = face_seen(k, table.seen, xy[row + probe, 0], xy[row + probe, 1])
                        inside, last = (probe, last) if met == face else (inside, probe)
                        probe += 1 if met == face else -1
                while last - inside > 1:
                    probe = (inside + last) // 2
                    met = face_seen(k, table.seen, xy[row + probe, 0], xy[row + probe, 1])
                    inside, last = (probe, last) if met == face else (inside, probe)
                guess[run] = last
                run = min(run + 1, guess.shape[0] - 1)
            if face != MISS and seen[face]:
                fill_row(
                    powers=powers[face],
                    t=-1.0 + t_step * i,
                    step=u_step,
                    start=pos - low,
                    ramp=image.ramp,
                    line=band_e[scan + i],
                    first=first - low,
                    last=last - low,
                )
            else:
                _fill_apart(k, table, image, (scan + i, first, 1, last - first), work)
            first = last
            if first < end:
                face = face_seen(k, table.seen, xy[row + first, 0], xy[row + first, 1])
    return FILLED


@kernel
def _halved(n_s: int, n_p: int, is_across: bool) -> int:
    """Return how a cell is halved, across the scan lines where asked and not too small; FILLED if not."""
    if n_s <= SMALLEST and n_p <= SMALLEST:
        return FILLED
    if n_p <= SMALLEST or (is_across and n_s > SMALLEST):
        return HALVED_ACROSS
    return HALVED_ALONG


@kernel
def _changes_across(faces: Int64) -> bool:
    """Return True if a cell's nodes (16,) change their face more often from line to line than along lines."""
    across, along = 0, 0
    for i in range(N):
        for j in range(N - 1):
            across += faces[N * j + i] != faces[N * j + N + i]
            along += faces[N * i + j] != faces[N * i + j + 1]
    return across >= along


@kernel
def _holds_between_nodes(
    k: ArcKernel, table: FaceTable, image: Image, box: Box, powers: Float64, allowed: float, work: ArcScratch
) -> bool:
    """Return True if a cell's polynomial is within the allowed error, e-, between nodes in its corners."""
    n_pos, room = image.n_pos, work.records[0]
    pixels, light_e = room.pixels[:], room.light_e[:]
    scan, pos, n_s, n_p = box
    down, on = (n_s - 1) // (2 * (N - 1)), (n_p - 1) // (2 * (N - 1))
    for i in range(N_CORNERS):
        line, position = (n_s - 1 - down if i // 2 else down), (n_p - 1 - on if i % 2 else on)
        pixels[i] = (scan + line) * n_pos + pos + position
    places_on_rays(k, table.seen, image.xy, N_CORNERS, room)
    light_at_places(k, table, image.cos4, N_CORNERS, 0.0, work)
    for i in range(N_CORNERS):
        line, position = pixels[i] // n_pos - scan, pixels[i] % n_pos - pos
        t, u = -1.0 + 2.0 * line / (n_s - 1), -1.0 + 2.0 * position / (n_p - 1)
        polynomial_e = 0.0
        for a in range(N - 1, -1, -1):
            on_line = powers[a, 0] + u * (powers[a, 1] + u * (powers[a, 2] + u * powers[a, 3]))
            polynomial_e = on_line + t * polynomial_e
        if not abs(polynomial_e - light_e[i]) <= allowed:
            return False
    return True


@kernel(inline=True)
def _fill_cell(k: ArcKernel, table: FaceTable, image: Image, box: Box, work: ArcScratch) -> int:
    """Fill a cell, or say how it has to be halved."""
    xy, cos4, rules, room = image.xy, image.cos4, image.rules, work.records[0]
    light_e, faces = room.light_e[:], room.faces[:]
    seen, powers = room.is_filled[:], room.powers[0]
    _, _, n_s, n_p = box
    halved = _halved(n_s, n_p, True)
    if n_s >= N and n_p >= N:
        _node_pixels(image.n_pos, box, image.node_at, room.pixels[:])
        take_rays(xy, 0, N * N, room)
        is_plain = k.corrugation[0] == 0.0
        has_faces = write_faces(k, table.seen, room) if is_plain else follow_to_lap(k, room)
        if has_faces:
            tell_faces(0, N * N, room)
        else:
            places_on_rays(k, table.seen, xy, N * N, room)
        is_one = faces[0] != MISS
        for face in range(k.vertices.shape[0] - 1):
            seen[face] = False
        for i in range(N * N):
            is_one = is_one and faces[i] == faces[0]
            if faces[i] != MISS:
                seen[faces[i]] = True
        if is_one:
            if has_faces and is_plain:
                light_of_face(k, table, faces[0], xy, cos4, work)
            elif has_faces:
                tell_places(k, 0, N * N, room)
                light_of_nodes(k, table, faces[0], cos4, work)
            else:
                light_at_places(k, table, cos4, N * N, 0.0, work)
            across, along, minimum = to_powers(light_e, rules, (n_s, n_p), powers)
            allowed = SHARE * max(table.rel * minimum, table.floor_e)
            is_smooth = max(across, along) <= allowed
            # What ridges hide has borders anywhere in a cell.
            if is_smooth and not is_plain and max(across, along) > SURE * allowed:
                is_smooth = _holds_between_nodes(k, table, image, box, powers, allowed, work)
            if is_smooth:
                _fill_smooth(powers, image, box)
                return FILLED
            halved = _halved(n_s, n_p, across >= along)
        elif is_plain and min(n_s, n_p) <= MIXED:
            return _fill_mixed(k, table, image, box, work)
        else:
            halved = _halved(n_s, n_p, _changes_across(faces))
    if halved == FILLED:
        _fill_apart(k, table, image, box, work)
    return halved


@kernel(allocates=True)
def fill_band(
    k: ArcKernel,
    table: FaceTable,
    xy: Float32,
    cos4: Float32,
    rules: tuple[Int64, Float64],
    lows: Int64,
    band_e: Float32,
    work: ArcScratch,
) -> None:
    """Fill a band (n_scan, depth), e-, by `bicubic.node_rules`. See `map.ArcMap`."""
    n_pos, ramp = cos4.shape[0] // band_e.shape[0], np.arange(LARGEST).astype(np.float32)
    image = Image(
        xy=xy, cos4=cos4, n_pos=n_pos, node_at=rules[0], rules=rules[1], ramp=ramp, lows=lows, band_e=band_e
    )
    _fill_cells(k, table, image, np.empty((64, 4), dtype=np.int64), work)


@kernel
def _fill_cells(k: ArcKernel, table: FaceTable, image: Image, stack: Int64, work: ArcScratch) -> None:
    """Fill the cells of a band; no array is made here, so that none is counted cell by cell.

    The `stack` (n, 4) holds cells still to be filled, the top one next: scan line, position, their numbers.
    """
    n_scan, depth = image.band_e.shape
    n_pos, lows = image.n_pos, image.lows
    for scan in range(0, n_scan, LARGEST):
        lines = min(LARGEST, n_scan - scan)
        low, high = n_pos, 0
        for g in range(scan // CELL, (scan + lines - 1) // CELL + 1):
            low, high = min(low, lows[g]), max(high, lows[g] + depth)
        for pos in range(low // LARGEST * LARGEST, high, LARGEST):
            stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = scan, pos, lines, min(LARGEST, n_pos - pos)
            waiting = 1
            while waiting > 0:
                waiting -= 1
                box = (stack[waiting, 0], stack[waiting, 1], stack[waiting, 2], stack[waiting, 3])
                halved = _fill_cell(k, table, image, box, work)
                if halved == FILLED:
                    continue
                s_half = (box[2] + 1) // 2 if halved == HALVED_ACROSS else box[2]
                p_half = (box[3] + 1) // 2 if halved == HALVED_ALONG else box[3]
                for s in range(0, box[2], s_half):
                    for p in range(0, box[3], p_half):
                        stack[waiting, 0], stack[waiting, 1] = box[0] + s, box[1] + p
                        stack[waiting, 2], stack[waiting, 3] = (
                            min(s_half, box[2] - s),
                            min(p_half, box[3] - p),
                        )
                        waiting += 1


@kernel
def fill_pixels(
    k: ArcKernel, table: FaceTable, xy: Float32, cos4: Float32, pixels: Int64, out: Float32, work: ArcScratch
) -> None:
    """Write the light (n,), e-, at some pixels (n,) of the whole image; NaN past the workpiece.

    Cells that hold less of them than nodes are not worth making.
    """
    x_low, x_high, y_low, y_high = k.reach
    # Number of integrals of a cell, with those of the cell that it was halved from.
    min_mm2 = 20.0 * (x_high - x_low) * (y_high - y_low) / max(len(pixels), 1)
    room = work.records[0]
    for first in range(0, len(pixels), LARGEST):
        n = min(LARGEST, len(pixels) - first)
        for i in range(n):
            room.pixels[i] = pixels[first + i]
        places_on_rays(k, table.seen, xy, n, room)
        light_at_places(k, table, cos4, n, min_mm2, work)
        for i in range(n):
            out[first + i] = room.light_e[i]
