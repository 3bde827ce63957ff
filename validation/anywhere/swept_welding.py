"""Light of a burning arc in a picture of a joint: spatter streaks, glare along the seam, a mirrored stripe.

Nothing of the forward model is in it. Pictures of gas metal arc welding (Li et al. 2017, IEEE Trans. Ind.
Electron., doi 10.1109/TIE.2017.2694399, fig. 7) show all three: streaks that point away from the arc, some
brighter than the stripe; a groove that shines from the arc on; and the stripe of one face mirrored in the
other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from noise_model.compiled.arrays import Float64
from validation.anywhere.swept_joint import first_hit, is_open, normal_at, place, rise_at

PEAKS, LENGTHS, SIGMAS_PX = (0.2, 4.0), (0.1, 1.2), (0.6, 4.2)
"""Ranges of streaks: their peak over the stripe's, length over the image's width, and half-thickness, px.

A streak of the largest sigma is 10 px wide at half its height.
"""


class Welding(NamedTuple):
    """Streaks a frame, glare over the stripe's peak, its half-width and reach, mm, and the mirrors' share."""

    n_streaks: float = 0.0
    glare: float = 0.0
    glare_sigma_mm: float = 1.0
    glare_reach_mm: float = 30.0
    mirrored: float = 0.0


def draw_welding(draw: np.random.Generator) -> Welding:
    """Draw what an arc adds."""
    return Welding(
        n_streaks=draw.uniform(3.0, 30.0),
        glare=math.exp(draw.uniform(math.log(0.03), math.log(0.6))),
        glare_sigma_mm=draw.uniform(0.2, 2.5),
        glare_reach_mm=draw.uniform(10.0, 60.0),
        mirrored=draw.uniform(0.0, 0.35),
    )


def streaks(shape: tuple[int, int], n: float, arc_px: Float64, draw: np.random.Generator) -> Float64:
    """Return the light (H, W) over the stripe's peak of a Poisson number of streaks that point from the arc.

    A particle that crosses the image during the exposure: a bell across, even along, with round ends.
    """
    light, (v, u) = np.zeros(shape), np.indices(shape)
    for _ in range(draw.poisson(n)):
        middle = draw.uniform(0.0, 1.0, 2) * shape[::-1]
        away = (middle - arc_px) / max(float(np.linalg.norm(middle - arc_px)), 1e-6)
        peak, length = (math.exp(draw.uniform(*np.log(span))) for span in (PEAKS, LENGTHS))
        sigma, half = draw.uniform(*SIGMAS_PX), 0.5 * length * shape[1]
        du, dv = u - middle[0], v - middle[1]
        beyond = np.maximum(np.abs(du * away[0] + dv * away[1]) - half, 0.0)
        across = dv * away[0] - du * away[1]
        light += peak * np.exp(-0.5 * (across**2 + beyond**2) / sigma**2)
    return light


@njit(cache=True)
def glare(met, faces, bend, arc_x_mm, sigma_mm, reach_mm):  # type: ignore[no-untyped-def]
    """Return the light (n,) of the metal at `met` (n, 3) over that at the arc: it runs along the seam."""
    light = np.zeros(len(faces))
    for i in range(len(faces)):
        if faces[i] >= 0:
            station, y, _, _, _ = place(met[i], bend)
            light[i] = math.exp(-abs(station - arc_x_mm) / reach_mm - 0.5 * (y / sigma_mm) * (y / sigma_mm))
    return light


@njit(cache=True)
def _profile(x, y, z, sheet):  # type: ignore[no-untyped-def]
    """Return the sheet's light at a place over its peak, 0 beyond six sigmas."""
    o, plane, up = sheet[0], sheet[1], sheet[2]
    depth = (o[0] - x) * up[0] + (o[1] - y) * up[1] + (o[2] - z) * up[2]
    if depth <= 0.0:
        return 0.0
    off = plane[0] * x + plane[1] * y + plane[2] * z + plane[3]
    across = off * sheet[3, 0] / (sheet[3, 1] * depth)
    return math.exp(-0.5 * across * across) if abs(across) < 6.0 else 0.0


@njit(cache=True)
def _thrown(p, n, face, corners, bend, sheet):  # type: ignore[no-untyped-def]
    """Return the light at p, on a face, of the sheet as the other faces mirror it."""
    light, (_, y, z, _, _) = 0.0, place(p, bend)
    for k in range(corners.shape[0] - 1):
        dy, dz = corners[k + 1, 0] - corners[k, 0], corners[k + 1, 1] - corners[k, 1]
        off = (z - corners[k, 1]) * dy - (y - corners[k, 0]) * dz
        if k == face or off <= 0.0:
            continue
        m = rise_at(p, k, corners, bend)
        back = 2.0 * off / (m[0] ** 2 + m[1] ** 2 + m[2] ** 2)
        lit = _profile(p[0] - back * m[0], p[1] - back * m[1], p[2] - back * m[2], sheet)
        if lit == 0.0:
            continue
        origin, normal = sheet[0, :3].copy(), normal_at(p, k, corners, bend)
        # The bend counts at p: the seam hardly turns over a joint's width.
        above = off + (origin - p) @ m
        way = origin - 2.0 * above / math.sqrt(m[0] ** 2 + m[1] ** 2 + m[2] ** 2) * normal - p
        way /= math.sqrt(way @ way)
        t, by = first_hit(p, way, corners, bend, 1e-3, 60.0)
        if n @ way > 0.0 and by == k and is_open(p + t * way, normal, origin, corners, bend):
            light += lit
    return light


@njit(cache=True)
def mirrored_stripe(rays, met, faces, corners, bend, sheet, image):  # type: ignore[no-untyped-def]
    """Write the stripe's light (n,) over its peak that mirrors at `met` (n, 3) show along rays (n, 3).

    Either the face that a ray meets mirrors the stripe on another one, or another face mirrors the sheet onto
    it. `sheet` is its origin, plane and up, and its stand and sigma, as rows (4, 4).
    """
    origin = sheet[0, :3].copy()
    for i in range(rays.shape[0]):
        image[i] = 0.0
        if faces[i] < 0:
            continue
        n = normal_at(met[i], faces[i], corners, bend)
        p = met[i] + 1e-4 * n
        out = rays[i] - 2.0 * (rays[i] @ n) * n
        # What goes up leaves the joint.
        t, k = first_hit(p, out, corners, bend, 1e-3, 60.0) if out[2] < 0.9 else (math.nan, -1)
        if k >= 0 and k != faces[i]:
            q = p + t * out
            m, lit = normal_at(q, k, corners, bend), _profile(q[0], q[1], q[2], sheet)
            if lit > 0.0 and (origin - q) @ m > 0.0 and is_open(q, m, origin, corners, bend):
                image[i] += lit
        image[i] += _thrown(p, n, faces[i], corners, bend, sheet)
