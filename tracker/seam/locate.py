"""Where the seam is beside the sensor: expected, found, and how far the hand-eye tolerance lets it be off."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noise_model.arc.scene import Scene, SceneSource
from noise_model.arrays import Float64
from noise_model.instrument.laser import plane_in
from noise_model.kernel import kernel
from noise_model.setup import Setup
from noise_model.surface.faces import ridge
from noise_model.surface.joint import SeamLine, nearest_segment, seam_height_mm, section
from noise_model.transforms import moved_point, transform
from tracker import checks
from tracker.checks import Checks
from tracker.seam.gaussian_process import SeamHistory, condition

MIN_CROSSING = 0.3
"""The least cosine between the sheet's normal and the seam: below, it shows no section of the joint."""

MAX_STEPS, MET_MM = 40, 1e-9
"""Steps by which the sheet is met along a corrugated seam at most, and how near to it is on it."""

ROTATION_WITHIN = 1e-3
"""How far a rotation's R R^T may be off the identity."""

MAX_HEIGHT = 2.0
"""How high the laser may stand over the surface, over its height above the tool's origin."""


@kernel
def is_rotation(T: Float64) -> bool:
    """Say whether (4, 4) numbers are a pose: finite, a rotation and a displacement, nothing else."""
    for i in range(3):
        for j in range(4):
            if not math.isfinite(T[i, j]) or (j < 3 and abs(T[i, j]) > 1.0 + ROTATION_WITHIN):
                return False
        for j in range(3):
            product = T[i, 0] * T[j, 0] + T[i, 1] * T[j, 1] + T[i, 2] * T[j, 2]
            if abs(product - (1.0 if i == j else 0.0)) > ROTATION_WITHIN:
                return False
    if not (T[3, 0] == 0.0 and T[3, 1] == 0.0 and T[3, 2] == 0.0 and T[3, 3] == 1.0):
        return False
    across = T[1, 1] * T[2, 2] - T[1, 2] * T[2, 1]
    along = T[1, 0] * T[2, 2] - T[1, 2] * T[2, 0]
    level = T[1, 0] * T[2, 1] - T[1, 1] * T[2, 0]
    handed: float = T[0, 0] * across - T[0, 1] * along + T[0, 2] * level
    return handed > 0.0


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


class PoseNumbers(NamedTuple):
    """What is asked of a pose: whether it is one, and how the sensor stands over the nominal seam, mm.

    `height_mm` is the laser's over the workpiece, `crossing` the cosine between the sheet's normal and the
    seam, `ahead_mm` the laser's lead over the torch along the seam.
    """

    is_rotation: bool
    height_mm: float
    crossing: float
    ahead_mm: float


@kernel(allocates=True)
def pose_numbers(source: SeamSource, T_base_tool: Float64) -> PoseNumbers:
    """Return what is asked of a pose (4, 4)."""
    if not is_rotation(T_base_tool):
        return PoseNumbers(False, math.nan, math.nan, math.nan)
    T, laser_base = T_base_tool, moved_point(T_base_tool, source.origin_mm)
    joint = source.scene.segments.frames[nearest_segment(source.scene.segments, laser_base)]
    height, crossing, ahead_mm = 0.0, 0.0, 0.0
    for i in range(3):
        height += (laser_base[i] - joint[i, 3]) * joint[i, 2]
        normal, way = 0.0, 0.0
        for j in range(3):
            normal += T[i, j] * source.plane[j]
            way += T[i, j] * source.scene.ahead_mm[j]
        crossing += normal * joint[i, 0]
        ahead_mm += way * joint[i, 0]
    return PoseNumbers(True, height, abs(crossing), ahead_mm)


def pose_checks(source: SeamSource, T_base_tool: Float64) -> Checks:
    """Return what is asked of a pose, up to the first answer by which the joint cannot be seen from it."""
    asked = Checks()
    if T_base_tool.shape != (4, 4):
        asked.ask(checks.POSE_RIGID, False)
        return asked
    told = pose_numbers(source, np.require(T_base_tool, np.float64, ("C", "W")))
    if not asked.ask(checks.POSE_RIGID, told.is_rotation):
        return asked
    if not asked.ask(checks.LASER_ABOVE, told.height_mm, 0.0):
        return asked
    if not asked.ask(checks.LASER_NEAR, told.height_mm, MAX_HEIGHT * float(source.origin_mm[2])):
        return asked
    if not asked.ask(checks.SHEET_ACROSS, told.crossing, MIN_CROSSING):
        return asked
    # The sensor looks ahead. Of a line that runs against the travel, left would be taken for right.
    asked.ask(checks.LASER_AHEAD, told.ahead_mm, 0.0)
    return asked


def expected_seam(
    source: SeamSource, nominal_scene: Scene, history: SeamHistory
) -> tuple[SeamLine, tuple[float, float]]:
    """Return the seam where it should meet the laser plane, and the 1 sigma of its y and z, mm."""
    expected: tuple[SeamLine, tuple[float, float]] = _expected(
        source,
        nominal_scene.T_joint_tool,
        history.stations_mm,
        history.displacements_mm,
        history.variances_mm2,
    )
    return expected


@kernel(allocates=True)
def _expected(
    source: SeamSource,
    T_joint_tool: Float64,
    stations_mm: Float64,
    displacements_mm: Float64,
    variances_mm2: Float64,
) -> tuple[SeamLine, tuple[float, float]]:
    """Return `expected_seam`'s from the history's arrays."""
    ahead_mm, corrugation = source.scene.ahead_mm, source.scene.shape.corrugation
    value, sigma, slope, slope_sigma = np.empty(2), np.empty(2), np.empty(2), np.empty(2)
    station = moved_point(T_joint_tool, ahead_mm)[0]
    condition(stations_mm, displacements_mm, variances_mm2, station, value, sigma, slope, slope_sigma)
    # The plane may lean: the root of a groove is met elsewhere than the plate is.
    height_mm = value[1] + source.height_mm
    point = seam_point(T_joint_tool, source.plane, ahead_mm, corrugation, value[0], height_mm)
    station = moved_point(T_joint_tool, point)[0]
    condition(stations_mm, displacements_mm, variances_mm2, station, value, sigma, slope, slope_sigma)
    line = SeamLine(station, value[0], value[1], slope[0], slope[1], max(slope_sigma[0], slope_sigma[1]))
    return line, (sigma[0], sigma[1])


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


def confidence(weld_mm: float, sigmas_mm: Sequence[float]) -> float:
    """Return the probability that errors of these 1 sigmas, mm, all stay within the weld's tolerance, mm."""
    within = weld_mm / math.sqrt(2.0)
    return math.prod(1.0 if sigma == 0.0 else math.erf(within / sigma) for sigma in sigmas_mm)


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
