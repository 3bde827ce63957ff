"""The joint's surface: a cross-section drawn along the seam, raised by a corrugation where there is one.

Joint frame J: origin on the nominal seam line, at the foot of base's origin, x along travel, y to the left of
travel, z out of the workpiece. A section is a polyline in (y, z), its ends running on to infinity; a
corrugation adds c(x) to every height. Surfaces hide what is behind them from either side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64, Int64, Point
from noise_model.compiled.kernel import kernel
from noise_model.setup_keys import DIMENSIONS, OPTIONAL_DIMENSIONS
from noise_model.spelling import cure_for
from noise_model.transforms import cross

MAX_SECTION_POINTS = 32
"""Points of a taught section: the arc map has room for 40 faces (`noise_model.arc.scratch`)."""

REACH_MM = 1.0e4
"""Width of the plates on either side of the seam."""

MAY_BE_ZERO = ("root_gap_mm", "gap_mm")
"""The dimensions that may be 0; all others are above it."""

EDGE_STANDS_MM = 60.0
"""Height of an edge joint's two sheets over what they stand on: below what a sensor looks at."""

SAGITTA_MM, MAX_CHORDS = 0.01, 16
"""Largest error of the chords of a U's rounded root, up to a radius of 10 mm, and their number."""


@dataclass(frozen=True)
class Joint:
    """The joint as stated: its type, its dimensions and its nominal seam line.

    Parameters
    ----------
    type : str
        The joint's type, such as "v_groove".
    dimensions : mapping
        Dimensions by name, mm and degrees.
    seam_in_base_mm : tuple of tuples (3,)
        The nominal seam line's points along the travel, mm, base frame.
    surface_normal_in_base : tuple (3,)
        The surface's normal, out of the part, base frame.
    station_origin_mm : tuple (3,)
        A point of base, mm. Stations count from its foot on the seam's first segment.
    surface_normals_in_base : tuple of tuples (3,), optional
        The surface's normal at each point of the line, where it turns along the seam; between two points it
        is their mean.
    section_mm : tuple of tuples (2,)
        Of a `free` joint the section as taught: points (y, z), mm, y rising, the seam point at (0, 0).

    Raises
    ------
    ValueError
        For a value out of its range; it names the key.
    """

    type: str
    dimensions: Mapping[str, float]
    seam_in_base_mm: tuple[tuple[float, float, float], ...]
    surface_normal_in_base: tuple[float, float, float] = (0.0, 0.0, 1.0)
    station_origin_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    surface_normals_in_base: tuple[tuple[float, float, float], ...] | None = None
    section_mm: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if self.type not in DIMENSIONS:
            raise ValueError(
                f"[joint] type = {self.type!r}: there is no such joint; {cure_for(self.type, DIMENSIONS)}"
            )
        for name in DIMENSIONS[self.type]:
            if name not in self.dimensions:
                raise ValueError(f"[joint] {name}: missing, a {self.type} needs it")
        for name in self.dimensions.keys() & {
            *DIMENSIONS[self.type],
            *OPTIONAL_DIMENSIONS.get(self.type, ()),
        }:
            minimum_is_open = name not in MAY_BE_ZERO
            value = self.dimensions[name]
            if not (value > 0 if minimum_is_open else value >= 0) or math.isinf(value):
                bound = "> 0" if minimum_is_open else ">= 0"
                raise ValueError(f"[joint] {name} = {value}: must be {bound} and finite")
        self._check_section()
        faces = "v_groove", "outside_corner"
        if self.type in faces and not self.dimensions["included_angle_deg"] < 180:
            raise ValueError("[joint] included_angle_deg: must be below 180")
        if self.type == "fillet" and not self.dimensions["included_angle_deg"] < 360:
            raise ValueError("[joint] included_angle_deg: must be below 360")
        if self.type == "fillet" and self.dimensions["included_angle_deg"] == 180:
            raise ValueError("[joint] included_angle_deg = 180: two plates in one plane have no corner")
        is_outside = self.type == "fillet" and self.dimensions["included_angle_deg"] > 180
        if is_outside and self.dimensions.get("gap_mm", 0.0) > 0:
            raise ValueError("[joint] gap_mm: leave it out, only a fillet of less than 180 deg has a gap")
        if "bevel_angle_deg" in DIMENSIONS[self.type] and not self.dimensions["bevel_angle_deg"] < 90:
            raise ValueError("[joint] bevel_angle_deg: must be below 90")
        if self.type == "u_groove" and _round_height_mm(self.dimensions) > self.dimensions["depth_mm"]:
            raise ValueError("[joint] root_radius_mm: the rounded root is higher than depth_mm")
        if self.type == "corrugation" and self.dimensions["width_mm"] > self.dimensions["pitch_mm"]:
            raise ValueError("[joint] width_mm: a corrugation cannot be wider than its pitch_mm")
        points = np.asarray(self.seam_in_base_mm, dtype=np.float64)
        if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] != 3:
            raise ValueError("[joint] seam_in_base_mm: needs at least two points of x, y, z")
        if not np.isfinite(points).all():
            raise ValueError("[joint] seam_in_base_mm: holds a number that is not finite")
        if not (np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6).all():
            raise ValueError("[joint] seam_in_base_mm: two points of the line coincide")
        normal = np.asarray(self.surface_normal_in_base, dtype=np.float64)
        if not abs(float(np.linalg.norm(normal)) - 1.0) <= 1e-3:
            raise ValueError("[joint] surface_normal_in_base: its length is not 1")
        key, normals = "surface_normal_in_base", normal
        if self.surface_normals_in_base is not None:
            key, each = "surface_normals_in_base", np.asarray(self.surface_normals_in_base, dtype=np.float64)
            if each.shape != points.shape:
                raise ValueError(f"[joint] {key}: needs one normal for each point of seam_in_base_mm")
            if not (np.abs(np.linalg.norm(each, axis=1) - 1.0) <= 1e-3).all():
                raise ValueError(f"[joint] {key}: a length is not 1")
            normals = each[:-1] + each[1:]
        steps = np.diff(points, axis=0)
        if (np.linalg.norm(np.cross(steps, normals), axis=1) < 1e-3 * np.linalg.norm(steps, axis=1)).any():
            raise ValueError(f"[joint] {key}: is parallel to the seam line")

    def _check_section(self) -> None:
        """Raise ValueError for a free joint without a section, and for a section that cannot be."""
        if (self.type == "free") != bool(self.section_mm):
            cure = "missing, a free joint needs it" if self.type == "free" else "is of a free joint alone"
            raise ValueError(f"[joint] section_mm: {cure}")
        if not self.section_mm:
            return
        points = np.asarray(self.section_mm, dtype=np.float64)
        if not 3 <= len(points) <= MAX_SECTION_POINTS:
            raise ValueError(f"[joint] section_mm: needs 3 to {MAX_SECTION_POINTS} points y, z")
        if not np.isfinite(points).all() or not (np.diff(points[:, 0]) > 0.0).all():
            raise ValueError("[joint] section_mm: its points must be finite, their y rising")
        if not points[0, 0] < 0.0 < points[-1, 0]:
            raise ValueError("[joint] section_mm: must go from y < 0 to y > 0, the seam point is at y = 0")

    def __str__(self) -> str:
        size = ", ".join(f"{name} {value:g}" for name, value in self.dimensions.items())
        length_mm = np.linalg.norm(np.diff(np.asarray(self.seam_in_base_mm), axis=0), axis=1).sum()
        return f"{self.type}{': ' if size else ''}{size}; nominal seam {length_mm:.0f} mm long"

    @property
    def has_ridges(self) -> bool:
        """True if ridges run across the nominal seam line; they stay so when the seam between them turns."""
        return self.type == "corrugation"


class SurfaceSection(NamedTuple):
    """The surface's shape for the kernels.

    `vertices` is (n, 2) float64, the polyline's (y, z) in mm from y = -REACH to +REACH;
    `corrugation` is (3,) float64: height, width, pitch in mm, height 0 where there is none.
    """

    vertices: Float64
    corrugation: Float64


def section(joint: Joint) -> SurfaceSection:
    """Return a joint's cross-section as RECORDING.md draws it, seam point at y = 0.

    Beyond that format: `half_v` has an upright side at y < 0 and a bevelled one, `bevel_angle_deg` from
    upright; `u_groove` a flat root `root_gap_mm` wide, rounded by `root_radius_mm` up to its bevels; of both
    the seam point is the middle of the root. `edge`: two upright sheets of `thickness_mm` side by side, their
    edges level at z = 0, the seam point the middle of the gap between them. The foot of a
    `fillet`'s plate at y < 0 stands `gap_mm` off the other plate. One for all who ask: its arrays are not to
    be written to.
    """
    return _draw(joint.type, tuple(joint.dimensions.items()), joint.section_mm)


@lru_cache
def _draw(
    joint_type: str, dimensions: tuple[tuple[str, float], ...], taught_mm: tuple[tuple[float, float], ...]
) -> SurfaceSection:
    """Draw the cross-section of a type of joint: every look at a pose asks for it."""
    size = dict(dimensions)
    corrugation = np.zeros(3)
    if taught_mm:
        # Beyond its ends a taught section goes on as its end pieces do.
        taught = np.array(taught_mm, dtype=np.float64)
        (y, z), steps = taught[[0, -1]].T, taught[[1, -1]] - taught[[0, -2]]
        ends_y = np.array([-REACH_MM, REACH_MM])
        ends = np.column_stack([ends_y, z + steps[:, 1] / steps[:, 0] * (ends_y - y)])
        return SurfaceSection(np.vstack([ends[:1], taught, ends[1:]]), corrugation)
    if joint_type == "corrugation":
        corrugation[:] = size["height_mm"], size["width_mm"], size["pitch_mm"]
    inner = _CORNERS[joint_type](size)
    # Without a gap two corners meet.
    inner = [corner for i, corner in enumerate(inner) if i == 0 or corner != inner[i - 1]]
    slope, (right_y, right_z), (left_y, left_z) = _plate_slope(joint_type, size), inner[0], inner[-1]
    right_end = -REACH_MM, right_z + slope * (REACH_MM + right_y)
    left_end = REACH_MM, left_z + slope * (REACH_MM - left_y)
    return SurfaceSection(np.array([right_end, *inner, left_end], dtype=np.float64), corrugation)


Corners = list[tuple[float, float]]
Size = Mapping[str, float]


def _mirrored(right: Corners) -> Corners:
    """Return a section's corners (y, z) from those at y <= 0, y rising."""
    return right + [(-y, z) for y, z in reversed(right)]


def _v_groove(size: Size) -> Corners:
    half_gap, depth = size["root_gap_mm"] / 2.0, size["depth_mm"]
    half_mouth = half_gap + depth * math.tan(math.radians(size["included_angle_deg"] / 2.0))
    return _mirrored([(-half_mouth, 0.0), (-half_gap, -depth)])


def _half_v(size: Size) -> Corners:
    half_gap, depth = size["root_gap_mm"] / 2.0, size["depth_mm"]
    mouth = half_gap + depth * math.tan(math.radians(size["bevel_angle_deg"]))
    return [(-half_gap, 0.0), (-half_gap, -depth), (half_gap, -depth), (mouth, 0.0)]


def _round_height_mm(size: Size) -> float:
    """Return the height over a U's root at which the rounding goes over into the bevel."""
    return size["root_radius_mm"] * (1.0 - math.sin(math.radians(size["bevel_angle_deg"])))


def _u_groove(size: Size) -> Corners:
    """Draw the rounding as the polygon about it, whose first and last sides are the root and the bevel."""
    half_gap, depth, radius = size["root_gap_mm"] / 2.0, size["depth_mm"], size["root_radius_mm"]
    bevel = math.radians(size["bevel_angle_deg"])
    turn = 0.5 * math.pi - bevel
    chords = math.ceil(turn / (2.0 * math.acos(radius / (radius + SAGITTA_MM))))
    step = turn / min(max(chords, 1), MAX_CHORDS)
    reach = radius / math.cos(0.5 * step)
    angles = np.arange(0.5 * step, turn, step)
    left_side = [(half_gap + reach * math.sin(a), radius - depth - reach * math.cos(a)) for a in angles]
    over = depth - _round_height_mm(size)
    left_side.append((half_gap + radius * math.cos(bevel) + over * math.tan(bevel), 0.0))
    return _mirrored([(-y, z) for y, z in reversed(left_side)])


def _slot(size: Size, depth_mm: float) -> Corners:
    half_gap = size["gap_mm"] / 2.0
    return _mirrored([(-half_gap, 0.0), (-half_gap, -depth_mm)]) if half_gap > 0.0 else [(0.0, 0.0)]


def _edge(size: Size) -> Corners:
    outer = -size["gap_mm"] / 2.0 - size["thickness_mm"]
    side = [(outer, -EDGE_STANDS_MM), (outer, 0.0)]
    return [*side, *_slot(size, EDGE_STANDS_MM), *_mirrored(side)[2:]]


def _lap(size: Size) -> Corners:
    return [(0.0, size["thickness_mm"]), (0.0, 0.0)]


def _fillet(size: Size) -> Corners:
    """Draw the foot of the plate at y < 0 over the other plate, which goes on below it."""
    half = math.radians(size["included_angle_deg"] / 2.0)
    gap = size.get("gap_mm", 0.0)
    foot_y, foot_z = -0.5 * gap / math.cos(half), 0.5 * gap / math.sin(half)
    return [(foot_y, foot_z), (foot_y, -foot_z)] if gap > 0.0 else [(0.0, 0.0)]


_CORNERS: Mapping[str, Callable[[Size], Corners]] = {
    "flat": lambda size: [(0.0, 0.0)],
    "v_groove": _v_groove,
    "lap": _lap,
    "corrugation": _lap,
    "butt": lambda size: _slot(size, size["thickness_mm"]),
    "fillet": _fillet,
    "half_v": _half_v,
    "u_groove": _u_groove,
    "edge": _edge,
    "outside_corner": lambda size: [(0.0, 0.0)],
}
"""Each type's corners between its two plates, (y, z) in mm, y rising."""


def _plate_slope(joint_type: str, size: Size) -> float:
    """Return the slope of the plates away from the seam: a fillet's rise, or fall."""
    if joint_type == "outside_corner":
        return -1.0 / math.tan(math.radians(size["included_angle_deg"] / 2.0))
    if joint_type != "fillet":
        return 0.0
    return 1.0 / math.tan(math.radians(size["included_angle_deg"] / 2.0))


class SeamLine(NamedTuple):
    """Course of the true seam relative to its nominal line: a straight stretch about one station.

    At `station_mm` of the joint frame it lies `y_mm` to the left and `z_mm` higher, and it leaves the nominal
    direction by `slope_y` = dy/dx and `slope_z` = dz/dx, which are known to 1 sigma of `slope_sigma`.
    """

    station_mm: float = 0.0
    y_mm: float = 0.0
    z_mm: float = 0.0
    slope_y: float = 0.0
    slope_z: float = 0.0
    slope_sigma: float = 0.0

    def frame(self) -> Float64:
        """Return T_nominal_true (4, 4), mm: the joint frame turned about the station, moved to the seam."""
        return line_frame(self.as_floats())

    def as_floats(self) -> SeamLine:
        """Return the stretch with numbers of one type: for others the kernels would be compiled anew."""
        return SeamLine(*map(float, self))


@kernel(allocates=True)
def line_frame(line: SeamLine) -> Float64:
    """Return `SeamLine.frame`: its x axis is (1, a, b) / length, its y axis lies level."""
    a, b, x = line.slope_y, line.slope_z, line.station_mm
    level = math.sqrt(1.0 + a * a)
    length = math.sqrt(1.0 + a * a + b * b)
    T = np.zeros((4, 4))
    T[0, 0], T[0, 1], T[0, 2], T[0, 3] = 1.0 / length, -a / level, -b / (length * level), x - x / length
    T[1, 0], T[1, 1], T[1, 2] = a / length, 1.0 / level, -a * b / (length * level)
    T[2, 0], T[2, 2] = b / length, level / length
    T[1, 3], T[2, 3], T[3, 3] = line.y_mm - x * a / length, line.z_mm - x * b / length, 1.0
    return T


NOMINAL_SEAM = SeamLine()

STRETCH_TURNS, STRETCH_MM = 0.003, 2.0
"""Change of slope of a bent seam from one straight stretch to the next, and the least length of these."""

STRETCH_ASIDE_MM = 0.1
"""Largest lateral step to the next stretch where ridges keep stretches from turning."""

GRID_MM = 1.0
"""Stations at which it is seen how much a seam turns."""


@dataclass(frozen=True)
class BentSeam:
    """A seam that bends: straight stretches, each of which stands for what lies nearest to its station.

    `lines` come in rising order of their stations. The arc stands on the plate of `ground`, and by its seam.
    """

    lines: tuple[SeamLine, ...]
    ground: SeamLine

    def __post_init__(self) -> None:
        stations = [line.station_mm for line in self.lines]
        if not stations or (np.diff(stations) <= 0.0).any():
            raise ValueError("a bent seam needs stretches in rising order of their stations")

    @classmethod
    def along(
        cls,
        line_at: Callable[[float], SeamLine],
        seen_mm: tuple[float, float],
        torch_mm: float,
        has_ridges: bool,
    ) -> BentSeam:
        """Return a seam from one station to another as straight stretches, its tangents at their middles, mm.

        `line_at` gives the tangent at a station. The arc stands on the plate where the torch is.
        """
        first, last = seen_mm
        lines = [line_at(float(station)) for station in np.arange(first, last + GRID_MM, GRID_MM)]
        turns = max(np.ptp([(line.slope_y, line.slope_z) for line in lines], axis=0)) / STRETCH_TURNS
        if has_ridges:
            turns = max(turns, np.ptp([line.y_mm for line in lines]) / STRETCH_ASIDE_MM)
        count = max(1, min(1 + int(turns), round((last - first) / STRETCH_MM)))
        return cls.in_stretches(line_at, seen_mm, torch_mm, count)

    @classmethod
    def in_stretches(
        cls, line_at: Callable[[float], SeamLine], seen_mm: tuple[float, float], torch_mm: float, count: int
    ) -> BentSeam:
        """Return the same in so many stretches."""
        *stretches, ground = map(line_at, stretch_stations_mm(seen_mm, torch_mm, count).tolist())
        return cls.over_ground(stretches, ground)

    @classmethod
    def over_ground(cls, stretches: Iterable[SeamLine], tangent: SeamLine) -> BentSeam:
        """Return the seam of some stretches; `tangent` is that at the torch, where the arc stands."""
        return cls(tuple(stretches), SeamLine(*tangent[:3]))

    @property
    def middle(self) -> SeamLine:
        """The stretch in the middle."""
        return self.lines[len(self.lines) // 2]

    def stretch_at(self, stations_mm: Float64) -> Int64:
        """Return the index of the stretch that stands for each station (...,); the middle's for a NaN."""
        stations = np.array([line.station_mm for line in self.lines])
        index = np.searchsorted(0.5 * (stations[1:] + stations[:-1]), stations_mm)
        return np.where(np.isnan(stations_mm), len(self.lines) // 2, index)


def stretch_stations_mm(seen_mm: tuple[float, float], torch_mm: float, count: int) -> Float64:
    """Return the stations (count + 1,), mm, of stretches between two stations, and last the torch's."""
    step = (seen_mm[1] - seen_mm[0]) / count
    return np.append(seen_mm[0] + step * (np.arange(count) + 0.5), torch_mm)


Seam = SeamLine | BentSeam
"""Course of the true seam."""


def seam_height_mm(joint: Joint) -> float:
    """Return the height of the seam point over the reference surface: the root of a groove, else 0."""
    return -joint.dimensions["depth_mm"] if "depth_mm" in DIMENSIONS[joint.type] else 0.0


def corrugation_height(x_mm: Float64, corrugation: Float64) -> Float64:
    """Return c(x) = height/2 (1 + cos(2 pi u / width)) for |u| < width/2, u = x to the nearest pitch; mm."""
    height, width, pitch = corrugation
    if height == 0.0:
        return np.zeros_like(np.asarray(x_mm, dtype=np.float64))
    u = x_mm - pitch * np.rint(x_mm / pitch)
    return np.where(np.abs(u) < width / 2.0, height / 2.0 * (1.0 + np.cos(2.0 * np.pi * u / width)), 0.0)


class SeamSegments(NamedTuple):
    """A nominal seam's segments: T_base_joint (n, 4, 4), where each starts and its way (n, 3), base, mm."""

    frames: Float64
    starts: Float64
    steps: Float64

    @classmethod
    def of(cls, joint: Joint) -> SeamSegments:
        """Return a joint's segments: one record for all who ask, it is not to be written to."""
        normals = joint.surface_normals_in_base or (joint.surface_normal_in_base,)
        return _segments(joint.seam_in_base_mm, normals, joint.station_origin_mm)


@kernel
def nearest_segment(segments: SeamSegments, point_base_mm: Float64) -> int:
    """Return the number of the segment nearest to a point (3,) of base."""
    _, starts, steps = segments
    nearest, min_distance = 0, math.inf
    for k in range(starts.shape[0]):
        along, square = 0.0, 0.0
        for i in range(3):
            along += (point_base_mm[i] - starts[k, i]) * steps[k, i]
            square += steps[k, i] * steps[k, i]
        share = min(max(along / square, 0.0), 1.0)
        away = 0.0
        for i in range(3):
            away += (point_base_mm[i] - starts[k, i] - share * steps[k, i]) ** 2
        if away < min_distance:
            nearest, min_distance = k, away
    return nearest


@kernel(allocates=True)
def crossed_segment(
    segments: SeamSegments, T_base_tool: Float64, plane_tool: Float64, ahead_mm: Float64
) -> int:
    """Return the number of the segment that a sheet (4,), tool frame, cuts nearest to a point (3,) of it.

    Of a sheet that cuts none, it is the segment nearest to that point. On a seam that turns these differ: the
    seam lies beside the tool's axis, and the sheet reaches it on a later segment.
    """
    _, starts, steps = segments
    T, n, ahead = T_base_tool, np.zeros(3), np.zeros(3)
    for i in range(3):
        ahead[i] = T[i, 3]
        for j in range(3):
            n[i] += T[i, j] * plane_tool[j]
            ahead[i] += T[i, j] * ahead_mm[j]
    crossed, min_distance = -1, math.inf
    for k in range(starts.shape[0] if starts.shape[0] > 1 else 0):
        off, towards, away = 0.0, 0.0, 0.0
        for i in range(3):
            off += n[i] * (ahead[i] - starts[k, i])
            towards += n[i] * steps[k, i]
        share = off / towards if towards != 0.0 else -1.0
        if 0.0 <= share <= 1.0:
            for i in range(3):
                away += (ahead[i] - starts[k, i] - share * steps[k, i]) ** 2
            if away < min_distance:
                crossed, min_distance = k, away
    return crossed if crossed >= 0 else nearest_segment(segments, ahead)


def seam_frame(joint: Joint, point_base_mm: Float64) -> Float64:
    """Return T_base_joint of the line segment nearest to a point of base.

    Its x is the station, counted along the segments: along the first as base's does, from the foot of base's
    origin, so that a corrugation keeps its place, and on from there through every bend.
    """
    point = np.require(point_base_mm, np.float64, ("C", "W"))
    segments = SeamSegments.of(joint)
    return np.array(segments.frames[nearest_segment(segments, point)])


@lru_cache
def _segments(
    seam_in_base_mm: tuple[Point, ...], normals_in_base: tuple[Point, ...], station_origin_mm: Point
) -> SeamSegments:
    """Return the segments of a seam line, with one normal or one for each of its points.

    Every look at a pose asks for them.
    """
    points = np.asarray(seam_in_base_mm, dtype=np.float64)
    normals = np.broadcast_to(np.asarray(normals_in_base, dtype=np.float64), points.shape)
    if len(normals_in_base) > 1:
        normals = normals[:-1] + normals[1:]
    frames: list[Float64] = []
    station = 0.0
    for start, step, normal in zip(points[:-1], np.diff(points, axis=0), normals, strict=False):
        length = float(np.linalg.norm(step))
        x_axis = step / length
        if not frames:
            station = (start - station_origin_mm) @ x_axis
        y_axis = cross(normal, x_axis)
        y_axis /= np.linalg.norm(y_axis)
        T_base_joint = np.eye(4)
        T_base_joint[:3, :3] = np.transpose([x_axis, y_axis, cross(x_axis, y_axis)])
        T_base_joint[:3, 3] = start - station * x_axis
        frames.append(T_base_joint)
        station += length
    return SeamSegments(np.array(frames), points[:-1].copy(), np.diff(points, axis=0))
