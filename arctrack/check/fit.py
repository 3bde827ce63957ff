"""Match of the bright lines of some frames with the laser's stripe as a setup and its poses place it.

A line's points are intersected with the laser plane and compared with the stated section of the joint. The
true seam may leave its nominal line by some millimetres, but equally in neighbouring frames, however the tool
moves: what counts is the share of the points on a section that is displaced along a straight line.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import SeamSegments, corrugation_height, nearest_segment, seam_frame, section
from noise_model.transforms import invert, transform
from tracker.checks import FrameChecks
from tracker.geometry import SEARCH_REACH_MM, to_laser_plane
from tracker.joint.type_check import JointFamily, shown_family
from tracker.profile import points_of
from tracker.seam.expected import check_pose, pose_numbers
from tracker.seam.locate import SeamSource

BESIDE_MM = 4.0
"""Reach beyond the section's outer corners in which points count: farther out all joints are plates."""

MIN_BEYOND_MM = 2.0
"""A line that reaches less far beyond these corners shows no joint."""

ENOUGH = 0.5
"""If fewer of the frames, or of the wanted offsets, of a run are as they should be, something is wrong."""

MIN_POINTS, MAX_POINTS = 8, 240
"""Least number of points on the joint, and number of a line's points that are used."""

STEEPEST = 0.1
"""Largest slope of a seam relative to its nominal line, mm per mm."""

MAX_COST_MM = 2.0
"""A frame farther from the seam's straight line than this counts no more."""


STEP_MM, WITHIN_MM, WITHIN_PX = 0.25, 0.3, 1.5
"""Steps of the section's displacement, and tolerance of a point on it: the larger of mm and px."""


@dataclass(frozen=True, eq=False)
class SightedLine:
    """A frame's bright line, points (n, 2) x y, px, and the tool's pose (4, 4), NaN where there is none."""

    points_px: Float64
    T_base_tool: Float64


@dataclass(frozen=True, eq=False)
class LinePoints:
    """A line's points in the joint frame, `y_mm`, `z_mm` (n,); none if the pose raises the tracker's `flags`.

    `station_mm` is where the laser's sheet meets the path; a point moves by `mm_per_px` at most with a pixel.
    """

    y_mm: Float64
    z_mm: Float64
    station_mm: float
    mm_per_px: float
    flags: int

    @property
    def within_mm(self) -> float:
        """Largest distance of a point that lies on a section."""
        return max(WITHIN_MM, WITHIN_PX * self.mm_per_px)

    @property
    def family(self) -> JointFamily | None:
        """Family of joints that the points look like, None if unknown."""
        n = len(self.y_mm)
        if n < 2:
            return None
        order = np.argsort(self.y_mm)
        y, z = self.y_mm[order], self.z_mm[order]
        px, scan = np.ones(n), np.arange(n, dtype=np.float64)
        points = points_of(y, z, scan=scan, sigma_px=px, beside_px=px, dz_mm=self.mm_per_px)
        return shown_family(points)


@dataclass(frozen=True, eq=False)
class SectionMatch:
    """Match of lines with a section: `share` of all points, where it is displaced along a straight line.

    It is 0 where the nominal line ends before most of the torch's places: there no offset is sent.
    """

    share: float
    lines: tuple[LinePoints, ...]


def fit(setup: Setup, sights: Sequence[SightedLine]) -> SectionMatch:
    """Lay the lines over the setup's section."""
    vertices = section(setup.joint).vertices
    lines = [line_points(setup, sight) for sight in sights]
    placed = [_place(line, vertices) for line in lines]
    straight = _straight(np.array([line.station_mm for line in lines]), np.array(placed).reshape(-1, 2))
    shares = [
        float(_share_on(*_off(line, vertices, place[:1]), place[1:], line.within_mm)[0])
        for line, place in zip(lines, straight, strict=True)
    ]
    on_line = [_torch_is_on_line(setup, sight.T_base_tool) for sight in sights]
    reaches = sum(on_line) >= ENOUGH * len(on_line)
    return SectionMatch(float(np.mean(shares)) if shares and reaches else 0.0, tuple(lines))


def _torch_is_on_line(setup: Setup, T_base_tool: Float64) -> bool:
    """Return whether the torch is between the ends of the nominal line, True where no pose is known."""
    tip_mm = np.array(T_base_tool[:3, 3])
    if not np.isfinite(tip_mm).all():
        return True
    segments = SeamSegments.of(setup.joint)
    nearest = nearest_segment(segments, tip_mm)
    step = segments.steps[nearest]
    along = float((tip_mm - segments.starts[nearest]) @ step / (step @ step))
    return (nearest > 0 or along >= 0.0) and (nearest < len(segments.steps) - 1 or along <= 1.0)


def line_points(setup: Setup, sight: SightedLine) -> LinePoints:
    """Intersect a line with the laser plane, in joint coordinates, less a corrugation's height."""
    nothing = np.empty(0)
    if not np.isfinite(sight.T_base_tool).all():
        return LinePoints(nothing, nothing, math.nan, math.nan, 0)
    asked, source = FrameChecks(), SeamSource.of(setup)
    check_pose(asked, source, pose_numbers(source, np.require(sight.T_base_tool, np.float64, ("C", "W"))))
    points_px = sight.points_px[:: max(1, len(sight.points_px) // MAX_POINTS)]
    points_tool, beside_tool = (to_laser_plane(setup, points_px + step)[0] for step in (0.0, 1.0))
    met = np.isfinite(points_tool).all(axis=1) & np.isfinite(beside_tool).all(axis=1)
    if asked.flags or not met.any():
        return LinePoints(nothing, nothing, math.nan, math.nan, asked.flags)
    ahead_base = transform(sight.T_base_tool, setup.laser.point_mm)
    T_joint_tool = invert(seam_frame(setup.joint, ahead_base)) @ sight.T_base_tool
    x, y, z = transform(T_joint_tool, points_tool[met]).T
    moved_mm = np.abs(beside_tool[met] - points_tool[met]).max(axis=1)
    return LinePoints(
        y_mm=y,
        z_mm=z - corrugation_height(x, section(setup.joint).corrugation),
        station_mm=float(transform(T_joint_tool, setup.laser.point_mm)[0]),
        mm_per_px=float(np.median(moved_mm)),
        flags=0,
    )


def _off(line: LinePoints, vertices: Float64, y_mm: Float64) -> tuple[Float64, Float64]:
    """Return how far points (m,) lie above a section moved to `y_mm` (k,), and the cosine of its slope.

    Both are (k, m); NaN for a point that is not on the joint's width, and for all if they do not reach across
    it.
    """
    y = line.y_mm - y_mm[:, np.newaxis]
    run = np.diff(vertices[:, 0])
    # No point lies on an upright face.
    slope = np.divide(np.diff(vertices[:, 1]), run, out=np.zeros_like(run), where=run > 0.0)
    face = np.clip(np.searchsorted(vertices[:, 0], y) - 1, 0, len(run) - 1)
    off = line.z_mm - (vertices[face, 1] + slope[face] * (y - vertices[face, 0]))
    first, last = vertices[1, 0], vertices[-2, 0]
    beside = (y > first - BESIDE_MM) & (y < last + BESIDE_MM)
    across = (y < first - MIN_BEYOND_MM).any(axis=1) & (y > last + MIN_BEYOND_MM).any(axis=1)
    return np.where(beside & across[:, np.newaxis], off, np.nan), 1.0 / np.hypot(1.0, slope[face])


def _place(line: LinePoints, vertices: Float64) -> Float64:
    """Return the displacement (y, z), mm, that puts most points on the section; NaN where none does."""
    if not len(line.y_mm):
        return np.full(2, np.nan)
    y_mm = np.arange(-SEARCH_REACH_MM, SEARCH_REACH_MM + STEP_MM, STEP_MM)
    within_mm = line.within_mm
    off, cosine = _off(line, vertices, y_mm)
    n_bins = 2 * math.ceil(SEARCH_REACH_MM / within_mm)
    first_mm = -0.5 * n_bins * within_mm
    near = np.abs(np.nan_to_num(off, nan=math.inf)) < -first_mm
    bins = ((off[near] - first_mm) / within_mm).astype(np.int64).clip(0, n_bins - 1)
    flat = np.nonzero(near)[0] * n_bins + bins
    counts = np.bincount(flat, minlength=len(y_mm) * n_bins).reshape(len(y_mm), n_bins)
    # A peak may lie on two bins.
    z_mm = first_mm + within_mm * (1.0 + np.argmax(counts[:, :-1] + counts[:, 1:], axis=1))
    shares = _share_on(off, cosine, z_mm, within_mm)
    best = int(np.argmax(shares))
    return np.array([y_mm[best], z_mm[best]]) if shares[best] > 0.0 else np.full(2, np.nan)


def _share_on(off: Float64, cosine: Float64, z_mm: Float64, within_mm: float) -> Float64:
    """Return the share (k,) of the points within the joint's width on sections displaced upwards by (k,)."""
    known = np.isfinite(off)
    distance = np.abs(np.nan_to_num(off, nan=math.inf) - z_mm[:, np.newaxis]) * cosine
    count = known.sum(axis=1)
    return np.where(count >= MIN_POINTS, (distance < within_mm).sum(axis=1) / np.maximum(count, 1), 0.0)


def _straight(stations_mm: Float64, displacement_mm: Float64) -> Float64:
    """Return displacements (n, 2) on the straight line that the frames' own lie nearest to; NaN stay."""
    straight = np.full_like(displacement_mm, np.nan)
    known = np.isfinite(displacement_mm).all(axis=1)
    x, d = stations_mm[known], displacement_mm[known]
    best_cost = math.inf
    for i in range(len(x)):
        for j in range(i, len(x)):
            slope = (d[j] - d[i]) / (x[j] - x[i]) if abs(x[j] - x[i]) > 1.0 else np.zeros(2)
            if np.abs(slope).max() > STEEPEST:
                continue
            line = d[i] + slope * (x - x[i])[:, np.newaxis]
            cost = float(np.abs(d - line).sum(axis=1).clip(max=MAX_COST_MM).sum())
            if cost < best_cost:
                straight[known], best_cost = line, cost
    return straight
