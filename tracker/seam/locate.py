"""Place of a seam that was seen.

Of some numbers Python's own are quicker than arrays: matrices are lists here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noise_model.arc.scene import Scene, SceneSource
from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from noise_model.instrument.laser import Sheet, sheet_in_tool, tangent_plane
from noise_model.setup import Setup
from noise_model.surface.faces import ridge
from noise_model.surface.joint import SeamLine, crossed_segment, nearest_segment, seam_height_mm, section
from noise_model.transforms import invert, transform
from tracker.seam.gaussian_process import WIDE_SIGMA_MM, SeamHistory, SeamPrediction, condition
from tracker.seam.joint_ends import nominal_ends
from tracker.seam.line_directions import EDGE_MM, PLATE_MM, LineDirections
from tracker.state import Y_MM, Z_MM

MIN_CROSSING = 0.3
"""The least cosine between the sheet's normal and the seam: below, it shows no section of the joint."""

MAX_STEPS, MET_MM = 80, 1e-9
"""Steps by which the sheet is met along a corrugated seam at most, and how near to it is on it."""

Point = Sequence[float]
Matrix = Sequence[Sequence[float]]
Plane = tuple[float, float, float, float]


class SeamSource(NamedTuple):
    """Part of the seam that a setup fixes.

    `scene` is of its scenes. `T_base_joint` and `T_joint_base` (4, 4) are of the nominal line's segments,
    `ends_mm` its ends' stations, `line` its directions. `origin_mm`, `plane` and `sheet` are the laser's,
    `ahead_mm` is where its sheet is at tool height, all in the tool frame. `height_mm` is the seam point's
    over the reference surface; `weld_mm` is the weld's tolerance.
    """

    scene: SceneSource
    T_base_joint: tuple[Matrix, ...]
    T_joint_base: tuple[Float64, ...]
    ends_mm: tuple[float, float]
    line: LineDirections
    origin_mm: Point
    plane: Plane
    sheet: Sheet
    ahead_mm: Point
    height_mm: float
    weld_mm: float

    @classmethod
    def of(cls, setup: Setup) -> SeamSource:
        """Gather a setup."""
        laser, scene = setup.laser, SceneSource.of(setup)
        frames = scene.segments.frames
        return cls(
            scene=scene,
            T_base_joint=tuple(frames.tolist()),
            T_joint_base=tuple(map(invert, frames)),
            ends_mm=nominal_ends(scene.segments),
            line=LineDirections.of(scene.segments),
            origin_mm=laser.origin_mm.tolist(),
            plane=tuple(laser.plane.tolist()),
            sheet=sheet_in_tool(laser),
            ahead_mm=laser.point_mm.tolist(),
            height_mm=seam_height_mm(setup.joint),
            weld_mm=setup.tolerance.seam_mm,
        )

    def plane_at(self, point_tool_mm: Point) -> Plane:
        """Return the plane that touches the sheet at a point (3,) of it, tool frame."""
        if self.sheet.bow == 0.0:
            return self.plane
        x, y, z = point_tool_mm
        return tangent_plane(self.sheet, (x, y, z))

    def seam_at(self, history: SeamHistory, station_mm: float) -> SeamPrediction:
        """Return the seam at a station as a history's measurements leave it."""
        seam: SeamPrediction = condition(history, self.line, float(station_mm))
        return seam

    def line_at(
        self, history: SeamHistory, segment: int, station_mm: float
    ) -> tuple[SeamLine, tuple[float, float]]:
        """Return the seam as a straight stretch about a station of a segment, and 1 sigma of y and z, mm."""
        there = self.seam_at(history, station_mm)
        (slope_y, slope_z), (lean_y, lean_z) = there.slope, self.lean(segment, station_mm)
        slopes = slope_y + lean_y, slope_z + lean_z
        line = SeamLine(float(station_mm), *there.displacement_mm, *slopes, max(there.slope_sigma))
        return line, there.sigma_mm

    def turn_mm(self, station_mm: float, crossing: float) -> float:
        """Return 1 sigma of a section that is straightened by a seam's turn, mm; 0 where it turns evenly.

        A part that lies off along the travel turns before its line or behind it. `crossing` is the cosine
        between the sheet's normal and the seam.
        """
        if len(self.T_base_joint) == 1:
            return 0.0
        before, here, behind = (
            self.line.sagitta_mm(station_mm + off_mm, self.aside_mm, max(crossing, MIN_CROSSING))
            for off_mm in (-WIDE_SIGMA_MM, 0.0, WIDE_SIGMA_MM)
        )
        return max(abs(before - here), abs(behind - here))

    @property
    def aside_mm(self) -> float:
        """Largest distance from a seam that turns at which its joint is read."""
        corners = self.scene.shape.vertices[1:-1, 0]
        return max(float(np.abs(corners).max()) + EDGE_MM, PLATE_MM)

    def lean(self, segment: int, station_mm: float) -> tuple[float, float]:
        """Return the slopes dy/dx and dz/dx of a line that turns against its segment, at a station."""
        if len(self.T_base_joint) == 1:
            return 0.0, 0.0
        x, y, z = self.T_joint_base[segment][:3, :3] @ self.line.forward(station_mm)
        return float(y / x), float(z / x)

    def segment_near(self, point_base_mm: Point) -> int:
        """Return the number of the segment nearest to a point (3,) of base."""
        if len(self.T_base_joint) == 1:
            return 0
        return int(nearest_segment(self.scene.segments, np.array(point_base_mm)))

    def segment_crossed(self, T_base_tool: Float64) -> int:
        """Return the number of the segment that the sheet of a pose (4, 4) cuts."""
        if len(self.T_base_joint) == 1:
            return 0
        scene = self.scene
        return int(crossed_segment(scene.segments, T_base_tool, scene.sheet, scene.ahead_mm))


def moved_by(T: Matrix, point: Point) -> list[float]:
    """Return a point (3,) of a pose's own frame in the other frame."""
    x, y, z = point
    return [a * x + b * y + c * z + d for a, b, c, d in T[:3]]


def ridge_mm(x_mm: float, corrugation: Float64) -> float:
    """Return the corrugation's height at a station, mm; a plain joint's is 0."""
    return ridge(x_mm, corrugation)[0] if corrugation[0] > 0.0 else 0.0


def sources(source: SeamSource, scene: Scene, station_mm: float) -> tuple[Float64, Float64]:
    """Return the places of camera and laser, (3,) mm, x from a station where the tangent plane is levelled.

    That is a corrugation's.
    """
    corrugation = scene.shape.corrugation
    here = ridge_mm(station_mm, corrugation)
    tangent = ridge_mm(station_mm + 0.5, corrugation) - ridge_mm(station_mm - 0.5, corrugation)
    camera_mm = scene.T_joint_camera[:3, 3].copy()
    laser_mm = np.array(moved_by(scene.T_joint_tool.tolist(), source.origin_mm))
    for place_mm in (camera_mm, laser_mm):
        place_mm[0] -= station_mm
        place_mm[2] -= here + tangent * place_mm[0]
    return camera_mm, laser_mm


def seam_point(source: SeamSource, T: Matrix, corrugation: Float64, y: float, z: float) -> list[float]:
    """Return the point (3,), tool frame, where the seam through (y, z) of the joint frame meets the sheet.

    `z` counts from a corrugation's own height, which is added at the station that is found. `T` is
    T_joint_tool.
    """
    point = _meet_plane(source, source.plane, T, corrugation, y, z)
    # As a ray meets it, see `plane_met`.
    for _ in range(2 if source.sheet.bow != 0.0 else 0):
        point = _meet_plane(source, source.plane_at(point), T, corrugation, y, z)
    return point


def _meet_plane(
    source: SeamSource, plane: Plane, T: Matrix, corrugation: Float64, y: float, z: float
) -> list[float]:
    n_x, n_y, n_z, n_d = plane
    (a, b, c, u), (d, e, f, v), (g, h, k, w), _ = T
    nx, ny, nz = a * n_x + b * n_y + c * n_z, d * n_x + e * n_y + f * n_z, g * n_x + h * n_y + k * n_z
    x = -(ny * y + nz * z + (n_d - nx * u - ny * v - nz * w)) / nx
    if corrugation[0] > 0.0:
        x = meet_ridges(moved_by(T, source.ahead_mm)[0], x, nz / nx, corrugation)
        z += ridge_mm(x, corrugation)
    x, y, z = x - u, y - v, z - w
    return [a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + k * z]


@kernel
def meet_ridges(start: float, of_valley: float, lean: float, corrugation: Float64) -> float:
    """Return the intersection of a sheet with a seam over ridges, by Newton's steps from a start.

    It meets the valleys' height at `of_valley`, and `lean` earlier for each mm of height. A step that leaves
    the bracket, or is more than half of the one before, halves the bracket instead (Press et al. 2007,
    Numerical Recipes, Section 9.4): Newton's alone may go to and fro between a crest and a valley.
    """
    # Between where it meets the valleys' height and where the ridges' the sheet meets the seam, or thrice.
    of_ridge = of_valley - lean * corrugation[0]
    low, high = min(of_valley, of_ridge), max(of_valley, of_ridge)
    x, before = min(max(start, low), high), math.inf
    for _ in range(MAX_STEPS):
        height, slope = ridge(x, corrugation)
        beyond = x - of_valley + lean * height
        low, high = (low, x) if beyond > 0.0 else (x, high)
        met = x - beyond / (1.0 + lean * slope)
        if not (low <= met <= high and abs(met - x) < 0.5 * before):
            met = 0.5 * (low + high)
        before = abs(met - x)
        x = met
        if before < MET_MM:
            break
    return float(x)


def seam_displacement(setup: Setup, T_joint_tool: Float64, seam_tool: Float64) -> tuple[float, Float64]:
    """Return the station of a seam point (3,), tool frame, and its displacement (2,) from the path, mm."""
    station, y, z = transform(T_joint_tool, seam_tool)
    height = seam_height_mm(setup.joint) + ridge_mm(station, section(setup.joint).corrugation)
    return float(station), np.array([y, z - height])


def confidence(weld_mm: float, sigma_y_mm: float, sigma_z_mm: float) -> float:
    """Return the probability that errors of these 1 sigmas, mm, both stay within the weld's tolerance, mm.

    NaN where either is NaN.
    """
    within, probability = weld_mm / math.sqrt(2.0), 1.0
    for sigma in (sigma_y_mm, sigma_z_mm):
        if sigma != 0.0:
            probability *= math.erf(within / sigma)
    return probability


def straightened(
    source: SeamSource, scene: Scene, station_mm: float, reach_mm: float, points: Float64
) -> Float64:
    """Return a section's points (N_ROWS, n) as on a seam that does not turn, those near the joint alone.

    They lie on a scene's sheet, in its joint frame, which touches the seam at `station_mm`; the joint is
    within `reach_mm` of it. Farther out plates of a seam that turns depend on how it leans, unknown at first.
    """
    if len(source.T_base_joint) == 1:
        return points
    R, place_mm = scene.T_joint_tool[:3, :3], scene.T_joint_tool[:3, 3]
    n_x, n_y, n_z = normal = R @ source.plane[:3]
    off_mm = source.plane[3] - normal @ place_mm
    x_mm = -(n_y * points[Y_MM] + n_z * points[Z_MM] + off_mm) / n_x
    y_z_mm = source.line.straightened(station_mm, x_mm - station_mm, points[Y_MM], points[Z_MM])
    near = np.abs(y_z_mm[0]) <= reach_mm + source.aside_mm
    # Of all frames the same layout: kernels are compiled for it.
    kept = np.compress(near, points, axis=1)
    kept[Y_MM], kept[Z_MM] = y_z_mm[:, near]
    return kept


class LocatedSeam(NamedTuple):
    """A seam point: in the tool frame, mm, its station, and its displacement from the path as (y, z), mm.

    `segment` is the nominal line's nearest, by which station and displacement are counted.
    """

    seam_tool_mm: tuple[float, float, float]
    segment: int
    station_mm: float
    displacement_mm: tuple[float, float]


def locate(source: SeamSource, T_base_tool: Float64, scene: Scene, y_mm: float, z_mm: float) -> LocatedSeam:
    """Return the seam point at (y, z) of a look's frame, seen from a pose (4, 4)."""
    corrugation = scene.shape.corrugation
    px, py, pz = point = seam_point(source, scene.T_joint_tool.tolist(), corrugation, y_mm, z_mm)
    segment = source.segment_near(moved_by(T_base_tool.tolist(), point))
    T_nominal_tool = source.T_joint_base[segment] @ T_base_tool
    station, y, z = moved_by(T_nominal_tool.tolist(), point)
    height = source.height_mm + ridge_mm(station, corrugation)
    return LocatedSeam((px, py, pz), segment, station, (y, z - height))
