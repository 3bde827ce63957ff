"""The laser stripe: how much of the sheet's light the surface sends to the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64, Int64, Integers
from noise_model.compiled.kernel import kernel
from noise_model.instrument.camera import fall_off
from noise_model.instrument.laser import (
    Sheet,
    depth_below,
    is_outside_fan,
    off_sheet,
    plane_met,
    sheet_at,
    sheet_in_tool,
    sheet_of,
    sheet_reflected,
)
from noise_model.setup import Setup
from noise_model.surface.brdf import LobeNumbers, lobe_numbers
from noise_model.surface.ray_casting import way_is_open
from noise_model.transforms import cross, invert, transform


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


class SheetReach(NamedTuple):
    """Pixels (...,) within the sheet's reach, and those of them in its shadow."""

    near: Bool
    shaded: Bool


@kernel(allocates=True)
def see_sheet(
    points: Float64,
    which: Int64,
    sheets: Sheet,
    reach: float,
    vertices: Float64,
    corrugation: Float64,
    seen: SheetReach,
) -> None:
    """Write the points (n, 3), mm, joint frame, within a reach of the sheet, and those in its shadow.

    `which` (n,) says to which of the `sheets` each point belongs.
    """
    sheet, current = sheet_at(sheets, 0), 0
    for i in range(points.shape[0]):
        P = points[i]
        if which[i] != current:
            current = which[i]
            sheet = sheet_at(sheets, current)
        # A point past the workpiece is NaN, and near nothing.
        seen.near[i] = (
            abs(off_sheet(sheet, P)) < reach * sheet.sigma * abs(depth_below(sheet, P)) / sheet.stand
        )
        seen.shaded[i] = seen.near[i] and (
            is_outside_fan(sheet, P) or not way_is_open(P, sheet.origin, vertices, corrugation)
        )


@kernel(allocates=True)
def light_stripe(
    points: Float64,
    normals: Float64,
    which: Int64,
    cameras: Float64,
    sheets: Sheet,
    material: LobeNumbers,
    reach: float,
    vertices: Float64,
    corrugation: Float64,
    light: Float64,
) -> None:
    """Write the light (n,) of `reflected_sheet` up to a reach, 0 where the sheet's way is not free.

    `which` (n,) says to which of the `cameras` (m, 3), mm, and of the `sheets` each point belongs. The plain
    twin is `reflected_sheet` where `see_sheet` says that the sheet is near and not shaded.
    """
    sheet, current = sheet_at(sheets, 0), 0
    for i in range(points.shape[0]):
        P, camera = points[i], cameras[which[i]]
        # Most points belong to the scene of the one before.
        if which[i] != current:
            current = which[i]
            sheet = sheet_at(sheets, current)
        x, y, z = camera[0] - P[0], camera[1] - P[1], camera[2] - P[2]
        distance = math.sqrt(x * x + y * y + z * z)
        omega_r = (x / distance, y / distance, z / distance)
        light[i] = sheet_reflected(sheet, material, P, normals[i], omega_r, reach)
        if light[i] != 0.0 and not way_is_open(P, sheet.origin, vertices, corrugation):
            light[i] = 0.0


def crossed_by_borders(faces: Integers, sheet: SheetReach) -> Bool:
    """Return along which axes (H, W, 2), u and v, a border of the stripe may cross the pixels of a frame.

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

    It is that of the laser sheet's own point (`stripe_point`), whether or not it lies in the image, and in
    the fan: where f_r changes over the sheet the peak next to it is higher, by 4e-4 at the nominal setups.
    Raises ValueError if no light goes from there to the camera.
    """
    pose = setup.camera.T_tool_camera.tobytes()
    endless = replace(setup.laser, fan_half_angle_deg=None)
    return _reference(
        _Peaking((setup.camera.geometry, pose, endless, setup.material), replace(setup, laser=endless))
    )


def stripe_point(setup: Setup) -> Float64:
    """Return the intersection of laser sheet, plate at tool height and middle column (3,), tool frame, mm.

    The middle row it is where the stripe runs along columns. Its plane holds the camera and the ray of the
    image's middle: a lens whose distortion bends the column leaves it slightly off.
    """
    camera, laser = setup.camera, setup.laser
    middle = camera.normalised([(camera.width - 1) / 2.0, (camera.height - 1) / 2.0])[0]
    axis = 0 if stripe_runs_along_rows(setup) else 1
    # x - x_middle z = 0, or y - y_middle z = 0, of the camera's frame.
    normal_camera = np.array([1.0 - axis, float(axis), -middle[axis]])
    normal = camera.T_tool_camera[:3, :3] @ normal_camera
    along = cross(laser.plane[:3], (0.0, 0.0, 1.0))
    way = normal @ (camera.T_tool_camera[:3, 3] - laser.point_mm) / (normal @ along)
    point = np.asarray(laser.point_mm + way * along)
    if laser.bow == 0.0:
        return point
    level = cross(normal, (0.0, 0.0, 1.0))
    n_x, n_y, n_z, d = plane_met(sheet_in_tool(laser), point, level)
    n = np.array([n_x, n_y, n_z])
    return np.asarray(point - (n @ point + d) / (n @ level) * level)


def stripe_depth_mm(setup: Setup) -> float:
    """Return the depth of `stripe_point` along the camera's axis, mm; negative behind the camera."""
    return float(transform(invert(setup.camera.T_tool_camera), stripe_point(setup))[2])


def check_stripe(setup: Setup) -> None:
    """Raise ValueError if a setup's camera does not see the stripe's peak, which `peak_e` is stated for."""
    camera = setup.camera
    ray = transform(invert(camera.T_tool_camera), stripe_point(setup))
    u, v = camera.project(ray[np.newaxis])[0]
    if not (ray[2] > 0.0 and -0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5):
        raise ValueError(
            "[laser] plane_in_tool: the stripe does not cross the camera's middle column at tool height"
        )


@dataclass(frozen=True)
class _Peaking:
    """A setup, and all of it that its stripe's peak depends on, to compare by."""

    key: tuple[object, ...]
    setup: Setup = field(compare=False)


@lru_cache(maxsize=256)
def _reference(peaking: _Peaking) -> float:
    setup = peaking.setup
    point = stripe_point(setup)
    ray = transform(invert(setup.camera.T_tool_camera), point)
    light = 0.0
    if ray[2] > 0.0:
        # Under a level pose the tool's axes are the joint's.
        seen = reflected_sheet(setup, point[np.newaxis], np.array([[0.0, 0.0, 1.0]]), np.eye(4))
        light = float(seen[0] * fall_off(ray[:2] / ray[2]))
    if not light > 0.0:
        raise ValueError(
            "[laser] plane_in_tool: the camera does not see the stripe on a plate at tool height"
        )
    return light


def stripe_runs_along_rows(setup: Setup) -> bool:
    """Return True if the laser plane's trace on a plate at tool height runs along the image's rows.

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
