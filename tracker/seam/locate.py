"""Where a seam that was seen lies, and how far the hand-eye tolerance lets it be off."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.scene import Scene, SceneSource
from noise_model.arrays import Float64
from noise_model.instrument.laser import plane_in
from noise_model.kernel import kernel
from noise_model.setup import Setup
from noise_model.surface.faces import ridge
from noise_model.surface.joint import seam_height_mm, section
from noise_model.transforms import moved_point, transform

MAX_STEPS, MET_MM = 40, 1e-9
"""Steps by which the sheet is met along a corrugated seam at most, and how near to it is on it."""


class SeamSource(NamedTuple):
    """What a setup fixes of its seam, as the kernels take it.

    `scene` is of its scenes; `origin_mm` (3,) and `plane` (4,) are the laser's, tool frame; `height_mm` is
    the seam point's over the reference surface; `turn_rad` and `move_mm` are the hand-eye tolerance's 1
    sigmas, `weld_mm` is the weld's tolerance.
    """

    scene: SceneSource
    origin_mm: Float64
    plane: Float64
    height_mm: float
    turn_rad: float
    move_mm: float
    weld_mm: float

    @classmethod
    def of(cls, setup: Setup) -> SeamSource:
        """Gather a setup."""
        laser, tolerance = setup.laser, setup.tolerance
        return cls(
            SceneSource.of(setup),
            laser.origin_mm,
            laser.plane,
            seam_height_mm(setup.joint),
            math.radians(tolerance.hand_eye_deg),
            tolerance.hand_eye_mm,
            tolerance.seam_mm,
        )


@kernel(allocates=True)
def sources(source: SeamSource, scene: Scene, station_mm: float) -> tuple[Float64, Float64]:
    """Return where camera and laser stand, (3,) mm, x from a station where the tangent plane is levelled.

    That is a corrugation's.
    """
    corrugation = scene.shape.corrugation
    here = ridge(station_mm, corrugation)[0]
    tangent = ridge(station_mm + 0.5, corrugation)[0] - ridge(station_mm - 0.5, corrugation)[0]
    camera_mm, laser_mm = np.empty(3), moved_point(scene.T_joint_tool, source.origin_mm)
    for i in range(3):
        camera_mm[i] = scene.T_joint_camera[i, 3]
    for place_mm in (camera_mm, laser_mm):
        place_mm[0] -= station_mm
        place_mm[2] -= here + tangent * place_mm[0]
    return camera_mm, laser_mm


def seam_point_tool(setup: Setup, scene: Scene, y_mm: float, z_mm: float) -> Float64:
    """Return the point (3,), tool frame, where the seam through (y, z) of a scene's frame meets the sheet.

    `z_mm` counts from a corrugation's own height, which is added at the station that is found.
    """
    laser = setup.laser
    return seam_point(scene.T_joint_tool, laser.plane, laser.point_mm, scene.shape.corrugation, y_mm, z_mm)


@kernel(allocates=True)
def seam_point(
    T_joint_tool: Float64, plane_tool: Float64, start_tool: Float64, corrugation: Float64, y: float, z: float
) -> Float64:
    """Return `seam_point_tool`'s point, sought by Newton's steps from where a point (3,), tool frame, lies.

    Steps that leave where it must lie are halved brackets instead.
    """
    T = T_joint_tool
    nx, ny, nz, e = plane_in(T, plane_tool)
    x = T[0, 0] * start_tool[0] + T[0, 1] * start_tool[1] + T[0, 2] * start_tool[2] + T[0, 3]
    # Between where it meets the valleys' height and where the ridges' the sheet meets the seam, or thrice.
    of_valley, of_ridge = -(ny * y + nz * z + e) / nx, -(ny * y + nz * (z + corrugation[0]) + e) / nx
    low, high = min(of_valley, of_ridge), max(of_valley, of_ridge)
    x = min(max(x, low), high)
    for _ in range(MAX_STEPS):
        height, slope = ridge(x, corrugation)
        beyond = x - of_valley + nz / nx * height
        low, high = (low, x) if beyond > 0.0 else (x, high)
        met = x - beyond / (1.0 + nz / nx * slope)
        if not low <= met <= high:
            met = 0.5 * (low + high)
        step = abs(met - x)
        x = met
        if step < MET_MM:
            break
    from_tool = (x - T[0, 3], y - T[1, 3], z + ridge(x, corrugation)[0] - T[2, 3])
    point = np.empty(3)
    for i in range(3):
        point[i] = T[0, i] * from_tool[0] + T[1, i] * from_tool[1] + T[2, i] * from_tool[2]
    return point


def seam_displacement(setup: Setup, T_joint_tool: Float64, seam_tool: Float64) -> tuple[float, Float64]:
    """Return the station of a seam point (3,), tool frame, and its displacement (2,) from the path, mm."""
    station, y, z = transform(T_joint_tool, seam_tool)
    height = seam_height_mm(setup.joint) + ridge(station, section(setup.joint).corrugation)[0]
    return float(station), np.array([y, z - height])


@kernel
def confidence(weld_mm: float, sigma_y_mm: float, sigma_z_mm: float) -> float:
    """Return the probability that errors of these 1 sigmas, mm, both stay within the weld's tolerance, mm.

    NaN where either is NaN.
    """
    within, probability = weld_mm / math.sqrt(2.0), 1.0
    for sigma in (sigma_y_mm, sigma_z_mm):
        if sigma != 0.0:
            probability *= math.erf(within / sigma)
    return probability


class Located(NamedTuple):
    """A seam point: in the tool frame, mm, its station, and its displacement from the path as (y, z), mm.

    `hand_eye_mm2` is the variance of its (y, z) that the stated hand-eye tolerance leaves.
    """

    seam_tool_mm: tuple[float, float, float]
    station_mm: float
    displacement_mm: tuple[float, float]
    hand_eye_mm2: tuple[float, float]


@kernel(allocates=True)
def locate(source: SeamSource, T_nominal_tool: Float64, scene: Scene, y_mm: float, z_mm: float) -> Located:
    """Return the seam point at (y, z) of a look's frame; `T_nominal_tool` is of the nominal joint frame.

    Of the hand-eye each of the camera's three rotations and translations is off by its 1 sigma in turn; what
    is seen is kept.
    """
    corrugation = scene.shape.corrugation
    point = seam_point(scene.T_joint_tool, source.plane, source.scene.ahead_mm, corrugation, y_mm, z_mm)
    place = moved_point(T_nominal_tool, point)
    height = source.height_mm + ridge(place[0], corrugation)[0]
    moves = moved_variance(
        source.scene.T_tool_camera, source.plane, T_nominal_tool, point, source.turn_rad, source.move_mm
    )
    return Located(
        (point[0], point[1], point[2]), place[0], (place[1], place[2] - height), (moves[0], moves[1])
    )


@kernel(allocates=True)
def moved_variance(
    T_tool_camera: Float64,
    plane_tool: Float64,
    T_joint_tool: Float64,
    point_tool: Float64,
    turn: float,
    move_mm: float,
) -> Float64:
    """Return the sum (2,) of a point's squared moves in y and z as the camera turns and moves about its axes.

    A ray d from o meets the plane n.p + e = 0 in o + t d. If the camera turns by a small angle about one of
    its axes a, d moves by its cross product with it; a move of the camera moves o.
    """
    T, n, variance = T_tool_camera, plane_tool, np.zeros(2)
    ray, o, d, met = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        ray[i] = point_tool[i] - T[i, 3]
    for case in range(6):
        k = case % 3
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            o[i] = T[i, 3] + (move_mm * T[i, k] if case >= 3 else 0.0)
            d[i] = ray[i] + (turn * (T[j, k] * ray[m] - T[m, k] * ray[j]) if case < 3 else 0.0)
        off = n[0] * o[0] + n[1] * o[1] + n[2] * o[2] + n[3]
        t = -off / (n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
        for i in range(3):
            met[i] = o[i] + t * d[i] - point_tool[i] if t > 0.0 else math.nan
        for axis in range(2):
            row = T_joint_tool[axis + 1]
            variance[axis] += (row[0] * met[0] + row[1] * met[1] + row[2] * met[2]) ** 2
    return variance
