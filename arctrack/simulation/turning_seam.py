"""A true seam that turns, rendered as tangents where a pose's camera looks.

A frame is rendered in the joint frame of the nominal path where the sheet cuts it. The seam there is a curve
y(x), z(x), which `BentSeam` draws as straight stretches of 2 mm or more. Where it turns with a radius R these
are off the swept section by 1 mm^2 / (2 R). A point w beside the seam, in a sheet that cuts it at an angle a
off square, is drawn by the stretch at its x: off by w^4 tan(a)^2 / (2 R^3). From R = 50 mm on both are 0.01
mm at most, 8 mm beside the seam of a tool that looks at it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from arctrack.simulation.programmed_path import ProgrammedPath
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import invert, transform

STEP_MM = 0.5
"""Spacing of the stations at which a seam's course is computed."""

BEHIND_MM, BEYOND_MM = 80.0, 60.0
"""Range of the stations about the sheet that a camera sees, and in which the torch stands."""

MIN_COSINE = 0.25
"""A seam that has turned farther from the tangent goes on straight: no camera looks there."""


@dataclass(frozen=True, eq=False)
class SeenSeam:
    """The true seam as a pose sees it, in a joint frame that is its own.

    `joint_setup` is the true setup with the nominal line of that frame, T_base_joint (4, 4); `line_at` gives
    the seam's tangent at a station of it.
    """

    joint_setup: Setup
    T_base_joint: Float64
    line_at: Callable[[float], SeamLine]


@dataclass(frozen=True, eq=False)
class TurningSeam:
    """A seam along a programmed path: displaced by (y, z) at each station, in the path's frame there, mm.

    The whole part lies off by `part_base_mm`.
    """

    path: ProgrammedPath
    displacement_mm: Callable[[float], tuple[float, float]]
    part_base_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def point_base(self, station_mm: float) -> Float64:
        """Return the seam's point (3,) at a station, base frame, mm."""
        y_mm, z_mm = self.displacement_mm(station_mm)
        on_path = transform(self.path.T_base_seam(station_mm), np.array([0.0, y_mm, z_mm]))
        return np.asarray(on_path + self.part_base_mm)

    def seen_from(self, setup: Setup, T_base_tool: Float64) -> SeenSeam:
        """Return the seam as a setup sees it from a pose (4, 4)."""
        sheet_mm = self.sheet_station_mm(setup, T_base_tool)
        T_base_joint = self.path.T_base_seam(sheet_mm)
        T_base_joint[:3, 3] -= sheet_mm * T_base_joint[:3, 0]
        stations_mm = sheet_mm + np.arange(-BEHIND_MM, BEYOND_MM, STEP_MM)
        points_base = np.array([self.point_base(float(station_mm)) for station_mm in stations_mm])
        course = transform(invert(T_base_joint), points_base)
        ways = np.gradient(course, axis=0)
        turned = ways[:, 0] < MIN_COSINE * np.linalg.norm(ways, axis=1)
        middle = int(np.searchsorted(stations_mm, sheet_mm))
        first = int(np.max(np.flatnonzero(turned[:middle]), initial=-1)) + 1
        last = middle + int(np.min(np.flatnonzero(turned[middle:]), initial=len(turned) - middle))
        x, y, z = course[first:last].T
        slope_y, slope_z = (ways[first:last, 1:] / ways[first:last, :1]).T

        def line_at(station_mm: float) -> SeamLine:
            inside_mm = min(max(station_mm, float(x[0])), float(x[-1]))
            y_mm, z_mm, *slopes = (float(np.interp(inside_mm, x, each)) for each in (y, z, slope_y, slope_z))
            beyond_mm = station_mm - inside_mm
            return SeamLine(station_mm, y_mm + slopes[0] * beyond_mm, z_mm + slopes[1] * beyond_mm, *slopes)

        ends_base = transform(T_base_joint, np.array([[-1000.0, 0.0, 0.0], [1000.0, 0.0, 0.0]]))
        start, end, normal, origin = (
            (float(u), float(v), float(w))
            for u, v, w in (*ends_base, T_base_joint[:3, 2], T_base_joint[:3, 3])
        )
        joint = replace(
            setup.joint,
            seam_in_base_mm=(start, end),
            surface_normal_in_base=normal,
            surface_normals_in_base=None,
            station_origin_mm=origin,
        )
        return SeenSeam(replace(setup, joint=joint), T_base_joint, line_at)

    def sheet_station_mm(self, setup: Setup, T_base_tool: Float64) -> float:
        """Return the station at which a pose's sheet cuts the path, nearest to where it is at tool height."""
        ahead_base = transform(T_base_tool, setup.laser.point_mm)
        normal_base = T_base_tool[:3, :3] @ setup.laser.plane[:3]
        stations_mm, points = self.path.dense
        beyond = (points - ahead_base) @ normal_base
        crossed = np.flatnonzero(beyond[:-1] * beyond[1:] <= 0.0)
        away_mm = np.linalg.norm(points - ahead_base, axis=1)
        if not len(crossed):
            return float(stations_mm[np.argmin(away_mm)])
        k = int(crossed[np.argmin(away_mm[crossed])])
        share = beyond[k] / (beyond[k] - beyond[k + 1]) if beyond[k] != beyond[k + 1] else 0.0
        return float(stations_mm[k] + share * (stations_mm[1] - stations_mm[0]))
