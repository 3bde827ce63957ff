"""Pictures of a laser stripe on a step or a V, ray by ray; nothing here is the estimator's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from noise_model.arrays import Float64, UInt8

HALF_WIDTH_MM = 60.0
"""The gauge's half width and length."""


@dataclass(frozen=True)
class Face:
    """A flat face: a point of it, its normal, and where across the gauge it lies, from y to y, mm."""

    point: tuple[float, float, float]
    normal: tuple[float, float, float]
    low: float
    high: float


@dataclass(frozen=True)
class World:
    """A camera and a sheet on a tool, and a gauge in base; lengths in mm."""

    width: int
    height: int
    focal_px: float
    centre_px: tuple[float, float]
    T_tool_camera: Float64
    sheet: Float64
    sheet_sigma: float
    faces: tuple[Face, ...]
    T_base_gauge: Float64


def step_faces(height: float) -> tuple[Face, ...]:
    """Return a step: high at y < 0."""
    up = (0.0, 0.0, 1.0)
    return (
        Face((0.0, 0.0, 0.0), up, -HALF_WIDTH_MM, 0.0),
        Face((0.0, 0.0, -height), up, 0.0, HALF_WIDTH_MM),
    )


def v_faces(angle_deg: float, depth: float) -> tuple[Face, ...]:
    """Return a V with its root below y = 0."""
    half = math.radians(0.5 * angle_deg)
    s, c = math.sin(half), math.cos(half)
    mouth, up = depth * s / c, (0.0, 0.0, 1.0)
    return (
        Face((0.0, 0.0, 0.0), up, -HALF_WIDTH_MM, -mouth),
        Face((0.0, 0.0, -depth), (0.0, c, s), -mouth, 0.0),
        Face((0.0, 0.0, -depth), (0.0, -c, s), 0.0, mouth),
        Face((0.0, 0.0, 0.0), up, mouth, HALF_WIDTH_MM),
    )


def picture(
    world: World, T_base_tool: Float64, rng: np.random.Generator, peak_dn: float = 160.0, speckle: float = 0.3
) -> UInt8:
    """Return what the camera sees at a pose: the stripe, speckle, noise of 1 DN, a pedestal of 5 DN."""
    T = np.linalg.inv(world.T_base_gauge) @ T_base_tool @ world.T_tool_camera
    u, v = np.meshgrid(np.arange(world.width), np.arange(world.height))
    rays = np.stack(
        [
            (u - world.centre_px[0]) / world.focal_px,
            (v - world.centre_px[1]) / world.focal_px,
            np.ones(u.shape),
        ],
        axis=-1,
    )
    directions, eye = rays @ T[:3, :3].T, T[:3, 3]
    nearest = np.full(u.shape, np.inf)
    off = np.full(u.shape, np.inf)
    normal = world.sheet[:3] @ world.T_tool_camera[:3, :3]
    distance = world.sheet[:3] @ world.T_tool_camera[:3, 3] + world.sheet[3]
    for face in world.faces:
        m = np.array(face.normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (m @ (np.array(face.point) - eye)) / (directions @ m)
            across = eye[1] + reach * directions[..., 1]
        hit = (reach > 0.0) & (across >= face.low) & (across < face.high) & (directions @ m < 0.0)
        hit &= reach < nearest
        nearest[hit] = reach[hit]
        off[hit] = reach[hit] * (rays[hit] @ normal) + distance
    light = peak_dn * np.exp(-0.5 * (off / world.sheet_sigma) ** 2)
    light = light * np.exp(speckle * rng.standard_normal(light.shape) - 0.5 * speckle**2)
    noisy = 5.0 + light + rng.normal(0.0, 1.0, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def turned(about_x_deg: float, about_y_deg: float, about_z_deg: float, at_mm: Float64) -> Float64:
    """Return a pose with these turns, about z first."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(
        "xyz", [about_x_deg, about_y_deg, about_z_deg][::1], degrees=True
    ).as_matrix()
    T[:3, 3] = at_mm
    return T
