"""The forward model of a frame: mean and variance of stripe and arc light through lens and sensor."""

from __future__ import annotations

import numpy as np

from noise_model.arc_map import Float32, Scene, arc_at, arc_kernel, scene
from noise_model.brdf import reflectance
from noise_model.frames import Float64, invert, transform
from noise_model.laser import irradiance
from noise_model.optics import Rays, blur
from noise_model.sensor import variance_e2
from noise_model.setup import Setup
from noise_model.surface import NOMINAL_SEAM, SeamLine
from noise_model.visibility import trace, ways_are_open

SHEET_REACH = 6.0
"""How many sigmas of the sheet are rendered: its irradiance has fallen to 1.5e-8 there."""


def render(
    setup: Setup,
    T_base_tool: Float64,
    *,
    laser_level: float,
    arc_level: float,
    exposure_s: float,
    seam: SeamLine = NOMINAL_SEAM,
    rays: Rays | None = None,
) -> Float32:
    """Return the expected charge (H, W), e-, of a frame taken at a pose, the black level not counted.

    `laser_level` and `arc_level` are outputs over the nominal ones, 0 for off; `seam` puts the true seam off
    its nominal line. Pixels that look past the workpiece are dark. `rays` spares
    tracing the camera's rays anew for each frame.
    """
    rays = Rays.of(setup.camera) if rays is None else rays
    view = scene(setup, T_base_tool, seam)
    shape = rays.cos4.shape
    mean_e = np.zeros(shape, dtype=np.float32)
    if arc_level > 0.0:
        kernel = arc_kernel(setup, view, arc_level)
        pixels = np.arange(rays.cos4.size)
        arc_e, _ = arc_at(kernel, rays.xy.reshape(-1, 2), rays.cos4.reshape(-1), pixels)
        mean_e += np.nan_to_num(arc_e).reshape(shape)
    if laser_level > 0.0:
        mean_e += laser_level * stripe(setup, view, rays)
    mean_e *= exposure_s / setup.camera.exposure_s
    return blur(mean_e, setup.camera.psf_sigma_px)


def stripe(setup: Setup, view: Scene, rays: Rays) -> Float32:
    """Return the laser stripe (H, W), e- for `camera.exposure_s`, before the point-spread function.

    The sheet's irradiance times f_r towards the camera, scaled so that a flat plate at tool height under a
    level pose peaks at `peak_e` in the middle column.
    """
    laser, material = setup.laser, setup.material
    n = rays.cos4.size
    points, normals, faces = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, dtype=np.int32)
    xy = rays.xy.reshape(-1, 2)
    trace(
        xy,
        np.arange(n),
        view.T_joint_camera,
        view.shape.vertices,
        view.shape.corrugation,
        points,
        normals,
        faces,
    )
    T_tool_joint = invert(view.T_joint_tool)
    points_tool = transform(T_tool_joint, points)
    plane = np.asarray(laser.plane_in_tool)
    with np.errstate(invalid="ignore"):
        depth = laser.origin_in_tool_mm[2] - points_tool[:, 2]
        reach = SHEET_REACH * laser.stripe_sigma_mm * np.abs(depth) / laser.origin_in_tool_mm[2]
        near = np.flatnonzero(np.abs(points_tool @ plane[:3] + plane[3]) < reach)
    light = irradiance(points_tool[near], normals[near] @ T_tool_joint[:3, :3].T, laser)
    origin_joint = transform(view.T_joint_tool, np.asarray(laser.origin_in_tool_mm))
    omega_i = origin_joint - points[near]
    omega_i /= np.linalg.norm(omega_i, axis=1, keepdims=True)
    omega_r = view.T_joint_camera[:3, 3] - points[near]
    omega_r /= np.linalg.norm(omega_r, axis=1, keepdims=True)
    f_r = reflectance(
        omega_i,
        omega_r,
        normals[near],
        material.kappa_diff,
        material.kappa_spec,
        material.c2,
        material.lobe,
    )
    is_free = np.empty(len(near), dtype=np.bool_)
    ways_are_open(points[near], origin_joint, view.shape.vertices, view.shape.corrugation, is_free)
    image = np.zeros(n, dtype=np.float32)
    image[near] = (
        light * f_r * rays.cos4.reshape(-1)[near] * is_free * (laser.peak_e / stripe_reference(setup))
    )
    return image.reshape(rays.cos4.shape)


def stripe_reference(setup: Setup) -> float:
    """Return irradiance f_r cos^4 at the stripe's peak on a flat plate at tool height, middle column.

    The middle row it is where the stripe runs along columns. Raises ValueError if the stripe is not there.
    """
    camera, laser, material = setup.camera, setup.laser, setup.material
    if stripe_runs_along_rows(setup):
        u, v = np.full(camera.height, (camera.width - 1) / 2.0), np.arange(camera.height, dtype=np.float64)
    else:
        u, v = np.arange(camera.width, dtype=np.float64), np.full(camera.width, (camera.height - 1) / 2.0)
    xy = camera.normalised(np.column_stack([u, v]))
    rays_tool = np.column_stack([xy, np.ones(len(xy))]) @ camera.T_tool_camera[:3, :3].T
    origin = camera.T_tool_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        points = origin - origin[2] / rays_tool[:, 2:] * rays_tool
    points = points[rays_tool[:, 2] < 0.0]
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), points.shape)
    omega_i = np.asarray(laser.origin_in_tool_mm) - points
    omega_r = origin - points
    omega_i = omega_i / np.linalg.norm(omega_i, axis=1, keepdims=True)
    omega_r = omega_r / np.linalg.norm(omega_r, axis=1, keepdims=True)
    # Under a level pose the tool's axes are the joint's.
    f_r = reflectance(
        omega_i, omega_r, up, material.kappa_diff, material.kappa_spec, material.c2, material.lobe
    )
    cos4 = (1.0 + np.sum(xy[rays_tool[:, 2] < 0.0] ** 2, axis=1)) ** -2.0
    peak = float(np.max(irradiance(points, up, laser) * f_r * cos4, initial=0.0))
    if not peak > 0.0:
        raise ValueError(
            "[laser] plane_in_tool: the stripe does not cross the camera's middle column at tool height"
        )
    return peak


def stripe_runs_along_rows(setup: Setup) -> bool:
    """Say whether the laser plane's trace on a plate at tool height runs along the image's rows.

    Raises ValueError for a sheet parallel to the plate, or a stripe behind the camera.
    """
    normal = np.asarray(setup.laser.plane_in_tool[:3])
    origin = np.asarray(setup.laser.origin_in_tool_mm) * np.array([1.0, 1.0, 0.0])
    along = np.cross(normal, [0.0, 0.0, 1.0])
    if np.linalg.norm(along) < 1e-6:
        raise ValueError("[laser] plane_in_tool: the sheet lies parallel to the plate")
    ends_tool = np.stack([origin - along, origin + along])
    ends_camera = transform(invert(setup.camera.T_tool_camera), ends_tool)
    if (ends_camera[:, 2] <= 0.0).any():
        raise ValueError("[camera.pose_in_tool]: the stripe at tool height lies behind the camera")
    du, dv = np.abs(np.diff(setup.camera.project(ends_camera), axis=0))[0]
    return bool(du >= dv)


def noise_variance(mean_e: Float32, setup: Setup) -> Float64:
    """Return the variance (H, W), e-^2, of a linearised frame of this mean: shot, read, quantisation."""
    return variance_e2(mean_e, setup.sensor)
