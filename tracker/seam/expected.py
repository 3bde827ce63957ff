"""What a step expects of a pose before it looks: whether the joint can be seen from it, and where."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.scene import Scene, laid_scene
from noise_model.arrays import Float64
from noise_model.kernel import kernel
from noise_model.surface.joint import SeamLine, SeamSegments, nearest_segment
from noise_model.transforms import inverted, moved_point, multiplied
from tracker import checks
from tracker.checks import FrameChecks
from tracker.seam.gaussian_process import SeamHistory, condition
from tracker.seam.joint_ends import nominal_ends
from tracker.seam.locate import SeamSource, seam_point

MIN_CROSSING = 0.3
"""The least cosine between the sheet's normal and the seam: below, it shows no section of the joint."""

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


def check_pose(frame_checks: FrameChecks, source: SeamSource, told: PoseNumbers) -> bool:
    """Ask of a pose whether the joint can be seen from it, up to the first answer by which it cannot."""
    ask = frame_checks.ask
    return (
        frame_checks.ask_whether(checks.POSE_RIGID, told.is_rotation)
        and ask(checks.LASER_ABOVE, told.height_mm, 0.0)
        and ask(checks.LASER_NEAR, told.height_mm, MAX_HEIGHT * float(source.origin_mm[2]))
        and ask(checks.SHEET_ACROSS, told.crossing, MIN_CROSSING)
        # The sensor looks ahead. Of a line that runs against the travel, left would be taken for right.
        and ask(checks.LASER_AHEAD, told.ahead_mm, 0.0)
    )


@kernel(allocates=True)
def expected_line(
    source: SeamSource,
    T_joint_tool: Float64,
    history: SeamHistory,
) -> tuple[SeamLine, tuple[float, float]]:
    """Return the seam where it should meet the laser plane, and the 1 sigma of its y and z, mm.

    `T_joint_tool` (4, 4) is of the nominal joint frame.
    """
    ahead_mm, corrugation = source.scene.ahead_mm, source.scene.shape.corrugation
    station = moved_point(T_joint_tool, ahead_mm)[0]
    y_mm, z_mm = condition(history, station).displacement_mm
    # The plane may lean: the root of a groove is met elsewhere than the plate is.
    point = seam_point(T_joint_tool, source.plane, ahead_mm, corrugation, y_mm, z_mm + source.height_mm)
    station = moved_point(T_joint_tool, point)[0]
    there = condition(history, station)
    (y_mm, z_mm), (slope_y, slope_z), slope_sigma = there.displacement_mm, there.slope, there.slope_sigma
    line = SeamLine(station, y_mm, z_mm, slope_y, slope_z, max(slope_sigma[0], slope_sigma[1]))
    return line, there.sigma_mm


@kernel(allocates=True)
def torch_stations_mm(
    segments: SeamSegments, T_base_tool: Float64, T_joint_tool: Float64
) -> tuple[float, tuple[float, float]]:
    """Return the torch's station, and those of the nominal line's ends as `nominal_ends` has them.

    Past a bend the torch may be on another segment than the sensor, `T_joint_tool`: each goes by its own.
    """
    tip = np.empty(3)
    for i in range(3):
        tip[i] = T_base_tool[i, 3]
    on = segments.frames[nearest_segment(segments, tip)]
    torch_mm = 0.0
    for i in range(3):
        torch_mm += on[i, 0] * (tip[i] - on[i, 3])
    return torch_mm, nominal_ends(segments, multiplied(T_joint_tool, inverted(T_base_tool)))


class ExpectedSeam(NamedTuple):
    """What a pose and the earlier frames let a step expect; none of it holds where `pose` is no rotation.

    `scene` is the pose's, seen from the nominal joint. `line` is the seam where it should meet the laser
    plane, `sigma_mm` the 1 sigma of its y and z. `torch_mm` is the torch's station, `ends_mm` are those of
    the nominal line's start and end.
    """

    pose: PoseNumbers
    scene: Scene
    line: SeamLine
    sigma_mm: tuple[float, float]
    torch_mm: float
    ends_mm: tuple[float, float]


@kernel(allocates=True)
def expect_seam(
    source: SeamSource,
    T_base_tool: Float64,
    history: SeamHistory,
) -> ExpectedSeam:
    """Return what a pose (4, 4) and the earlier frames let a step expect."""
    nominal = SeamLine(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    scene = laid_scene(source.scene, T_base_tool, nominal, nominal, True)
    T_joint_tool = scene.T_joint_tool
    line, sigma_mm = expected_line(source, T_joint_tool, history)
    torch_mm, ends_mm = torch_stations_mm(source.scene.segments, T_base_tool, T_joint_tool)
    return ExpectedSeam(pose_numbers(source, T_base_tool), scene, line, sigma_mm, torch_mm, ends_mm)
