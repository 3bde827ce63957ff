"""The laser stripe: how much of the sheet's light the surface sends to the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float32, Float64, Integers
from noise_model.instrument.camera import fall_off
from noise_model.instrument.laser import (
    Sheet,
    beyond_fan_mm,
    sheet_of,
    sheet_reflected,
)
from noise_model.kernel import kernel
from noise_model.setup import Setup
from noise_model.surface.brdf import LobeNumbers, lobe_numbers
from noise_model.surface.ray_casting import way_is_open, ways_are_open
from noise_model.transforms import cross, invert, transform
from noise_model.view import View


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


class SheetSeen(NamedTuple):
    """Which of a view's pixels (...,) lie within the sheet's reach, and which of these it does not reach."""

    near: Bool
    shaded: Bool


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
        reach = laser.reach_sigmas * laser.stripe_sigma_mm * np.abs(depth) / laser.origin_in_tool_mm[2]
        near = np.abs(points_tool @ plane[:3] + plane[3]) < reach
    shaded = np.zeros(view.shape, dtype=np.bool_)
    if not near.any():
        return SheetSeen(near, shaded)
    origin_joint = transform(where.T_joint_tool, laser.origin_mm)
    is_free = np.empty(np.count_nonzero(near), dtype=np.bool_)
    ways_are_open(points[near], origin_joint, where.shape.vertices, where.shape.corrugation, is_free)
    shaded[near] = ~is_free | (beyond_fan_mm(points_tool[near], laser) > 0.0)
    return SheetSeen(near, shaded)


def stripe_light(view: View, unit_e: float) -> Float32:
    """Return the laser stripe (...,), e- for `camera.exposure_s`, before the point-spread function.

    The sheet's irradiance times f_r towards the camera, scaled by `unit_e` so that a flat plate at tool
    height under a level pose peaks at `peak_e` in the middle column; of each pixel that at its centre.
    """
    setup, where = view.setup, view.scene
    points, normals, _ = view.surface
    light = np.empty(view.cos4.size)
    _light_open(
        points.reshape(-1, 3),
        normals.reshape(-1, 3),
        where.T_joint_camera[:3, 3],
        sheet_of(setup.laser, where.T_joint_tool),
        lobe_numbers(setup.material),
        setup.laser.reach_sigmas,
        where.shape.vertices,
        where.shape.corrugation,
        light,
    )
    return np.asarray(light.reshape(view.shape) * (view.cos4 * unit_e), dtype=np.float32)


@kernel(allocates=True)
def _light_open(
    points: Float64,
    normals: Float64,
    camera: Float64,
    sheet: Sheet,
    material: LobeNumbers,
    reach: float,
    vertices: Float64,
    corrugation: Float64,
    light: Float64,
) -> None:
    """Write the light (n,) of `reflected_sheet` up to a reach, 0 where the sheet's way is not free.

    The plain twin is `reflected_sheet` where `sheet_seen` says that the sheet is near and not shaded.
    """
    for i in range(points.shape[0]):
        P = points[i]
        x, y, z = camera[0] - P[0], camera[1] - P[1], camera[2] - P[2]
        distance = math.sqrt(x * x + y * y + z * z)
        omega_r = (x / distance, y / distance, z / distance)
        light[i] = sheet_reflected(sheet, material, P, normals[i], omega_r, reach)
        if light[i] != 0.0 and not way_is_open(P, sheet.origin, vertices, corrugation):
            light[i] = 0.0


def crossed_by_borders(faces: Integers, sheet: SheetSeen) -> Bool:
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

    It is that of the laser plane's own point (`stripe_point`), whether or not it lies in the image, and in
    the fan: where f_r changes over the sheet the peak beside it is higher, by 4e-4 at the nominal setups.
    Raises ValueError if no light goes from there to the camera.
    """
    pose = setup.camera.T_tool_camera.tobytes()
    endless = replace(setup.laser, fan_half_angle_deg=None)
    return _reference(
        _Peaking((setup.camera.geometry, pose, endless, setup.material), replace(setup, laser=endless))
    )


def stripe_point(setup: Setup) -> Float64:
    """Return where laser plane, plate at tool height and middle column meet (3,), tool frame, mm.

    The middle row it is where the stripe runs along columns. Its plane holds the camera and the ray of the
    image's middle: a lens whose distortion bends the column leaves it a little beside.
    """
    camera, laser = setup.camera, setup.laser
    middle = camera.normalised([(camera.width - 1) / 2.0, (camera.height - 1) / 2.0])[0]
    axis = 0 if stripe_runs_along_rows(setup) else 1
    # x - x_middle z = 0, or y - y_middle z = 0, of the camera's frame.
    normal_camera = np.array([1.0 - axis, float(axis), -middle[axis]])
    normal = camera.T_tool_camera[:3, :3] @ normal_camera
    along = cross(laser.plane[:3], (0.0, 0.0, 1.0))
    way = normal @ (camera.T_tool_camera[:3, 3] - laser.point_mm) / (normal @ along)
    return np.asarray(laser.point_mm + way * along)


def stripe_depth_mm(setup: Setup) -> float:
    """Return how far along the camera's axis `stripe_point` lies, mm; negative behind the camera."""
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
