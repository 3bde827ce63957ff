"""The plain twin of the laser sheet's light: NumPy over all points at once."""

from __future__ import annotations

import math

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.instrument.laser import Laser
from noise_model.setup import Setup
from noise_model.surface.brdf import reflectance
from noise_model.transforms import invert, transform


def reflected_sheet_plain(setup: Setup, points: Float64, normals: Float64, T_joint_tool: Float64) -> Float64:
    """Return what `noise_model.stripe.reflected_sheet` does."""
    material = setup.material
    T_tool_joint = invert(T_joint_tool)
    light = irradiance(transform(T_tool_joint, points), normals @ T_tool_joint[:3, :3].T, setup.laser)
    omega_i = transform(T_joint_tool, setup.laser.origin_mm) - points
    omega_i /= np.linalg.norm(omega_i, axis=1, keepdims=True)
    omega_r = (T_joint_tool @ setup.camera.T_tool_camera)[:3, 3] - points
    omega_r /= np.linalg.norm(omega_r, axis=1, keepdims=True)
    f_r = reflectance(
        omega_i, omega_r, normals, material.kappa_diff, material.kappa_spec, material.c2, material.lobe
    )
    return light * f_r


def irradiance(points_tool: Float64, normals_tool: Float64, laser: Laser) -> Float64:
    """Return the sheet's irradiance at points (N, 3) mm with unit normals (N, 3), relative to its peak.

    exp(-1/2 |x' / (sigma z/h)|^p) (h/z)^2 cos(theta_i) / cos(psi): x' the distance from the sheet, p the
    profile's exponent, z the depth below the origin, h the origin's height, psi the angle of the point's ray
    to the axis, theta_i its incidence. 1 on the axis at tool height for a level plate, 0 beyond the fan's
    end. Hidden points are the caller's to exclude.
    """
    origin, plane = laser.origin_mm, laser.plane
    h = origin[2]
    towards = origin - points_tool
    z = towards[..., 2]
    distance = np.linalg.norm(towards, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cos_psi = z / distance
        cos_theta_i = np.sum(towards * normals_tool, axis=-1) / distance
        side = np.cross(plane[:3], [0.0, 0.0, 1.0])
        across = towards @ (side / np.linalg.norm(side))
        x_prime = points_tool @ plane[:3] + plane[3] - laser.bow * across**2 / z
        sheet = np.exp(-0.5 * np.abs(x_prime / (laser.stripe_sigma_mm * z / h)) ** laser.profile_exponent)
        value = sheet * (h / z) ** 2 * cos_theta_i / cos_psi
    return np.where((z > 0) & (cos_theta_i > 0) & ~(beyond_fan_mm(points_tool, laser) > 0), value, 0.0)


def beyond_fan_mm(points_tool: Float64, laser: Laser) -> Float64:
    """Return how far across its axis points (N, 3), mm, tool frame, lie beyond the fan's end, (N,) mm.

    It is negative within the fan, and minus infinity if the fan has no end.
    """
    axis, side, slope = laser.fan
    from_origin = points_tool - laser.origin_mm
    if math.isinf(slope):
        return np.full(from_origin.shape[:-1], -math.inf)
    return np.asarray(np.abs(from_origin @ side) - slope * (from_origin @ axis))
