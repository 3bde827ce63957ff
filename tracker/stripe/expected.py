"""Expected stripe of the nominal joint for a pose: its place, its width and its skewness."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Bool, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.instrument.camera import undistorted
from noise_model.instrument.laser import Sheet, plane_met, sheet_in
from noise_model.surface.faces import ridge, slope_across
from noise_model.surface.joint import EDGE_STANDS_MM
from tracker.geometry import SensorGeometry, StripeSource
from tracker.stripe.trace import cut_and_project, hide_behind, per_line, samples

FLANKS = np.array([-1.0, 0.0, 1.0])
"""Planes across the sheet, in its sigmas, that tell width and bias of a stripe on flat faces."""

PLANES = np.linspace(-3.0, 3.0, 13)
"""Places across the sheet at which its light is sampled, in its sigmas."""

MAX_STEPS, BELL_SETTLED = 30, 1e-4
"""Gauss-Newton steps at most; one shorter than this, in the stripe's sigmas, is the last."""

MAX_LN = 0.5
"""No width is further off that of the sheet alone."""

EVERY = 8
"""Every so many scan lines a bell is fitted to the light of all planes: both change slowly along a face."""

FAN_SLACK_MM = 2.0
"""Reach beyond the fan's end of the search for a stripe: a surface farther off is lit farther out."""


class ExpectedStripe(NamedTuple):
    """The stripe that the joint would show, per scan line (n_scan,), px.

    `position_px` its centre, `sigma_px` its 1 sigma (sheet and point-spread function), `bias_px` how far its
    light's centre lies off the laser plane's trace because reflectance and fall-off vary across it. `shown`
    says where the joint would show it at all, and not what an edge joint stands on, deep out of sight, nor
    what lies beyond the fan's end; `is_sought` where it is looked for. `face` is which of the section's faces
    it lies on, -1 between two. `widest_px` is the largest sigma.
    """

    position_px: Float64
    sigma_px: Float64
    bias_px: Float64
    shown: Bool
    is_sought: Bool
    face: Int64
    widest_px: float

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
    corrugation, which may mirror the laser for a part of the stripe, `fit_bell` fits centre and width.
    """
    in_view, expected = expect(geometry.stripe_source, scene, geometry.n_scan)
    return expected if in_view else None


@kernel(allocates=True)
def _lifted(vertices: Float64) -> tuple[Float64, Bool]:
    """Return a section whose deep faces are level, and which faces are deep.

    A face is deep throughout; a ridge's faces only end there. The seam may be off its place by more than its
    sheets are wide: they are looked for off it too.
    """
    last = vertices.shape[0] - 1
    lifted, is_deep = vertices.copy(), np.zeros(last, dtype=np.bool_)
    for k in range(last):
        if vertices[k, 1] <= -EDGE_STANDS_MM and vertices[k + 1, 1] <= -EDGE_STANDS_MM:
            is_deep[k] = True
            lifted[k, 1] = lifted[k + 1, 1] = 0.0
    return lifted, is_deep


@kernel(allocates=True)
def _endless(sheet: Sheet) -> Sheet:
    """Return a sheet without its fan's end: place and width go on there, and light that stops bends them."""
    origin, plane, up, sigma, stand, axis, side, _, exponent, bow = sheet
    return Sheet(
        origin=origin,
        plane=plane,
        tool_up=up,
        sigma=sigma,
        stand=stand,
        axis=axis,
        side=side,
        slope=math.inf,
        exponent=exponent,
        bow=bow,
    )


@kernel
def _beyond_fan_mm(source: StripeSource, scan: float, position_px: float) -> float:
    """Return the distance beyond the fan's end at which the sheet is seen at a place of a scan line, mm.

    It is negative within the fan, and NaN where the sheet is not met.
    """
    u, v = (scan, position_px) if source.along_rows else (position_px, scan)
    x, y, _, _, _, _ = undistorted(u, v, source.lens)
    T, sheet = source.T_tool_camera, source.sheet
    eye = T[0, 3], T[1, 3], T[2, 3]
    ray = (
        T[0, 0] * x + T[0, 1] * y + T[0, 2],
        T[1, 0] * x + T[1, 1] * y + T[1, 2],
        T[2, 0] * x + T[2, 1] * y + T[2, 2],
    )
    plane, origin = plane_met(sheet, eye, ray), sheet.origin
    on, across = plane[3], 0.0
    for i in range(3):
        on += plane[i] * eye[i]
        across += plane[i] * ray[i]
    way = -on / across
    if not way > 0.0:
        return math.nan
    aside, along = 0.0, 0.0
    for i in range(3):
        away = eye[i] + way * ray[i] - origin[i]
        aside += away * sheet.side[i]
        along += away * sheet.axis[i]
    return abs(aside) - sheet.slope * along


@kernel(allocates=True)
def expect(source: StripeSource, scene: Scene, n_scan: int) -> tuple[bool, ExpectedStripe]:
    """Return whether a scene's stripe is in view, and what is expected of it; see `expect_stripe`."""
    position, sigma, bias = np.empty(n_scan), np.empty(n_scan), np.empty(n_scan)
    shown, is_sought = np.empty(n_scan, np.bool_), np.empty(n_scan, np.bool_)
    section, is_deep = _lifted(scene.shape.vertices)
    face = np.empty(n_scan, dtype=np.int64)
    in_view = _expect(
        source=source,
        sheet=_endless(sheet_in(scene.T_joint_tool, source.sheet)),
        vertices=section,
        corrugation=scene.shape.corrugation,
        T_joint_tool=scene.T_joint_tool,
        T_joint_camera=scene.T_joint_camera,
        seen_mm=scene.footprint_mm[1],
        position=position,
        sigma=sigma,
        bias=bias,
        face_shown=face,
    )
    widest = 0.0
    for s in range(n_scan if in_view else 0):
        widest = max(widest, sigma[s])
        shown[s], is_sought[s] = face[s] < 0 or not is_deep[face[s]], True
        if math.isfinite(source.sheet.slope):
            beyond_mm = _beyond_fan_mm(source, float(s), position[s])
            shown[s] = shown[s] and not beyond_mm > 0.0
            is_sought[s] = not beyond_mm > FAN_SLACK_MM
    return in_view, ExpectedStripe(position, sigma, bias, shown, is_sought, face, widest)


@kernel(allocates=True)
def _expect(
    source: StripeSource,
    sheet: Sheet,
    vertices: Float64,
    corrugation: Float64,
    T_joint_tool: Float64,
    T_joint_camera: Float64,
    seen_mm: Float64,
    position: Float64,
    sigma: Float64,
    bias: Float64,
    face_shown: Int64,
) -> bool:
    """Write place, 1 sigma, bias and face (n_scan,) of the stripe, -1 between two; False out of view."""
    n_scan, planes = position.shape[0], PLANES if corrugation[0] > 0.0 else FLANKS
    tool_x, tool_y = T_joint_tool[0, 3], T_joint_tool[1, 3]
    y, face = samples(vertices, tool_y, seen_mm[0], seen_mm[1])
    n = len(y)
    points_px, light = np.empty((n, 2)), np.empty(n)
    z, is_seen = np.empty(n), np.empty(n, np.bool_)
    for i in range(n):
        is_seen[i] = True
        z[i] = vertices[face[i], 1] + slope_across(face[i], vertices) * (y[i] - vertices[face[i], 0])
    lift = ridge(tool_x, corrugation)[0]
    hide_behind(y, z, T_joint_camera[1, 3], T_joint_camera[2, 3] - lift, is_seen)
    hide_behind(y, z, sheet.origin[1], sheet.origin[2] - lift, is_seen)
    n_planes = planes.shape[0]
    places, strengths = np.empty((n_planes, n_scan)), np.empty((n_planes, n_scan))
    faces = np.empty((n_planes, n_scan), dtype=np.int64)
    middle, flank = n_planes // 2, round(1.0 / (planes[1] - planes[0]))
    before, behind = middle - flank, middle + flank
    for k in range(n_planes):
        shift = planes[k] * sheet.sigma
        # Of three the bias is made of the flanks' light.
        with_light = shift != 0.0 or n_planes > FLANKS.shape[0]
        cut_and_project(
            y=y,
            z=z,
            face=face,
            vertices=vertices,
            corrugation=corrugation,
            sheet=sheet,
            shift_mm=shift,
            start_x=tool_x,
            T_joint_camera=T_joint_camera,
            lens=source.lens,
            material=source.material,
            along_rows=source.along_rows,
            with_light=with_light,
            points_px=points_px,
            light=light,
        )
        every = 1 if k in (before, middle, behind) else EVERY
        is_met = per_line(
            points_px=points_px,
            light=light,
            face=face,
            is_seen=is_seen,
            every=every,
            position=places[k],
            strength=strengths[k],
            shown=faces[k],
        )
        if not is_met:
            return False
    good = np.empty(n_scan, dtype=np.bool_)
    for s in range(n_scan):
        half_width = 0.5 * (places[behind, s] - places[before, s])
        position[s] = places[middle, s]
        face_shown[s] = on = faces[middle, s]
        good[s] = on >= 0 and faces[before, s] == on and faces[behind, s] == on
        sigma[s] = math.hypot(half_width, source.psf_sigma_px)
        shading = 0.0
        if strengths[before, s] > 0.0 and strengths[behind, s] > 0.0:
            shading = 0.5 * half_width * math.log(strengths[behind, s] / strengths[before, s])
        bias[s] = shading + 1.5 * (0.5 * (places[behind, s] + places[before, s]) - places[middle, s])
    if n_planes > FLANKS.shape[0]:
        _bells(
            planes=planes,
            places=places,
            strengths=strengths,
            faces=faces,
            good=good,
            psf_sigma_px=source.psf_sigma_px,
            sigma=sigma,
            bias=bias,
        )
    _take_from_same_face(sigma, bias, face_shown, good)
    return True


@kernel
def fit_bell(place: Float64, light: Float64, width: float, out: Float64) -> bool:
    """Write centre and 1 sigma (2,), px, of the Gaussian that fits light (n,) seen at places (n,), px.

    Where a curved metal mirrors the laser for a part of the stripe only, its light across the stripe is no
    exponential, and may have two peaks. A scan line's fit will find the Gaussian

        A exp(-1/2 ((r - r_0) / w)^2),    sum of (light - Gaussian)^2 / V least,    V = Gaussian + peak,

    V the noise of a stripe that stands in as much arc light, over the length of line from plane to plane.
    `width` is the sheet's own 1 sigma, px. False if there is no light, or the Gaussian runs off the places; a
    plane with no light is not looked at.
    """
    n = place.shape[0]
    peak, total, centre = 0.0, 0.0, 0.0
    for k in range(n):
        peak = max(peak, light[k])
        total += light[k]
        centre += light[k] * place[k]
    if not peak > 0.0:
        return False
    r_0, ln_w, A = centre / total, 0.0, peak
    for _ in range(MAX_STEPS):
        w = width * math.exp(ln_w)
        aa, ar, aw, rr, rw, ww = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        g_a, g_r, g_w = 0.0, 0.0, 0.0
        for k in range(n):
            if not light[k] > 0.0:
                continue
            length = 0.5 * abs(place[min(k + 1, n - 1)] - place[max(k - 1, 0)])
            t = (place[k] - r_0) / w
            bell = math.exp(-0.5 * t * t)
            weight = length / (A * bell + peak)
            residual = light[k] - A * bell
            by_r, by_w = A * bell * t, A * bell * t * t
            aa += weight * bell * bell
            ar += weight * bell * by_r
            aw += weight * bell * by_w
            rr += weight * by_r * by_r
            rw += weight * by_r * by_w
            ww += weight * by_w * by_w
            g_a += weight * bell * residual
            g_r += weight * by_r * residual
            g_w += weight * by_w * residual
        # The amplitude is eliminated.
        rr, rw, ww = rr - ar * ar / aa, rw - ar * aw / aa, ww - aw * aw / aa
        g_r, g_w = g_r - ar / aa * g_a, g_w - aw / aa * g_a
        determinant = rr * ww - rw * rw
        if not determinant > 0.0:
            return False
        step_r = (ww * g_r - rw * g_w) / determinant
        step_w = (rr * g_w - rw * g_r) / determinant
        step_r, step_w = min(max(step_r, -0.5), 0.5), min(max(step_w, -0.2), 0.2)
        A = max(A + (g_a - ar * step_r - aw * step_w) / aa, 0.1 * peak)
        r_0 += step_r * w
        ln_w = min(max(ln_w + step_w, -MAX_LN), MAX_LN)
        if abs(step_r) < BELL_SETTLED and abs(step_w) < BELL_SETTLED:
            break
    out[0], out[1] = r_0, width * math.exp(ln_w)
    return bool(min(place[0], place[n - 1]) <= r_0 <= max(place[0], place[n - 1]))


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
    """Replace values (n,) next to a corner, where the flanks lie on two faces, by the nearest good ones.

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
