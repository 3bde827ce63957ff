"""The plain twin of the expected stripe: NumPy, scipy and OpenCV over all samples at once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from sheet_twin import reflected_sheet_plain

from noise_model.arc.scene import Scene
from noise_model.compiled.arrays import Bool, Float64
from noise_model.setup import Setup
from noise_model.surface.joint import corrugation_height
from noise_model.transforms import invert, transform
from tracker.geometry import SensorGeometry
from tracker.stripe.expected import FLANKS, PLANES, ExpectedStripe
from tracker.stripe.trace import SAME_ELEVATION, STEP_MM

HALF_SPAN_MM = 60.0
"""How far to either side of the tool the stripe is followed: farther than the cameras here see."""


def expect_stripe(geometry: SensorGeometry, scene: Scene) -> ExpectedStripe | None:
    """Return the expected stripe of a scene, or None where it is out of view."""
    setup = geometry.setup
    T_tool_joint = invert(scene.T_joint_tool)
    scan = np.arange(geometry.n_scan, dtype=np.float64)
    position, strength, strips = [], [], []
    planes = PLANES if scene.shape.corrugation[0] > 0.0 else FLANKS
    for side in planes:
        points_joint, normals_joint, strip = _cut(
            setup.laser.plane_in_tool, side * setup.laser.stripe_sigma_mm, scene
        )
        points_tool = transform(T_tool_joint, points_joint)
        points_camera = transform(invert(setup.camera.T_tool_camera), points_tool)
        is_before = points_camera[:, 2] > 1.0
        at = geometry.scan_points(setup.camera.project(points_camera))
        order = np.argsort(at[:, 0], kind="stable")
        order = order[(is_before & _is_in_sight(setup, points_joint[:, 1], scene))[order]]
        if len(order) == 0 or at[order[-1], 0] < 0.0 or at[order[0], 0] > geometry.n_scan - 1:
            return None
        position.append(np.interp(scan, at[order, 0], at[order, 1]))
        light = _strength(setup, points_joint, points_tool, normals_joint, scene.T_joint_tool)
        strength.append(np.interp(scan, at[order, 0], light[order]))
        after = np.clip(np.searchsorted(at[order, 0], scan), 1, len(order) - 1)
        left, right = strip[order][after - 1], strip[order][after]
        strips.append(np.where(left == right, left, -1))
    every, every_strip = np.array(position), np.array(strips)
    seen = (
        np.array(strength)
        * np.exp(-0.5 * planes[:, None] ** 2)
        * (every_strip == every_strip[len(planes) // 2])
    )
    of_flanks = [int(np.flatnonzero(planes == side)[0]) for side in FLANKS]
    position, strength, strips = ([of[k] for k in of_flanks] for of in (position, strength, strips))
    behind, middle, ahead = position
    half_width = 0.5 * (ahead - behind)
    with np.errstate(divide="ignore", invalid="ignore"):
        shading = 0.5 * half_width * np.log(strength[2] / strength[0])
    shading = np.where(np.isfinite(shading), shading, 0.0)
    curve = 1.5 * (0.5 * (ahead + behind) - middle)
    on_one_face = (strips[0] == strips[1]) & (strips[2] == strips[1]) & (strips[1] >= 0)
    width, bias = np.abs(half_width), shading + curve
    if len(planes) > len(FLANKS):
        for s in np.flatnonzero(on_one_face & (seen.max(axis=0) > 0.0)):
            center, width[s] = _bell(every[:, s], seen[:, s], width[s])
            bias[s] = center - middle[s]
    sigma = _from_same_face(np.hypot(width, setup.camera.psf_sigma_px), strips[1], on_one_face)
    return ExpectedStripe(
        middle,
        sigma,
        _from_same_face(bias, strips[1], on_one_face),
        np.ones(len(middle), dtype=np.bool_),
        np.ones(len(middle), dtype=np.bool_),
        strips[1],
        float(sigma.max()),
    )


def _bell(place: Float64, light: Float64, width: float) -> Float64:
    """Return centre and 1 sigma (2,) of the Gaussian that fits some light, weighted as the last fit says."""
    lit = light > 0.0
    length = np.abs(np.gradient(place) * np.where(np.arange(len(place)) % (len(place) - 1) == 0, 0.5, 1.0))
    peak = light.max()

    def bell(x: Float64) -> Float64:
        return np.asarray(x[0] * np.exp(-0.5 * ((place - x[1]) / np.exp(x[2])) ** 2))

    x = np.array([peak, np.average(place, weights=light), np.log(width)])
    for _ in range(8):
        before, weight = x, np.sqrt(lit * length / (bell(x) + peak))
        x = least_squares(
            lambda x, weight=weight: weight * (light - bell(x)) / np.sqrt(peak),
            x,
            bounds=([0.0, -np.inf, np.log(width) - 0.5], [np.inf, np.inf, np.log(width) + 0.5]),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        ).x
        if np.abs(x - before).max() < 1e-7:
            break
    return np.array([x[1], np.exp(x[2])])


def _from_same_face(values: Float64, strip: npt.NDArray[np.intp], good: Bool) -> Float64:
    """Replace values beside a corner, where the sheet's flanks lie on two faces, by the nearest good one."""
    if not good.any():
        return values
    filled = values.copy()
    where = np.flatnonzero(good)
    for s in np.flatnonzero(~good):
        on_face = where[strip[where] == strip[s]]
        candidates = on_face if len(on_face) else where
        filled[s] = values[candidates[np.argmin(np.abs(candidates - s))]]
    return filled


def _cut(
    plane_in_tool: tuple[float, float, float, float], shift_mm: float, scene: Scene
) -> tuple[Float64, Float64, npt.NDArray[np.intp]]:
    """Cut a plane parallel to the sheet with the section, in the joint frame.

    Returns points (n, 3), mm, unit normals (n, 3) and the number of the strip (n,) that each lies on.
    """
    plane_tool = np.asarray(plane_in_tool)
    R, t = scene.T_joint_tool[:3, :3], scene.T_joint_tool[:3, 3]
    n = R @ plane_tool[:3]
    d = plane_tool[3] - n @ t - shift_mm
    vertices, corrugation = scene.shape.vertices, scene.shape.corrugation
    corners = np.unique(vertices[1:-1, 0])
    reach = t[1] + np.arange(-HALF_SPAN_MM, HALF_SPAN_MM + STEP_MM, STEP_MM)
    y = np.sort(np.concatenate([reach, corners - 1e-6, corners + 1e-6]))
    plain = np.interp(y, vertices[:, 0], vertices[:, 1])
    x = np.full_like(y, t[0])
    for _ in range(20):
        x = -(n[1] * y + n[2] * (plain + corrugation_height(x, corrugation)) + d) / n[0]
    z = plain + corrugation_height(x, corrugation)
    h = 1e-3
    rise_x = (corrugation_height(x + h, corrugation) - corrugation_height(x - h, corrugation)) / (2.0 * h)
    strip = np.clip(np.searchsorted(vertices[:, 0], y, side="right") - 1, 0, len(vertices) - 2)
    width, rise = np.diff(vertices, axis=0)[strip].T
    slope_y = np.where(width > 0.0, rise / np.where(width > 0.0, width, 1.0), 0.0)
    normals = np.column_stack([-rise_x, -slope_y, np.ones_like(y)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([x, y, z]), normals, strip


def _is_in_sight(setup: Setup, y: Float64, scene: Scene) -> npt.NDArray[np.bool_]:
    """Say of the section's places y (n,) which neither camera nor laser sees behind others."""
    z = np.interp(y, *scene.shape.vertices.T)
    lift = float(corrugation_height(scene.T_joint_tool[0, 3], scene.shape.corrugation))
    is_seen = np.ones(len(y), dtype=bool)
    laser = transform(scene.T_joint_tool, np.array([setup.laser.origin_in_tool_mm]))[0]
    for source in (scene.T_joint_camera[:3, 3], laser):
        away = y - source[1]
        elevation = (z - (source[2] - lift)) / np.maximum(np.abs(away), 1e-6)
        for i in range(len(y)):
            before = ((away >= 0.0) == (away[i] >= 0.0)) & (np.abs(away) <= np.abs(away[i]))
            is_seen[i] &= elevation[i] >= elevation[before].max() - SAME_ELEVATION
    return is_seen


def _strength(
    setup: Setup, points_joint: Float64, points_tool: Float64, normals_joint: Float64, T_joint_tool: Float64
) -> Float64:
    """Return the stripe's light at points (n, 3), the sheet's own Gaussian divided out."""
    origin, plane = np.asarray(setup.laser.origin_in_tool_mm), np.asarray(setup.laser.plane_in_tool)
    local_sigma = setup.laser.stripe_sigma_mm * (origin[2] - points_tool[:, 2]) / origin[2]
    sheet = np.exp(-0.5 * ((points_tool @ plane[:3] + plane[3]) / local_sigma) ** 2)
    light = reflected_sheet_plain(setup, points_joint, normals_joint, T_joint_tool)
    return np.asarray(np.divide(light, sheet, out=np.zeros_like(sheet), where=sheet > 0.0))
