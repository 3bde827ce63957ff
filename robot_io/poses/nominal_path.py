"""Tool position relative to the nominal path: station along it, to its left, above it."""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class PathPlace:
    """A point in the path's own coordinates.

    `station_mm` is the arc length along the path, negative before its start; `lateral_mm` is to the left of
    the travel, `height_mm` out of the workpiece, `segment` the nearest piece.
    """

    station_mm: float
    lateral_mm: float
    height_mm: float
    segment: int


@dataclass(frozen=True)
class _Segment:
    start: Vector
    along: Vector
    left: Vector
    up: Vector
    station_mm: float
    length_mm: float


@dataclass(frozen=True)
class NominalPath:
    """The nominal seam as a polyline along the travel, base frame.

    `normal_base` is the surface's normal, out of the workpiece. Where it turns along the path `normals_base`
    has one for each point; a piece takes the mean of its two. Raises ValueError if there are fewer than two
    points, two neighbours coincide, or a normal runs along the path.
    """

    points_base_mm: tuple[Vector, ...]
    normal_base: Vector = (0.0, 0.0, 1.0)
    normals_base: tuple[Vector, ...] | None = None

    def __post_init__(self) -> None:
        if len(self.points_base_mm) < 2:
            raise ValueError("nominal path: needs at least two points")
        if not all(math.dist(a, b) > 1e-6 for a, b in pairwise(self.points_base_mm)):
            raise ValueError("nominal path: two neighbouring points coincide, or are not finite")
        if self.normals_base is not None and len(self.normals_base) != len(self.points_base_mm):
            raise ValueError("nominal path: needs one normal for each point")
        steps = [unit(minus(b, a)) for a, b in pairwise(self.points_base_mm)]
        pairs = zip(self._normals, steps, strict=True)
        if not all(math.hypot(*cross(normal, step)) > 1e-3 for normal, step in pairs):
            raise ValueError("nominal path: the surface's normal runs along it")

    @property
    def _normals(self) -> tuple[Vector, ...]:
        if self.normals_base is None:
            return (self.normal_base,) * (len(self.points_base_mm) - 1)
        return tuple(unit((a[0] + b[0], a[1] + b[1], a[2] + b[2])) for a, b in pairwise(self.normals_base))

    @cached_property
    def segments(self) -> tuple[_Segment, ...]:
        """The path's straight pieces."""
        pieces = []
        station_mm = 0.0
        for (start, end), normal in zip(pairwise(self.points_base_mm), self._normals, strict=True):
            length_mm = math.dist(start, end)
            along = unit(minus(end, start))
            left_side = unit(cross(normal, along))
            pieces.append(_Segment(start, along, left_side, cross(along, left_side), station_mm, length_mm))
            station_mm += length_mm
        return tuple(pieces)

    @property
    def length_mm(self) -> float:
        """The path's length, mm."""
        last = self.segments[-1]
        return last.station_mm + last.length_mm

    def place(self, point_base_mm: Vector) -> PathPlace:
        """Return a point (3,), mm, base frame, in coordinates of the nearest piece."""
        segments = self.segments
        nearest = 0
        if len(segments) > 1:
            nearest = min(range(len(segments)), key=lambda n: _distance_mm(segments[n], point_base_mm))
        segment = segments[nearest]
        offset = minus(point_base_mm, segment.start)
        return PathPlace(
            segment.station_mm + dot(offset, segment.along),
            dot(offset, segment.left),
            dot(offset, segment.up),
            nearest,
        )

    def segments_near(self, point_base_mm: Vector, within_mm: float) -> tuple[_Segment, ...]:
        """Return the pieces that are farther than the nearest by no more than a distance, mm."""
        if len(self.segments) == 1:
            return self.segments
        distances_mm = [_distance_mm(segment, point_base_mm) for segment in self.segments]
        limit_mm = min(distances_mm) + within_mm
        return tuple(s for s, d in zip(self.segments, distances_mm, strict=True) if d <= limit_mm)


def _distance_mm(segment: _Segment, point: Vector) -> float:
    offset = minus(point, segment.start)
    station_mm = min(max(dot(offset, segment.along), 0.0), segment.length_mm)
    return math.dist(offset, times(station_mm, segment.along))


def minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def times(factor: float, a: Vector) -> Vector:
    """Return a vector times a factor."""
    return (factor * a[0], factor * a[1], factor * a[2])


def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def unit(a: Vector) -> Vector:
    """Return a vector's direction."""
    return times(1.0 / math.hypot(*a), a)
