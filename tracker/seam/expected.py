"""Expectation of a step from a pose: whether the joint can be seen from it, and where."""

from __future__ import annotations

import math
from typing import NamedTuple

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import SeamLine
from tracker import checks
from tracker.checks import FrameChecks
from tracker.seam.gaussian_process import SeamHistory
from tracker.seam.locate import MIN_CROSSING, Matrix, SeamSource, moved_by, seam_point

ROTATION_WITHIN = 1e-3
"""Largest error of a rotation's R R^T against the identity."""

MAX_HEIGHT = 2.0
"""Largest height of the laser over the surface, over its height above the tool's origin."""


def is_rotation(T: Matrix) -> bool:
    """Return True if (4, 4) numbers are a pose: finite, a rotation and a displacement, nothing else."""
    (a, b, c, x), (d, e, f, y), (g, h, k, z), last = T
    return (
        abs(a * a + b * b + c * c - 1.0) <= ROTATION_WITHIN
        and abs(d * d + e * e + f * f - 1.0) <= ROTATION_WITHIN
        and abs(g * g + h * h + k * k - 1.0) <= ROTATION_WITHIN
        and abs(a * d + b * e + c * f) <= ROTATION_WITHIN
        and abs(a * g + b * h + c * k) <= ROTATION_WITHIN
        and abs(d * g + e * h + f * k) <= ROTATION_WITHIN
        and a * (e * k - f * h) - b * (d * k - f * g) + c * (d * h - e * g) > 0.0
        and math.isfinite(x)
        and math.isfinite(y)
        and math.isfinite(z)
        and list(last) == [0.0, 0.0, 0.0, 1.0]
    )


class PoseNumbers(NamedTuple):
    """Tested properties of a pose: whether it is one, and how the sensor stands over the nominal seam, mm.

    `height_mm` is the laser's over the workpiece, `crossing` the cosine between the sheet's normal and the
    seam, `ahead_mm` how far the laser is ahead of the torch along the seam.
    """

    is_rotation: bool
    height_mm: float
    crossing: float
    ahead_mm: float


def pose_numbers(source: SeamSource, T_base_tool: Float64) -> PoseNumbers:
    """Return the tested properties of a pose (4, 4)."""
    T = T_base_tool.tolist()
    if not is_rotation(T):
        return PoseNumbers(False, math.nan, math.nan, math.nan)
    laser_base = moved_by(T, source.origin_mm)
    joint = source.T_base_joint[source.segment_crossed(T_base_tool)]
    (n_x, n_y, n_z, _), (way_x, way_y, way_z) = source.plane, source.ahead_mm
    height = crossing = ahead_mm = 0.0
    for (a, b, c, _), place, (along, _, up, origin) in zip(T, laser_base, joint, strict=False):
        height += (place - origin) * up
        crossing += (a * n_x + b * n_y + c * n_z) * along
        ahead_mm += (a * way_x + b * way_y + c * way_z) * along
    return PoseNumbers(True, height, abs(crossing), ahead_mm)


def check_pose(frame_checks: FrameChecks, source: SeamSource, numbers: PoseNumbers) -> bool:
    """Test whether the joint can be seen from a pose, up to the first failure."""
    ask = frame_checks.ask
    return (
        frame_checks.ask_whether(checks.POSE_RIGID, numbers.is_rotation)
        and ask(checks.LASER_ABOVE, numbers.height_mm, 0.0)
        and ask(checks.LASER_NEAR, numbers.height_mm, MAX_HEIGHT * source.origin_mm[2])
        and ask(checks.SHEET_ACROSS, numbers.crossing, MIN_CROSSING)
        # The sensor looks ahead. Of a line that runs against the travel, left would be taken for right.
        and ask(checks.LASER_AHEAD, numbers.ahead_mm, 0.0)
    )


def expected_line(
    source: SeamSource, segment: int, T_joint_tool: Matrix, history: SeamHistory
) -> tuple[SeamLine, tuple[float, float]]:
    """Return the seam where it should meet the laser plane, and the 1 sigma of its y and z, mm.

    `T_joint_tool` is of the nominal joint frame of a segment.
    """
    corrugation = source.scene.shape.corrugation
    station = moved_by(T_joint_tool, source.ahead_mm)[0]
    y_mm, z_mm = source.seam_at(history, station).displacement_mm
    # The plane may be tilted: it cuts the root of a groove elsewhere than the plate.
    point = seam_point(source, T_joint_tool, corrugation, y_mm, z_mm + source.height_mm)
    station = moved_by(T_joint_tool, point)[0]
    return source.line_at(history, segment, station)


class ExpectedSeam(NamedTuple):
    """Expectation of a step from a pose and the earlier frames.

    `segment` of the nominal line is the one that the sheet cuts, at a cosine of `crossing`; `T_joint_tool`
    (4, 4) is of its joint frame. `line` is the seam where it should meet the laser plane, `sigma_mm` the
    1 sigma of its y and z. The torch stands at `torch_mm` of `torch_segment`, `ends_mm` are the stations of
    the nominal line's start and end.
    """

    segment: int
    crossing: float
    T_joint_tool: Float64
    line: SeamLine
    sigma_mm: tuple[float, float]
    torch_segment: int
    torch_mm: float
    ends_mm: tuple[float, float]


def expect_seam(source: SeamSource, T_base_tool: Float64, history: SeamHistory) -> ExpectedSeam:
    """Return the expected seam of a pose (4, 4) from which the joint can be seen, by the earlier frames."""
    T = T_base_tool.tolist()
    segment = source.segment_crossed(T_base_tool)
    T_joint_tool = source.T_joint_base[segment] @ T_base_tool
    n_x, n_y, n_z, _ = source.plane
    crossing = abs(float(T_joint_tool[0, :3] @ (n_x, n_y, n_z)))
    line, sigma_mm = expected_line(source, segment, T_joint_tool.tolist(), history)
    return ExpectedSeam(
        segment, crossing, T_joint_tool, line, sigma_mm, *torch_station_mm(source, T), source.ends_mm
    )


def expect_torch(source: SeamSource, T_base_tool: Float64) -> ExpectedSeam:
    """Return the expectation of a pose (4, 4) whose sensor is not used: of the torch alone."""
    segment, torch_mm = torch_station_mm(source, T_base_tool.tolist())
    T_joint_tool = source.T_joint_base[segment] @ T_base_tool
    unseen = SeamLine(math.nan), (math.nan, math.nan)
    return ExpectedSeam(segment, math.nan, T_joint_tool, *unseen, segment, torch_mm, source.ends_mm)


def torch_station_mm(source: SeamSource, T_base_tool: Matrix) -> tuple[int, float]:
    """Return the torch's segment and station, mm: past a bend that is another one than the sensor's."""
    (_, _, _, x), (_, _, _, y), (_, _, _, z), _ = T_base_tool
    segment = source.segment_near((x, y, z))
    (a, _, _, u), (b, _, _, v), (c, _, _, w), _ = source.T_base_joint[segment]
    return segment, a * (x - u) + b * (y - v) + c * (z - w)


def ground_at_torch(
    source: SeamSource, expected: ExpectedSeam, segment: int, seam: SeamLine
) -> SeamLine | None:
    """Return where the seam runs under the torch relative to a segment, for the arc that stands there.

    `seam` is the stretch that is looked at, relative to that segment. None where the torch stands over that
    segment itself: the arc then stands on the same straight stretch.
    """
    if expected.torch_segment == segment:
        return None
    at_torch = moved_by(
        source.T_base_joint[expected.torch_segment], (expected.torch_mm, seam.y_mm, seam.z_mm)
    )
    x, y, z = moved_by(source.T_joint_base[segment].tolist(), at_torch)
    return SeamLine(x, y, z)
