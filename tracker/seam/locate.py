"""Where the seam is beside the sensor: expected, found, and how far the hand-eye tolerance lets it be off."""

from __future__ import annotations

import math

import numpy as np

from noise_model.arc.scene import Scene
from noise_model.arrays import Float64
from noise_model.instrument.laser import plane_in
from noise_model.kernel import kernel
from noise_model.setup import Setup
from noise_model.surface.faces import ridge
from noise_model.surface.joint import SeamLine, seam_frame, seam_height_mm, section
from noise_model.transforms import transform
from tracker import checks
from tracker.checks import Checks
from tracker.seam.gaussian_process import SeamHistory

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


def is_rigid(T_base_tool: Float64) -> bool:
    """Say whether an array is a pose, whatever its shape is."""
    return T_base_tool.shape == (4, 4) and is_rotation(np.require(T_base_tool, np.float64, ("C", "W")))


def pose_checks(setup: Setup, T_base_tool: Float64) -> Checks:
    """Return what is asked of a pose, up to the first answer by which the joint cannot be seen from it."""
    asked = Checks()
    if not asked.ask(checks.POSE_RIGID, is_rigid(T_base_tool)):
        return asked
    laser = setup.laser
    laser_base = transform(T_base_tool, laser.origin_mm)
    T_base_joint = seam_frame(setup.joint, laser_base)
    height = float((laser_base - T_base_joint[:3, 3]) @ T_base_joint[:3, 2])
    if not asked.ask(checks.LASER_ABOVE, height, 0.0):
        return asked
    crossing = abs(float(T_base_tool[:3, :3] @ laser.plane[:3] @ T_base_joint[:3, 0]))
    if not asked.ask(checks.LASER_NEAR, height, MAX_HEIGHT * laser.origin_in_tool_mm[2]):
        return asked
    if not asked.ask(checks.SHEET_ACROSS, crossing, MIN_CROSSING):
        return asked
    # The sensor looks ahead. Of a line that runs against the travel, left would be taken for right.
    ahead_mm = float(T_base_tool[:3, :3] @ laser.point_mm @ T_base_joint[:3, 0])
    asked.ask(checks.LASER_AHEAD, ahead_mm, 0.0)
    return asked


def expected_seam(setup: Setup, nominal_scene: Scene, history: SeamHistory) -> tuple[SeamLine, Float64]:
    """Return the seam where it should meet the laser plane, and the 1 sigma (2,) of its y and z, mm."""
    station = float(transform(nominal_scene.T_joint_tool, setup.laser.point_mm)[0])
    seam, _ = history.at(station)
    # The plane may lean: the root of a groove is met elsewhere than the plate is.
    point = seam_point_tool(
        setup, nominal_scene, float(seam[0]), float(seam[1]) + seam_height_mm(setup.joint)
    )
    return history.line_at(float(transform(nominal_scene.T_joint_tool, point)[0]))


def sources(setup: Setup, scene: Scene, station: float) -> tuple[Float64, Float64]:
    """Return where camera and laser stand, (3,) mm, x from a station where the tangent plane is levelled.

    That is a corrugation's.
    """
    corrugation = scene.shape.corrugation
    ahead, here, behind = (ridge(station + step, corrugation)[0] for step in (0.5, 0.0, -0.5))
    laser_mm = transform(scene.T_joint_tool, setup.laser.origin_mm)
    sources = scene.T_joint_camera[:3, 3].copy(), laser_mm
    for source in sources:
        source[0] -= station
        source[2] -= here + (ahead - behind) * source[0]
    return sources


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


def confidence(setup: Setup, sigma_mm: Float64) -> float:
    """Return the probability that errors of these 1 sigmas (n,), mm, all stay within the weld's tolerance."""
    within = setup.tolerance.seam_mm / math.sqrt(2.0)
    return math.prod(1.0 if sigma == 0.0 else math.erf(within / sigma) for sigma in sigma_mm.tolist())


def locate(
    setup: Setup, T_joint_tool: Float64, scene: Scene, y_mm: float, z_mm: float
) -> tuple[Float64, float, Float64]:
    """Return a seam point (3,), tool frame, its station and its displacement (2,) from the path, mm.

    The point is at (y, z) of a look's frame, `T_joint_tool` the tool in the nominal joint frame.
    """
    seam_tool = seam_point_tool(setup, scene, y_mm, z_mm)
    return seam_tool, *seam_displacement(setup, T_joint_tool, seam_tool)


def hand_eye_variance(setup: Setup, nominal_scene: Scene, seam_tool: Float64) -> Float64:
    """Return the variance (2,) of the seam's (y, z), mm^2, that the stated hand-eye tolerance leaves.

    Each of the camera's three rotations and translations is off by its 1 sigma in turn; what is seen is kept.
    """
    tolerance = setup.tolerance
    return moved_variance(
        setup.camera.T_tool_camera,
        setup.laser.plane,
        nominal_scene.T_joint_tool,
        seam_tool,
        math.radians(tolerance.hand_eye_deg),
        tolerance.hand_eye_mm,
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
