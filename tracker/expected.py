"""Where the nominal joint puts the stripe for a pose, and how wide and how lopsided it looks there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from noise_model.arc_map import Scene
from noise_model.brdf import reflectance
from noise_model.frames import Float64, invert, transform
from noise_model.laser import irradiance
from noise_model.surface import corrugation_height
from tracker.geometry import SensorGeometry

HALF_SPAN_MM = 60.0
"""How far to either side of the seam the stripe is followed."""

SAMPLES = 481


@dataclass(frozen=True)
class ExpectedStripe:
    """The stripe that the joint would show, per scan line (n_scan,), px.

    `position_px` its centre, `sigma_px` its 1 sigma (sheet and point-spread function), `lean_px` how far its
    light's centre lies off the laser plane's trace because reflectance and fall-off vary across it.
    """

    position_px: Float64
    sigma_px: Float64
    lean_px: Float64


def expect_stripe(geometry: SensorGeometry, view: Scene) -> ExpectedStripe | None:
    """Return the expected stripe of a scene, or None where it is out of view.

    The laser plane is cut with the section, the cut projected into the image and read off per scan line;
    beyond what is seen the ends are held. A stripe of Gaussian profile whose strength varies as exp(k v) is
    that Gaussian moved by k sigma^2: this is the lean, with k from the model of the light.
    """
    setup = geometry.setup
    T_tool_joint = invert(view.T_joint_tool)
    cut_joint, normals_joint = _cut(setup.laser.plane_in_tool, view)
    points_tool = transform(T_tool_joint, cut_joint)
    points_camera = transform(invert(setup.camera.T_tool_camera), points_tool)
    if (points_camera[:, 2] <= 1.0).any() or not np.isfinite(points_camera).all():
        return None
    normals_tool = normals_joint @ T_tool_joint[:3, :3].T
    plane_normal = np.asarray(setup.laser.plane_in_tool[:3])

    # One sigma of the sheet to either side, along the surface and square to the sheet's trace.
    across = plane_normal - (normals_tool @ plane_normal)[:, None] * normals_tool
    across /= np.maximum(np.sum(across * plane_normal, axis=1), 0.05)[:, None]
    depth = setup.laser.origin_in_tool_mm[2] - points_tool[:, 2]
    reach = setup.laser.stripe_sigma_mm * np.maximum(depth, 1.0) / setup.laser.origin_in_tool_mm[2]
    step = across * reach[:, None]
    scan_position = _project(geometry, points_tool)
    ahead, behind = _project(geometry, points_tool + step), _project(geometry, points_tool - step)
    half_width = 0.5 * (ahead[:, 1] - behind[:, 1])
    sigma = np.hypot(half_width, setup.camera.psf_sigma_px)
    bright = _strength(geometry, points_tool + step, normals_tool, reach)
    dim = _strength(geometry, points_tool - step, normals_tool, -reach)
    with np.errstate(divide="ignore", invalid="ignore"):
        k = np.log(bright / dim) / (2.0 * half_width)
    lean = np.where(np.isfinite(k), k * half_width**2, 0.0)

    order = np.argsort(scan_position[:, 0], kind="stable")
    scan = np.arange(geometry.n_scan, dtype=np.float64)
    sorted_scan = scan_position[order, 0]
    if sorted_scan[-1] < 0.0 or sorted_scan[0] > geometry.n_scan - 1:
        return None
    position, width, lopsided = (
        np.interp(scan, sorted_scan, values[order]) for values in (scan_position[:, 1], sigma, lean)
    )
    return ExpectedStripe(position, width, lopsided)


def _cut(plane_in_tool: tuple[float, float, float, float], view: Scene) -> tuple[Float64, Float64]:
    """Cut the laser plane with the section: points (n, 3), mm, and unit normals (n, 3), joint frame."""
    plane_tool = np.asarray(plane_in_tool)
    R, t = view.T_joint_tool[:3, :3], view.T_joint_tool[:3, 3]
    n = R @ plane_tool[:3]
    d = plane_tool[3] - n @ t
    vertices = view.shape.vertices
    seam_y = float(t[1])
    y = np.linspace(seam_y - HALF_SPAN_MM, seam_y + HALF_SPAN_MM, SAMPLES)
    for corner in np.unique(vertices[1:-1, 0]):
        y = np.append(y, [corner - 1e-6, corner + 1e-6])
    y = np.sort(y)
    plain = np.interp(y, vertices[:, 0], vertices[:, 1])
    x = np.full_like(y, float(t[0]))
    for _ in range(20):
        x = -(n[1] * y + n[2] * (plain + corrugation_height(x, view.shape.corrugation)) + d) / n[0]
    z = plain + corrugation_height(x, view.shape.corrugation)
    h = 1e-3
    rise_x = (
        corrugation_height(x + h, view.shape.corrugation) - corrugation_height(x - h, view.shape.corrugation)
    ) / (2.0 * h)
    strip = np.clip(np.searchsorted(vertices[:, 0], y, side="right") - 1, 0, len(vertices) - 2)
    width, rise = np.diff(vertices, axis=0)[strip].T
    slope_y = np.where(width > 0.0, rise / np.where(width > 0.0, width, 1.0), 0.0)
    normals = np.column_stack([-rise_x, -slope_y, np.ones_like(y)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([x, y, z]), normals


def _project(geometry: SensorGeometry, points_tool: Float64) -> Float64:
    """Return (n, 2) as (scan, position) of tool-frame points."""
    camera = geometry.setup.camera
    return geometry.scan_points(camera.project(transform(invert(camera.T_tool_camera), points_tool)))


def _strength(geometry: SensorGeometry, points_tool: Float64, normals_tool: Float64, off_mm: Float64) -> Float64:
    """Return the stripe's light at points (n, 3), the sheet's own Gaussian divided out."""
    setup = geometry.setup
    origin = np.asarray(setup.laser.origin_in_tool_mm)
    sheet = np.exp(-0.5 * (off_mm / (setup.laser.stripe_sigma_mm * (origin[2] - points_tool[:, 2]) / origin[2])) ** 2)
    omega_i, omega_r = origin - points_tool, setup.camera.T_tool_camera[:3, 3] - points_tool
    omega_i = omega_i / np.linalg.norm(omega_i, axis=1, keepdims=True)
    omega_r = omega_r / np.linalg.norm(omega_r, axis=1, keepdims=True)
    material = setup.material
    f_r = reflectance(omega_i, omega_r, normals_tool, material.kappa_diff, material.kappa_spec, material.c2)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(irradiance(points_tool, normals_tool, setup.laser) * f_r / sheet)
