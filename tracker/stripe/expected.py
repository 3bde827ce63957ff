"""Where the nominal joint puts the stripe for a pose, and how wide and how lopsided it looks there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.arrays import Bool, Float64, Int64
from noise_model.instrument.camera import Intrinsics, distorted
from noise_model.instrument.laser import Sheet, beyond_fan_mm, depth_below, sheet_of, sheet_reflected
from noise_model.kernel import kernel
from noise_model.surface.brdf import LobeNumbers, lobe_numbers
from noise_model.surface.faces import face_normal, face_under, ridge, slope_across
from noise_model.surface.joint import EDGE_STANDS_MM
from tracker.geometry import SensorGeometry, to_laser_plane
from tracker.stripe.bias import PLANES, fit_bell

STEP_MM, MAX_STEPS_SEEN = 0.75, 160
"""In which steps the stripe is followed where the camera sees it: longer ones where these would be more."""

FLANKS = np.array([-1.0, 0.0, 1.0])
"""Planes across the sheet, in its sigmas, that tell width and bias of a stripe on flat faces."""

EVERY = 8
"""Every so many scan lines a bell is fitted to the light of all planes: both change slowly along a face."""

BESIDE_MM = 1e-6
"""The stripe is looked at so near to either side of each corner."""

SAME_ELEVATION = 1e-6
"""Points of one face that a source sees edge on differ by less."""

MAX_STEPS, MET_MM = 20, 1e-9
"""Steps by which a plane is met on a corrugation at most; one that is shorter is the last."""

NEAREST_MM = 1.0
"""What comes nearer to the camera than this is not in view."""

FAN_SLACK_MM = 2.0
"""So far beyond the fan's end a stripe is still looked for: a surface farther off is lit farther out."""


@dataclass(frozen=True)
class ExpectedStripe:
    """The stripe that the joint would show, per scan line (n_scan,), px.

    `position_px` its centre, `sigma_px` its 1 sigma (sheet and point-spread function), `bias_px` how far its
    light's centre lies off the laser plane's trace because reflectance and fall-off vary across it. `shown`
    says where the joint would show it at all, and not what an edge joint stands on, deep out of sight, nor
    what lies beyond the fan's end; `is_sought` where it is looked for.
    """

    position_px: Float64
    sigma_px: Float64
    bias_px: Float64
    shown: Bool
    is_sought: Bool

    @property
    def shown_px(self) -> Float64:
        """The stripe's centre (n_scan,), px, NaN where it is not shown."""
        return np.where(self.shown, self.position_px, np.nan)


def expect_stripe(geometry: SensorGeometry, scene: Scene) -> ExpectedStripe | None:
    """Return the expected stripe of a scene, or None where it is out of view.

    The sheet's middle and its two one-sigma planes are cut with the section, projected into the image and
    read off per scan line; what the section hides from camera or laser is left out, and beyond what is seen
    the ends are held. A Gaussian stripe whose strength varies as
    exp(k v) is that Gaussian moved by k sigma^2. One that is wider on one side by the surface's curve,
    v = a x + b x^2, moves the least-squares centre by 3/2 b sigma_x^2, as its third-order term projects on
    the derivative of the Gaussian. Both together are the bias, with k from the model of the light. On a
    corrugation, which may mirror the laser for a part of the stripe, `tracker.stripe.bias` fits centre and
    width.
    """
    setup = geometry.setup
    position, sigma, bias = np.empty((3, geometry.n_scan))
    face = np.empty(geometry.n_scan, dtype=np.int64)
    vertices = scene.shape.vertices
    below = vertices[:, 1] <= -EDGE_STANDS_MM
    # A face that is deep throughout; a ridge's faces only end there.
    is_deep = below[:-1] & below[1:]
    if is_deep.any():
        # The seam may be off its place by more than its sheets are wide: they are looked for beside it too.
        lifted = np.append(is_deep, False) | np.append(False, is_deep)
        vertices = np.column_stack([vertices[:, 0], np.where(lifted, 0.0, vertices[:, 1])])
    in_view = _expect(
        PLANES if scene.shape.corrugation[0] > 0.0 else FLANKS,
        vertices,
        scene.shape.corrugation,
        np.ascontiguousarray(scene.T_joint_tool[:3, 3]),
        scene.footprint_mm[1],
        # Place and width go on beyond the fan's end, where a light that stops would bend them.
        sheet_of(setup.laser, scene.T_joint_tool)._replace(slope=math.inf),
        scene.T_joint_camera,
        setup.camera.intrinsics,
        lobe_numbers(setup.material),
        geometry.along_rows,
        setup.camera.psf_sigma_px,
        position,
        sigma,
        bias,
        face,
    )
    if not in_view:
        return None
    shown = np.ones(geometry.n_scan, dtype=np.bool_)
    if is_deep.any():
        shown = (face < 0) | ~is_deep[face]
    beyond_mm = _beyond_fan_mm(geometry, position)
    return ExpectedStripe(position, sigma, bias, shown & ~(beyond_mm > 0.0), ~(beyond_mm > FAN_SLACK_MM))


def _beyond_fan_mm(geometry: SensorGeometry, position_px: Float64) -> Float64:
    """Return how far beyond the fan's end the sheet is seen at positions (n_scan,) of the scan lines, mm.

    It is negative within the fan, and NaN where the sheet is not met.
    """
    laser = geometry.setup.laser
    if laser.fan_half_angle_deg is None:
        return np.full(geometry.n_scan, -math.inf)
    points_px = geometry.image_points(np.arange(geometry.n_scan, dtype=np.float64), position_px)
    return beyond_fan_mm(to_laser_plane(geometry.setup, points_px)[0], laser)


@kernel
def _cut_and_project(
    y: Float64,
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
    """Cut a plane `shift_mm` beside the sheet with the section at y (n,) and look at it.

    `face` (n,) are the faces that the points lie on. Writes the image points `points_px` (n, 2) as (scan,
    position), NaN behind the camera, and, `with_light`, the stripe's `light` there, the sheet's own Gaussian
    divided out.
    """
    nx, ny, nz, d = sheet.plane[0], sheet.plane[1], sheet.plane[2], sheet.plane[3] - shift_mm
    T, x = T_joint_camera, start_x
    for i in range(y.shape[0]):
        k = face[i]
        plain = vertices[k, 1] + slope_across(k, vertices) * (y[i] - vertices[k, 0])
        for _ in range(MAX_STEPS):
            met = -(ny * y[i] + nz * (plain + ridge(x, corrugation)[0]) + d) / nx
            moved = abs(met - x)
            x = met
            if moved < MET_MM:
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
        off = nx * P[0] + ny * P[1] + nz * P[2] + sheet.plane[3]
        off *= sheet.stand / (sheet.sigma * depth_below(sheet, P))
        gaussian = math.exp(-0.5 * off * off)
        normal = face_normal(k, x, vertices, corrugation)
        lit = sheet_reflected(sheet, material, P, normal, omega_r)
        light[i] = lit / gaussian if gaussian > 0.0 else 0.0


@kernel(allocates=True)
def _samples(vertices: Float64, middle_mm: float, low_mm: float, high_mm: float) -> tuple[Float64, Int64]:
    """Return the places y (n,), rising, at which the section is looked at, and the faces that they lie on.

    They reach a step beyond what is seen of it, from `low_mm` to `high_mm`, and stand beside every corner.
    """
    n_inner = vertices.shape[0] - 2
    step_mm = max(STEP_MM, (high_mm - low_mm) / MAX_STEPS_SEEN)
    first = math.floor((low_mm - middle_mm) / step_mm)
    n_even = max(math.ceil((high_mm - middle_mm) / step_mm) + 1 - first, 0)
    y = np.empty(n_even + 2 * n_inner)
    for i in range(n_even):
        y[i] = middle_mm + step_mm * (first + i)
    for k in range(n_inner):
        y[n_even + 2 * k] = vertices[k + 1, 0] - BESIDE_MM
        y[n_even + 2 * k + 1] = vertices[k + 1, 0] + BESIDE_MM
    y.sort()
    under, face = 0, np.empty(len(y), dtype=np.int64)
    for i in range(len(y)):
        under = face_under(y[i], under, vertices)
        face[i] = under
    return y, face


@kernel
def _hide_behind(y: Float64, z: Float64, source_y: float, source_z: float, seen: Bool) -> None:
    """Say of a section's points (n,), y rising, which of them others hide from a source: they are not seen.

    The section is swept, so what hides a point across it hides it: going away from the source, its elevation
    is that of the horizon so far or more.
    """
    n = y.shape[0]
    first = 0
    while first < n and y[first] < source_y:
        first += 1
    horizon = -math.inf
    for i in range(first, n):
        elevation = (z[i] - source_z) / max(y[i] - source_y, BESIDE_MM)
        seen[i] = seen[i] and elevation >= horizon - SAME_ELEVATION
        horizon = max(horizon, elevation)
    horizon = -math.inf
    for i in range(first - 1, -1, -1):
        elevation = (z[i] - source_z) / max(source_y - y[i], BESIDE_MM)
        seen[i] = seen[i] and elevation >= horizon - SAME_ELEVATION
        horizon = max(horizon, elevation)


@kernel(allocates=True)
def _per_line(
    points_px: Float64,
    light: Float64,
    face: Int64,
    seen: Int64,
    every: int,
    position: Float64,
    strength: Float64,
    shown: Int64,
) -> bool:
    """Read a trace (n, 2) off at every so many-th scan line: place, light and face, -1 between two.

    Ends are held. Only the points `seen` (m,) count. False if no scan line meets it.
    """
    # Indexed, the column is contiguous: a strided one would compile the sort anew.
    order = seen[np.argsort(points_px[:, 0][seen], kind="mergesort")]
    n, n_scan = len(order), position.shape[0]
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


@kernel(allocates=True)
def _expect(
    planes: Float64,
    vertices: Float64,
    corrugation: Float64,
    tool_mm: Float64,
    seen_mm: Float64,
    sheet: Sheet,
    T_joint_camera: Float64,
    lens: Intrinsics,
    material: LobeNumbers,
    along_rows: bool,
    psf_sigma_px: float,
    position: Float64,
    sigma: Float64,
    bias: Float64,
    face_shown: Int64,
) -> bool:
    """Write an expected stripe (n_scan,), see `expect_stripe`; False where it is out of view."""
    n_scan = position.shape[0]
    y, face = _samples(vertices, tool_mm[1], seen_mm[0], seen_mm[1])
    n = len(y)
    points_px, light = np.empty((n, 2)), np.empty(n)
    z, is_seen = np.empty(n), np.ones(n, dtype=np.bool_)
    for i in range(n):
        z[i] = vertices[face[i], 1] + slope_across(face[i], vertices) * (y[i] - vertices[face[i], 0])
    lift = ridge(tool_mm[0], corrugation)[0]
    _hide_behind(y, z, T_joint_camera[1, 3], T_joint_camera[2, 3] - lift, is_seen)
    _hide_behind(y, z, sheet.origin[1], sheet.origin[2] - lift, is_seen)
    n_planes = planes.shape[0]
    places, strengths = np.empty((n_planes, n_scan)), np.empty((n_planes, n_scan))
    faces = np.empty((n_planes, n_scan), dtype=np.int64)
    middle, flank = n_planes // 2, round(1.0 / (planes[1] - planes[0]))
    before, behind = middle - flank, middle + flank
    for k in range(n_planes):
        shift = planes[k] * sheet.sigma
        # Of three the bias is made of the flanks' light.
        with_light = shift != 0.0 or n_planes > FLANKS.shape[0]
        _cut_and_project(
            y,
            face,
            vertices,
            corrugation,
            sheet,
            shift,
            tool_mm[0],
            T_joint_camera,
            lens,
            material,
            along_rows,
            with_light,
            points_px,
            light,
        )
        in_sight = np.flatnonzero(is_seen & np.isfinite(points_px[:, 0]))
        every = 1 if k in (before, middle, behind) else EVERY
        if not _per_line(points_px, light, face, in_sight, every, places[k], strengths[k], faces[k]):
            return False
    good = np.empty(n_scan, dtype=np.bool_)
    for s in range(n_scan):
        half_width = 0.5 * (places[behind, s] - places[before, s])
        position[s] = places[middle, s]
        on = faces[middle, s]
        good[s] = on >= 0 and faces[before, s] == on and faces[behind, s] == on
        sigma[s] = math.hypot(half_width, psf_sigma_px)
        shading = 0.0
        if strengths[before, s] > 0.0 and strengths[behind, s] > 0.0:
            shading = 0.5 * half_width * math.log(strengths[behind, s] / strengths[before, s])
        bias[s] = shading + 1.5 * (0.5 * (places[behind, s] + places[before, s]) - places[middle, s])
    if n_planes > FLANKS.shape[0]:
        _bells(planes, places, strengths, faces, good, psf_sigma_px, sigma, bias)
    _take_from_same_face(sigma, bias, faces[middle], good)
    face_shown[:] = faces[middle]
    return True


@kernel(allocates=True)
def _bells(
    planes: Float64,
    places: Float64,
    strengths: Float64,
    faces: Int64,
    good: Bool,
    psf_sigma_px: float,
    sigma: Float64,
    bias: Float64,
) -> None:
    """Replace sigma and bias (n_scan,) by those of bells, and between two on one face by a straight line.

    `places`, `strengths` and `faces` (n_planes, n_scan) are what planes show; only `good` lines are asked.
    """
    n_planes, n_scan = places.shape
    middle, flank = n_planes // 2, round(1.0 / (planes[1] - planes[0]))
    seen, bell = np.empty(n_planes), np.empty(2)
    is_fitted = np.zeros(n_scan, dtype=np.bool_)
    for s in range(0, n_scan, EVERY):
        on = faces[middle, s]
        width_px = 0.5 * abs(places[middle + flank, s] - places[middle - flank, s])
        for k in range(n_planes):
            is_same = faces[k, s] == on
            seen[k] = strengths[k, s] * math.exp(-0.5 * planes[k] ** 2) if is_same else 0.0
        if good[s] and fit_bell(places[:, s], seen, width_px, bell):
            sigma[s], bias[s] = math.hypot(bell[1], psf_sigma_px), bell[0] - places[middle, s]
            is_fitted[s] = True
    for s in range(n_scan):
        before, on = s // EVERY * EVERY, faces[middle, s]
        behind = min(before + EVERY, n_scan - 1)
        has_before = is_fitted[before] and faces[middle, before] == on
        has_behind = is_fitted[behind] and faces[middle, behind] == on
        if s == before or not good[s] or not (has_before or has_behind):
            continue
        share = (s - before) / EVERY if has_before and has_behind else 0.0 if has_before else 1.0
        near, far = before if has_before else behind, behind if has_behind else before
        sigma[s] = (1.0 - share) * sigma[near] + share * sigma[far]
        bias[s] = (1.0 - share) * bias[near] + share * bias[far]


@kernel
def _take_from_same_face(sigma: Float64, bias: Float64, face: Int64, good: Bool) -> None:
    """Replace values (n,) beside a corner, where the flanks lie on two faces, by the nearest good ones.

    By those of its own face if that has some.
    """
    n = len(good)
    for s in range(n):
        if good[s]:
            continue
        nearest, nearest_on_face = -1, -1
        for away in range(1, n):
            for other in (s - away, s + away):
                if 0 <= other < n and good[other]:
                    nearest = other if nearest < 0 else nearest
                    if face[other] == face[s] and nearest_on_face < 0:
                        nearest_on_face = other
            if nearest_on_face >= 0:
                break
        take = nearest_on_face if nearest_on_face >= 0 else nearest
        if take >= 0:
            sigma[s], bias[s] = sigma[take], bias[take]
