"""Mirrored stripes: where one face of a section shows the stripe of another, and how that moves centres.

A mirror shows a stripe twice. The camera sees face B in face A: its ray to a point of A goes on, mirrored, to
B. And B throws the sheet onto A: a point of A is lit as its mirror image behind B would be. Both lie along
straight lines through the line in which A and B meet, so near a root they lie within the stripe's width.

A bell of sigma v and of the stripe's own height, u px off a stripe of sigma w, moves the bell that is fitted
to both by

    u (w^2 v sqrt(8) / S^3) exp(-u^2 / (2 S^2)),    S^2 = w^2 + v^2,

times its share, to first order: the part of its light along the derivative of the stripe's. That fades once
the two are apart. The place follows from the faces; the share is a mode of the section's fit, a side each.

How far off the sheet thrown light lies goes with n.m, n the sheet's normal and m the mirror's. With the
seam's direction that is known to 1 sigma s alone, m turns along the seam by as much.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Bool, Float64, Point
from noise_model.compiled.kernel import kernel
from noise_model.surface.faces import face_under
from tracker.joint.measured import START_SIGMA_MM, fit_points
from tracker.joint.section_fit import SHARE_SIGMA, ShapeFit
from tracker.joint.section_shapes import N_CORNERS, ROUND_GROOVE, corners_of
from tracker.profile import Section
from tracker.state import DY_MM, DZ_MM, MIRROR_PX, MISFIT_PX, Y_MM, Z_MM

COARSE_ROUND = np.array([0, 1, 2, 8, 14, 20, 25, 26, 31, 37, 43, 49, 50, 51])
"""The corners of a round groove between which its faces count as mirrors."""

NEAR_MM = 0.03
"""Distance of a point from the fit without mirrored stripes at which the next fit begins to trust it less."""

FAR_WIDTHS = 6.0
"""A mirrored stripe so many of the stripe's sigmas off moves no centre: exp(-9) of its pull is left."""

SHOWN_NATS = math.log(5.0)
"""Evidence from which on a mirrored stripe counts: one groove in six shows one that matters.

At even odds grooves that mirror nothing get sigmas three times too large. At 20 to 1 a V whose faces mirror
0.15 of the stripe is off by 4.6 of its sigmas.
"""

FLUSH_MM = 1e-3
"""A face that stands out of another one's plane by less sees nothing of it."""


@kernel
def _place_off(P: Point, Q: Point, towards: Point) -> float:
    """Return the way from P to Q along a direction."""
    return (Q[0] - P[0]) * towards[0] + (Q[1] - P[1]) * towards[1] + (Q[2] - P[2]) * towards[2]


@kernel
def _normal(face: Float64) -> tuple[float, float]:
    """Return the unit normal (y, z), towards the open side, of a face between corners (2, 2), y rising."""
    by, bz = face[1, 0] - face[0, 0], face[1, 1] - face[0, 1]
    length = math.hypot(by, bz)
    return -bz / length, by / length


@kernel
def _met(P: Point, way: Point, face: Float64) -> float:
    """Return how many times its way a ray goes from P until it meets a face's front, NaN if it does not."""
    my, mz = _normal(face)
    towards = way[1] * my + way[2] * mz
    if towards >= 0.0:
        return math.nan
    t = ((face[0, 0] - P[1]) * my + (face[0, 1] - P[2]) * mz) / towards
    along = mz * (P[1] + t * way[1] - face[0, 0]) - my * (P[2] + t * way[2] - face[0, 1])
    width = mz * (face[1, 0] - face[0, 0]) - my * (face[1, 1] - face[0, 1])
    return t if t > 0.0 and 0.0 <= along <= width else math.nan


@kernel
def seen_off_mm(
    P: Point, own: Float64, mirrored: Float64, camera: Point, laser: Point, normal: Point
) -> float:
    """Return how far off the sheet a face is that the camera sees mirrored at a point, mm; NaN if not."""
    (my, mz), (x, y, z) = _normal(own), P
    into = 2.0 * ((y - camera[1]) * my + (z - camera[2]) * mz)
    way = x - camera[0], y - camera[1] - into * my, z - camera[2] - into * mz
    t = _met(P, way, mirrored)
    return float(_place_off(laser, (x + t * way[0], y + t * way[1], z + t * way[2]), normal))


@kernel
def thrown_off_mm(P: Point, mirror: Float64, laser: Point, normal: Point, turned: float) -> float:
    """Return how far off the sheet a point's image behind a mirror that lights it lies, mm; NaN if not lit.

    The mirror's normal has a part along the seam that is `turned`, 1 sigma, at the sheet.
    """
    (my, mz), (_, y, z) = _normal(mirror), P
    above = (y - mirror[0, 0]) * my + (z - mirror[0, 1]) * mz
    lit = (laser[1] - mirror[0, 0]) * my + (laser[2] - mirror[0, 1]) * mz
    image = laser[0], laser[1] - 2.0 * lit * my, laser[2] - 2.0 * lit * mz
    if above <= 0.0 or math.isnan(_met(P, (0.0, image[1] - y, image[2] - z), mirror)):
        return math.nan
    across = normal[1] * my + normal[2] * mz
    across = math.copysign(math.hypot(across, turned), across)
    return float(_place_off(laser, P, normal) - 2.0 * above * across)


@kernel
def bell_pull_px(off_px: float, width_px: float, own_px: float) -> float:
    """Return how far a bell as high as another, off it, moves the bell that is fitted to both, px."""
    square = own_px * own_px + width_px * width_px
    shared = own_px * own_px * width_px * math.sqrt(8.0) / (square * math.sqrt(square))
    return float(off_px * shared * math.exp(-0.5 * off_px * off_px / square))


@kernel
def _stands_before(face: Float64, other: Float64) -> bool:
    """Return True if a part of a face lies in front of another one's plane."""
    my, mz = _normal(other)
    first = (face[0, 0] - other[0, 0]) * my + (face[0, 1] - other[0, 1]) * mz
    last = (face[1, 0] - other[0, 0]) * my + (face[1, 1] - other[0, 1]) * mz
    return bool(max(first, last) > FLUSH_MM)


@kernel(allocates=True)
def mirror_pulls_px(section: Section, corners: Float64, seam_mm: float) -> Float64:
    """Return how far stripes that the right side and the left mirror move centres, (2, n) px, at shares of 1.

    The faces lie between corners (k, 2).
    """
    points, sheet, psf_px, eye = section.points, section.sheet, section.light.psf_sigma_px, section.camera_mm
    n, pulls, k = points.shape[1], np.zeros((2, points.shape[1])), 0
    camera, laser = (eye[0], eye[1], eye[2]), (section.laser_mm[0], section.laser_mm[1], section.laser_mm[2])
    normal, turned = (sheet[0], sheet[1], sheet[2]), sheet[0] * section.slope_sigma
    n_faces = corners.shape[0] - 1
    facing = np.zeros((n_faces, n_faces), np.bool_)
    for i in range(n_faces):
        for j in range(n_faces):
            face, other = corners[i : i + 2], corners[j : j + 2]
            facing[i, j] = i != j and _stands_before(face, other) and _stands_before(other, face)
    for i in range(n):
        y, z, dy, dz = points[Y_MM, i], points[Z_MM, i], points[DY_MM, i], points[DZ_MM, i]
        k = face_under(y, k, corners)
        if not facing[k].any():
            continue
        own = corners[k : k + 2]
        my, mz = _normal(own)
        P = laser[0] - (sheet[1] * (y - laser[1]) + sheet[2] * (z - laser[2])) / sheet[0], y, z
        way = P[0] - (sheet[1] * dy + sheet[2] * dz) / sheet[0] - eye[0], y + dy - eye[1], z + dz - eye[2]
        # The ray of the next pixel meets the own face in Q.
        t = ((y - eye[1]) * my + (z - eye[2]) * mz) / (way[1] * my + way[2] * mz)
        Q = eye[0] + t * way[0], eye[1] + t * way[1], eye[2] + t * way[2]
        off_a_pixel_mm = abs(_place_off(P, Q, normal))
        own_px = math.hypot(sheet[3] / off_a_pixel_mm, psf_px)
        for j in range(n_faces):
            other = corners[j : j + 2]
            if not facing[k, j]:
                continue
            for is_thrown in (False, True):
                if is_thrown:
                    off = thrown_off_mm(P, other, laser, normal, turned)
                else:
                    off = seen_off_mm(P, own, other, camera, laser, normal)
                # Not so for NaN, of what is not mirrored.
                if not abs(off) < FAR_WIDTHS * own_px * off_a_pixel_mm:
                    continue
                if is_thrown:
                    change = thrown_off_mm(Q, other, laser, normal, turned) - off
                else:
                    change = seen_off_mm(Q, own, other, camera, laser, normal) - off
                if math.isnan(change) or change == 0.0:
                    continue
                mirror = other if is_thrown else own
                side = 1 if mirror[0, 0] + mirror[1, 0] > 2.0 * seam_mm else 0
                pulls[side, i] += bell_pull_px(-off / change, math.hypot(sheet[3] / change, psf_px), own_px)
    return pulls


@kernel
def mirror_nats(share: float, variance: float) -> float:
    """Return the evidence that a side mirrors the stripe over that of no mirror, by its fit."""
    return 0.5 * (share * share / variance + math.log(variance / SHARE_SIGMA**2))


@kernel
def prior_scale(share: float, variance: float) -> float:
    """Return by how much the prior's sigma is less where a side may as well mirror nothing, by its fit.

    Both are as probable before. With its probability p by the evidence a share s of variance v has the
    variance p v + p (1 - p) s^2, which a normal prior about zero leaves too.
    """
    square, wide = share * share / variance, variance / SHARE_SIGMA**2
    p = 1.0 / (1.0 + math.exp(-mirror_nats(share, variance)))
    kept = p + p * (1.0 - p) * square
    return math.sqrt(min(wide * kept / max(1.0 - kept, 1e-9), 1.0))


@kernel(allocates=True)
def _fit_with_shares(
    shape: int, section: Section, chosen: Bool, prior_sigma: Float64, start: Float64
) -> tuple[Float64, ShapeFit]:
    """Return a section's points with what mirrored stripes that it shows do to them, and a shape's fit."""
    points, m = section.points, prior_sigma.shape[0]
    fit = without = fit_points(shape, points, chosen, START_SIGMA_MM, prior_sigma, start, start)
    if math.isnan(fit.chi2) or not abs(section.sheet[0]) > 0.0:
        return points, fit
    p = start.copy()
    p[:m] = fit.parameters
    corners = np.empty((N_CORNERS[shape], 2))
    corners_of(shape, p, corners)
    if shape == ROUND_GROOVE:
        corners = corners[COARSE_ROUND]
    seam_mm = 0.5 * (corners[corners.shape[0] // 2, 0] + corners[(corners.shape[0] - 1) // 2, 0])
    pulls = mirror_pulls_px(section, corners, seam_mm)
    if not pulls.any():
        return points, fit
    points = points.copy()
    points[MIRROR_PX:] = pulls
    fit = fit_points(shape, points, chosen, NEAR_MM, prior_sigma, start, p)
    nats = 0.0
    for side in range(fit.shares.shape[1]):
        nats = max(nats, mirror_nats(fit.shares[0, side], fit.shares[1, side]))
    if math.isnan(fit.chi2) or nats < SHOWN_NATS:
        return section.points, without
    p[:m] = fit.parameters
    for i in range(points.shape[1]):
        # Pulls are of first order: the next one is a share of them.
        second_px = 0.0
        for side in range(pulls.shape[0]):
            points[MIRROR_PX + side, i] *= prior_scale(fit.shares[0, side], fit.shares[1, side])
            second_px += fit.shares[0, side] ** 2 * abs(points[MIRROR_PX + side, i])
        points[MISFIT_PX, i] = math.hypot(points[MISFIT_PX, i], second_px)
    return points, fit_points(shape, points, chosen, NEAR_MM, prior_sigma, start, p)


def fit_mirroring(
    shape: int, section: Section, chosen: Bool, prior_sigma: Float64, start: Float64
) -> tuple[Section, ShapeFit]:
    """Return a section with its mirrored stripes, and the fit of a shape to the chosen points (n,) of it."""
    points, fit = _fit_with_shares(shape, section, chosen, prior_sigma, start)
    return section._replace(points=points), fit


def without_mirrored(section: Section, shares: Float64) -> Section:
    """Return a section whose centres are moved back by what mirrored stripes of shares (2, k) moved them."""
    if not shares.size:
        return section
    points = section.points.copy()
    moved_px = shares[0] @ points[MIRROR_PX:]
    points[Y_MM] -= moved_px * points[DY_MM]
    points[Z_MM] -= moved_px * points[DZ_MM]
    return section._replace(points=points)
