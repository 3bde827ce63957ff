"""A laser sheet's trace over a section: where planes parallel to it meet the surface, and are seen."""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Bool, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.ordering import stable_order
from noise_model.instrument.camera import Intrinsics, distorted
from noise_model.instrument.laser import Sheet, depth_below, off_sheet, sheet_reflected, tangent_plane
from noise_model.surface.brdf import LobeNumbers
from noise_model.surface.faces import face_normal, face_under, ridge

STEP_MM, MAX_STEPS_SEEN = 0.75, 160
"""In which steps the stripe is followed where the camera sees it: longer ones where these would be more."""

CORNER_SIDE_MM = 1e-6
"""The stripe is looked at so near to either side of each corner."""

SAME_ELEVATION = 1e-6
"""Points of one face that a source sees edge on differ by less."""

MAX_STEPS, MET_MM = 20, 1e-5
"""Newton's steps by which a plane is met on a corrugation at most; one that is shorter is the last.

What it leaves is some 1e-11 mm: the square of it, times the corrugation's curvature.
"""

NEAREST_MM = 1.0
"""Least distance from the camera of a point in view."""


@kernel
def cut_and_project(
    y: Float64,
    z: Float64,
    face: Int64,
    vertices: Float64,
    corrugation: Float64,
    sheet: Sheet,
    shift_mm: float,
    start_x: float,
    T_joint_camera: Float64,
    lens: Intrinsics,
    material: LobeNumbers,
    along_rows: bool,
    with_light: bool,
    points_px: Float64,
    light: Float64,
) -> None:
    """Cut the sheet, `shift_mm` off itself, with the section at y, z (n,) and look at it.

    `face` (n,) are the faces that the points lie on. Writes the image points `points_px` (n, 2) as (scan,
    position), NaN behind the camera, and, `with_light`, the stripe's `light` there, the sheet's own Gaussian
    divided out.
    """
    nx, ny, nz, d = sheet.plane[0], sheet.plane[1], sheet.plane[2], sheet.plane[3]
    T, x = T_joint_camera, start_x
    for i in range(y.shape[0]):
        k = face[i]
        plain = z[i]
        # Newton's steps, each from where the plane met the point before.
        for _ in range(MAX_STEPS):
            height, slope = ridge(x, corrugation)
            if sheet.bow != 0.0:
                nx, ny, nz, d = tangent_plane(sheet, (x, y[i], plain + height))
            move = (nx * x + ny * y[i] + nz * (plain + height) + (d - shift_mm)) / (nx + nz * slope)
            x -= move
            if abs(move) < MET_MM:
                break
        P = (x, y[i], plain + ridge(x, corrugation)[0])

        wx, wy, wz = T[0, 3] - P[0], T[1, 3] - P[1], T[2, 3] - P[2]
        depth = -(T[0, 2] * wx + T[1, 2] * wy + T[2, 2] * wz)
        if not depth > NEAREST_MM:
            points_px[i, 0] = points_px[i, 1] = light[i] = math.nan
            continue
        a = -(T[0, 0] * wx + T[1, 0] * wy + T[2, 0] * wz) / depth
        b = -(T[0, 1] * wx + T[1, 1] * wy + T[2, 1] * wz) / depth
        X, Y, _, _, _, _ = distorted(a, b, lens)
        u, v = lens.fx * X + lens.cx, lens.fy * Y + lens.cy
        points_px[i, 0], points_px[i, 1] = (u, v) if along_rows else (v, u)

        if not with_light:
            light[i] = math.nan
            continue
        distance = math.sqrt(wx * wx + wy * wy + wz * wz)
        omega_r = (wx / distance, wy / distance, wz / distance)
        off = off_sheet(sheet, P) * sheet.stand / (sheet.sigma * depth_below(sheet, P))
        gaussian = math.exp(-0.5 * off * off)
        normal = face_normal(k, x, vertices, corrugation)
        lit = sheet_reflected(sheet, material, P, normal, omega_r)
        light[i] = lit / gaussian if gaussian > 0.0 else 0.0


@kernel(allocates=True)
def samples(vertices: Float64, middle_mm: float, low_mm: float, high_mm: float) -> tuple[Float64, Int64]:
    """Return the places y (n,), rising, at which the section is looked at, and the faces that they lie on.

    They reach a step beyond what is seen of it, from `low_mm` to `high_mm`, and stand next to every corner.
    """
    n_inner = vertices.shape[0] - 2
    step_mm = max(STEP_MM, (high_mm - low_mm) / MAX_STEPS_SEEN)
    first = math.floor((low_mm - middle_mm) / step_mm)
    n_even = max(math.ceil((high_mm - middle_mm) / step_mm) + 1 - first, 0)
    y = np.empty(n_even + 2 * n_inner)
    for i in range(n_even):
        y[i] = middle_mm + step_mm * (first + i)
    for k in range(n_inner):
        y[n_even + 2 * k] = vertices[k + 1, 0] - CORNER_SIDE_MM
        y[n_even + 2 * k + 1] = vertices[k + 1, 0] + CORNER_SIDE_MM
    order, rising = stable_order(y), np.empty(len(y))
    under, face = 0, np.empty(len(y), np.int64)
    for i in range(len(y)):
        rising[i] = y[order[i]]
        under = face_under(rising[i], under, vertices)
        face[i] = under
    return rising, face


@kernel
def hide_behind(y: Float64, z: Float64, source_y: float, source_z: float, seen: Bool) -> None:
    """Write which of a section's points (n,), y rising, others hide from a source.

    The section is swept, so what hides a point across it hides it: going away from the source, its elevation
    is that of the horizon so far or more.
    """
    n = y.shape[0]
    first = 0
    while first < n and y[first] < source_y:
        first += 1
    horizon = -math.inf
    for i in range(first, n):
        elevation = (z[i] - source_z) / max(y[i] - source_y, CORNER_SIDE_MM)
        seen[i] = seen[i] and elevation >= horizon - SAME_ELEVATION
        horizon = max(horizon, elevation)
    horizon = -math.inf
    for i in range(first - 1, -1, -1):
        elevation = (z[i] - source_z) / max(source_y - y[i], CORNER_SIDE_MM)
        seen[i] = seen[i] and elevation >= horizon - SAME_ELEVATION
        horizon = max(horizon, elevation)


@kernel(allocates=True)
def per_line(
    points_px: Float64,
    light: Float64,
    face: Int64,
    is_seen: Bool,
    every: int,
    position: Float64,
    strength: Float64,
    shown: Int64,
) -> bool:
    """Read a trace (n, 2) off at every so many-th scan line: place, light and face, -1 between two.

    Ends are held. Only points (n,) that are seen and met count. False if no scan line meets it.
    """
    seen, scan, n, n_scan = np.empty(len(face), np.int64), np.empty(len(face)), 0, position.shape[0]
    for i in range(len(face)):
        if is_seen[i] and math.isfinite(points_px[i, 0]):
            seen[n], scan[n] = i, points_px[i, 0]
            n += 1
    order = stable_order(scan[:n])
    for k in range(n):
        order[k] = seen[order[k]]
    if n == 0 or points_px[order[n - 1], 0] < 0.0 or points_px[order[0], 0] > n_scan - 1:
        return False
    after = 0
    for s in range(0, n_scan, every):
        while after < n and points_px[order[after], 0] < s:
            after += 1
        left, right = order[max(min(after, n - 1) - 1, 0)], order[max(min(after, n - 1), min(1, n - 1))]
        span = points_px[right, 0] - points_px[left, 0]
        share = min(max((s - points_px[left, 0]) / span, 0.0), 1.0) if span > 0.0 else 0.0
        position[s] = (1.0 - share) * points_px[left, 1] + share * points_px[right, 1]
        strength[s] = (1.0 - share) * light[left] + share * light[right]
        shown[s] = face[left] if face[left] == face[right] else -1
    return True
