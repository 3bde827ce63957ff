"""The laser stripe: how much of the sheet's light the surface sends to the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from noise_model.arc_map import Float32
from noise_model.brdf import LobeNumbers, lobe_numbers, reflectance
from noise_model.frames import Float64, cross, invert, transform
from noise_model.kernel import kernel
from noise_model.laser import SHEET_REACH, Sheet, irradiance, sheet_of, sheet_reflected
from noise_model.optics import fall_off
from noise_model.ray_hits import ways_are_open
from noise_model.setup import Setup
from noise_model.view import View

PEAK_STEPS = 16
"""Steps to a pixel in which the peak of a stripe is looked for."""


def reflected_sheet(setup: Setup, points: Float64, normals: Float64, T_joint_tool: Float64) -> Float64:
    """Return the sheet's irradiance times f_r towards the camera (n,), relative to the sheet's peak.

    `points` (n, 3), mm, and unit `normals` (n, 3) are in the joint frame. Hidden points are the caller's to
    exclude.
    """
    light = np.empty(len(points))
    camera = np.ascontiguousarray((T_joint_tool @ setup.camera.T_tool_camera)[:3, 3])
    sheet, material = sheet_of(setup.laser, T_joint_tool), lobe_numbers(setup.material)
    _reflect(np.ascontiguousarray(points), np.ascontiguousarray(normals), camera, sheet, material, light)
    return light


@kernel
def _reflect(
    points: Float64, normals: Float64, camera: Float64, sheet: Sheet, material: LobeNumbers, light: Float64
) -> None:
    for i in range(points.shape[0]):
        P = points[i]
        x, y, z = camera[0] - P[0], camera[1] - P[1], camera[2] - P[2]
        distance = math.sqrt(x * x + y * y + z * z)
        omega_r = (x / distance, y / distance, z / distance)
        light[i] = sheet_reflected(sheet, material, P, normals[i], omega_r)


def reflected_sheet_plain(setup: Setup, points: Float64, normals: Float64, T_joint_tool: Float64) -> Float64:
    """Return what `reflected_sheet` does: its plain twin."""
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


class SheetSeen(NamedTuple):
    """Which of a view's pixels (...,) lie within the sheet's reach, and which of these it does not reach."""

    near: npt.NDArray[np.bool_]
    shaded: npt.NDArray[np.bool_]


def sheet_seen(view: View) -> SheetSeen:
    """Return where a view's pixels meet the laser sheet, at their centres."""
    return view.keep("sheet", lambda: _sheet_seen(view))


def _sheet_seen(view: View) -> SheetSeen:
    where, laser = view.scene, view.setup.laser
    points = view.surface[0]
    points_tool = transform(invert(where.T_joint_tool), points)
    plane = laser.plane
    with np.errstate(invalid="ignore"):
        depth = laser.origin_in_tool_mm[2] - points_tool[..., 2]
        reach = SHEET_REACH * laser.stripe_sigma_mm * np.abs(depth) / laser.origin_in_tool_mm[2]
        near = np.abs(points_tool @ plane[:3] + plane[3]) < reach
    origin_joint = transform(where.T_joint_tool, laser.origin_mm)
    is_free = np.empty(np.count_nonzero(near), dtype=np.bool_)
    ways_are_open(points[near], origin_joint, where.shape.vertices, where.shape.corrugation, is_free)
    shaded = np.zeros(view.shape, dtype=np.bool_)
    shaded[near] = ~is_free
    return SheetSeen(near, shaded)


def stripe_light(view: View) -> Float32:
    """Return the laser stripe (...,), e- for `camera.exposure_s`, before the point-spread function.

    The sheet's irradiance times f_r towards the camera, scaled so that a flat plate at tool height under a
    level pose peaks at `peak_e` in the middle column; of each pixel that at its centre.
    """
    setup, sheet = view.setup, sheet_seen(view)
    lit = sheet.near & ~sheet.shaded
    points, normals, _ = view.surface
    light = reflected_sheet(setup, points[lit], normals[lit], view.scene.T_joint_tool)
    image = np.zeros(view.shape, dtype=np.float32)
    image[lit] = light * view.cos4[lit] * (setup.laser.peak_e / stripe_reference(setup))
    return image


def crossed_by_borders(faces: npt.NDArray[np.integer], sheet: SheetSeen) -> npt.NDArray[np.bool_]:
    """Say along which axes (H, W, 2), u and v, a border of the stripe may cross the pixels of a frame.

    Along an axis a neighbour shows another face or lies in the sheet's shadow, and the sheet is near one of
    the two.
    """
    side = 2 * faces + sheet.shaded
    across = np.zeros((*side.shape, 2), dtype=np.bool_)
    for axis, here, there in ((0, np.s_[:, 1:], np.s_[:, :-1]), (1, np.s_[1:], np.s_[:-1])):
        border = (side[here] != side[there]) & (sheet.near[here] | sheet.near[there])
        across[..., axis][here] |= border
        across[..., axis][there] |= border
    return across


def stripe_reference(setup: Setup) -> float:
    """Return irradiance f_r cos^4 at the stripe's peak on a flat plate at tool height, middle column.

    The middle row it is where the stripe runs along columns. Raises ValueError if the stripe is not there.
    """
    pose = setup.camera.T_tool_camera.tobytes()
    return _reference(_Peaking((setup.camera.geometry, pose, setup.laser, setup.material), setup))


@dataclass(frozen=True)
class _Peaking:
    """A setup, and all of it that its stripe's peak depends on, to compare by."""

    key: tuple[object, ...]
    setup: Setup = field(compare=False)


@lru_cache(maxsize=256)
def _reference(of: _Peaking) -> float:
    camera = of.setup.camera
    along_rows = stripe_runs_along_rows(of.setup)
    across, along = (camera.height, camera.width) if along_rows else (camera.width, camera.height)

    def light(places_px: Float64) -> Float64:
        middle = np.full(len(places_px), (along - 1) / 2.0)
        return _on_plate(
            of.setup, np.column_stack([middle, places_px] if along_rows else [places_px, middle])
        )

    # Between pixels too: a coarse camera's may all miss the peak.
    places = np.arange(2 * across - 1) / 2.0
    about = places[np.argmax(light(places))] + np.linspace(-0.5, 0.5, PEAK_STEPS + 1)
    peak = float(light(np.clip(about, 0.0, across - 1.0)).max())
    if not peak > 0.0:
        raise ValueError(
            "[laser] plane_in_tool: the stripe does not cross the camera's middle column at tool height"
        )
    return peak


def _on_plate(setup: Setup, uv_px: Float64) -> Float64:
    """Return irradiance f_r cos^4 (n,) at image points (n, 2) of a flat plate at tool height, 0 above it."""
    camera = setup.camera
    xy = camera.normalised(uv_px)
    rays_tool = np.column_stack([xy, np.ones(len(xy))]) @ camera.T_tool_camera[:3, :3].T
    down = rays_tool[:, 2] < 0.0
    origin = camera.T_tool_camera[:3, 3]
    points = origin - origin[2] / rays_tool[down, 2:] * rays_tool[down]
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), points.shape)
    light = np.zeros(len(xy))
    # Under a level pose the tool's axes are the joint's.
    light[down] = reflected_sheet(setup, points, up, np.eye(4))
    return light * fall_off(xy)


def stripe_runs_along_rows(setup: Setup) -> bool:
    """Say whether the laser plane's trace on a plate at tool height runs along the image's rows.

    Raises ValueError for a stripe behind the camera.
    """
    origin = setup.laser.point_mm
    along = cross(setup.laser.plane_in_tool[:3], (0.0, 0.0, 1.0))
    ends_tool = np.stack([origin - along, origin + along])
    ends_camera = transform(invert(setup.camera.T_tool_camera), ends_tool)
    if (ends_camera[:, 2] <= 0.0).any():
        raise ValueError("[camera.pose_in_tool]: the stripe at tool height lies behind the camera")
    du, dv = np.abs(np.diff(setup.camera.project(ends_camera), axis=0))[0]
    return bool(du >= dv)
