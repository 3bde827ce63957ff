"""Where the seam is beside the sensor: expected, found, and how far the hand-eye tolerance lets it be off."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erf

from noise_model.arc_map import Scene
from noise_model.frames import Float64, invert, transform
from noise_model.setup import Setup
from noise_model.surface import SeamLine, corrugation_height, seam_frame, seam_height_mm, section
from tracker import flags
from tracker.follow import SeamHistory
from tracker.geometry import meet_laser_plane, sensor_point

MIN_CROSSING = 0.3
"""The least cosine between the sheet's normal and the seam: below, it shows no section of the joint."""

MOST_STEPS, MET_MM = 20, 1e-9
"""Steps by which the sheet is met along a corrugated seam at most, and how near to it is on it."""

ROTATION_WITHIN = 1e-3
"""How far a rotation's R R^T may be off the identity."""

MAX_HEIGHT = 2.0
"""How high the laser may stand over the surface, over its height above the tool's origin."""


def is_rigid(T_base_tool: Float64) -> bool:
    """Say whether (4, 4) numbers are a pose: finite, a rotation and a displacement, nothing else."""
    if T_base_tool.shape != (4, 4) or not np.isfinite(T_base_tool).all():
        return False
    R = T_base_tool[:3, :3]
    if not (np.abs(R) <= 1.0 + ROTATION_WITHIN).all() or (T_base_tool[3] != (0.0, 0.0, 0.0, 1.0)).any():
        return False
    return bool((np.abs(R @ R.T - np.eye(3)) <= ROTATION_WITHIN).all() and np.linalg.det(R) > 0.0)


def pose_flags(setup: Setup, T_base_tool: Float64) -> int:
    """Return the flags of a pose from which the joint cannot be seen, 0 where it can."""
    if not is_rigid(T_base_tool):
        return flags.POSE_REFUSED.mask
    laser_tool = np.asarray(setup.laser.origin_in_tool_mm)
    T_joint_tool = invert(seam_frame(setup.joint, transform(T_base_tool, laser_tool))) @ T_base_tool
    height = float(transform(T_joint_tool, laser_tool)[2])
    if height <= 0.0:
        return flags.BELOW_SURFACE.mask
    crossing = abs(float(T_joint_tool[0, :3] @ np.asarray(setup.laser.plane_in_tool[:3])))
    if height > MAX_HEIGHT * laser_tool[2] or crossing < MIN_CROSSING:
        return flags.SEAM_OUT_OF_VIEW.mask
    return 0


def expected_seam(setup: Setup, nominal: Scene, history: SeamHistory) -> tuple[SeamLine, Float64]:
    """Return the seam where it should meet the laser plane, and the 1 sigma (2,) of its y and z, mm."""
    station = float(transform(nominal.T_joint_tool, sensor_point(setup))[0])
    seam, _ = history.at(station)
    # The plane may lean: the root of a groove is met elsewhere than the plate is.
    point = seam_point_tool(setup, nominal, float(seam[0]), float(seam[1]) + seam_height_mm(setup.joint))
    return history.line_at(float(transform(nominal.T_joint_tool, point)[0]))


def sources(setup: Setup, view: Scene, station: float) -> tuple[Float64, Float64]:
    """Return where camera and laser stand, (3,) mm, a corrugation's tangent plane at a station levelled."""
    corrugation = view.shape.corrugation
    ahead, here, behind = corrugation_height(station + np.array([0.5, 0.0, -0.5]), corrugation)
    laser_mm = transform(view.T_joint_tool, np.asarray(setup.laser.origin_in_tool_mm))
    sources = view.T_joint_camera[:3, 3].copy(), laser_mm
    for source in sources:
        source[2] -= here + (ahead - behind) * (source[0] - station)
    return sources


def seam_point_tool(setup: Setup, view: Scene, y_mm: float, z_mm: float) -> Float64:
    """Return the point (3,), tool frame, where the seam through (y, z) of a scene's frame meets the sheet.

    `z_mm` counts from a corrugation's own height, which is added at the station that is found.
    """
    T_tool_joint = invert(view.T_joint_tool)
    plane = np.asarray(setup.laser.plane_in_tool)
    direction = T_tool_joint[:3, 0]
    x = float(transform(view.T_joint_tool, sensor_point(setup))[0])
    point = np.zeros(3)
    for _ in range(MOST_STEPS):
        height = float(corrugation_height(np.array(x), view.shape.corrugation))
        point = transform(T_tool_joint, np.array([x, y_mm, z_mm + height]))
        step = float((plane[:3] @ point + plane[3]) / (plane[:3] @ direction))
        if abs(step) < MET_MM:
            break
        x -= step
    return point


def seam_displacement(setup: Setup, T_joint_tool: Float64, seam_tool: Float64) -> tuple[float, Float64]:
    """Return the station of a seam point (3,), tool frame, and its displacement (2,) from the path, mm."""
    station, y, z = transform(T_joint_tool, seam_tool)
    height = seam_height_mm(setup.joint) + float(
        corrugation_height(station, section(setup.joint).corrugation)
    )
    return float(station), np.array([y, z - height])


def confidence(setup: Setup, sigma_mm: Float64) -> float:
    """Return the probability that errors of these 1 sigmas (n,), mm, all stay within the weld's tolerance."""
    return float(np.prod(erf(setup.tolerance.seam_mm / (math.sqrt(2.0) * sigma_mm))))


def locate(
    setup: Setup, T_joint_tool: Float64, view: Scene, y_mm: float, z_mm: float
) -> tuple[Float64, float, Float64]:
    """Return a seam point (3,), tool frame, its station and its displacement (2,) from the path, mm.

    The point is at (y, z) of a look's frame, `T_joint_tool` the tool in the nominal joint frame.
    """
    seam_tool = seam_point_tool(setup, view, y_mm, z_mm)
    return seam_tool, *seam_displacement(setup, T_joint_tool, seam_tool)


def hand_eye_variance(setup: Setup, nominal: Scene, seam_tool: Float64) -> Float64:
    """Return the variance (2,) of the seam's (y, z), mm^2, that the stated hand-eye tolerance leaves.

    Each of the camera's three rotations and translations is off by its 1 sigma in turn; what is seen is kept.
    """
    tolerance = setup.tolerance
    R_tool_camera, origin = setup.camera.T_tool_camera[:3, :3], setup.camera.T_tool_camera[:3, 3]
    seen = (seam_tool - origin) @ R_tool_camera
    # A camera that turns by a small angle about its axes turns the ray by their cross products with it.
    turns = math.radians(tolerance.hand_eye_deg) * np.cross(np.eye(3), seen)
    moved = tolerance.hand_eye_mm * np.eye(3)
    origins = origin + np.concatenate([np.zeros((3, 3)), moved]) @ R_tool_camera.T
    rays = (seen + np.concatenate([turns, np.zeros((3, 3))])) @ R_tool_camera.T
    met = meet_laser_plane(setup, origins, rays)
    shifts = (met - seam_tool) @ nominal.T_joint_tool[:3, :3].T
    return np.asarray(np.sum(shifts[:, 1:] ** 2, axis=0))
