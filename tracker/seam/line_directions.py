"""Directions of a nominal line along its stations, and sections as they are where the line does not turn."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import SeamSegments
from noise_model.transforms import invert, transform

TURN_OVER_MM = 2.0
"""Longest way before and behind a point of the line over which it turns there; a short piece's half is less.

An arc is stated by its chords, and turns all along them. A chord of 4 mm is off a circle of 50 mm by 0.04 mm.
"""

EDGE_MM, PLATE_MM = 3.0, 8.0
"""Width on either side of a joint's edges over which its plates are read, and least width beside the seam.

A seam that leans by 0.05 raises a plate 8 mm beside a circle of 50 mm, cut 20 deg askew, by 0.02 mm.
"""
COURSE_MM, COURSE_STEP_MM, FOOT_STEPS = 20.0, 0.5, 3
"""Reach and spacing of the course by which a section is straightened, and Newton's steps to a point's foot.

The third step moves a point 10 mm beside a circle of 50 mm by 1e-4 mm.
"""

MIN_PACE = 0.3
"""No nearer to the centre of a turn than this share of its radius a point has a foot."""


class LineDirections(NamedTuple):
    """Directions of a nominal line: left and up (k, 2, 3), base frame, at stations (k,), rising."""

    stations_mm: Float64
    axes_base: Float64

    @classmethod
    def of(cls, segments: SeamSegments) -> LineDirections:
        """Return a line's: constant along its pieces, but for where they meet."""
        # In the layout of STRAIGHT: kernels are compiled for it.
        axes = np.ascontiguousarray(segments.frames[:, :3, 1:3].transpose(0, 2, 1))
        lengths_mm = np.linalg.norm(segments.steps, axis=1)
        start_mm = float(transform(invert(segments.frames[0]), segments.starts[0])[0])
        meets_mm = start_mm + np.cumsum(lengths_mm)[:-1]
        half_mm = np.minimum(0.5 * np.minimum(lengths_mm[:-1], lengths_mm[1:]), TURN_OVER_MM)
        stations_mm = np.column_stack([meets_mm - half_mm, meets_mm + half_mm]).ravel()
        around = np.stack([axes[:-1], axes[1:]], axis=1).reshape(-1, 2, 3)
        return cls(np.array([start_mm, *stations_mm]), np.concatenate([axes[:1], around]))

    def at(self, stations_mm: Float64) -> Float64:
        """Return left and up (n, 2, 3), base frame, at stations (n,)."""
        axes = self.axes_base.reshape(-1, 6).T
        turned = np.array([np.interp(stations_mm, self.stations_mm, axis) for axis in axes])
        return turned.T.reshape(-1, 2, 3)

    def forward(self, station_mm: float) -> Float64:
        """Return the direction of travel (3,), base frame, at a station."""
        way = np.cross(*self.at(np.array([station_mm]))[0])
        return np.asarray(way / np.linalg.norm(way))

    def sagitta_mm(self, station_mm: float, aside_mm: float, crossing: float) -> float:
        """Return how far the line leaves its tangent where a sheet shows the joint, mm.

        The joint reaches `aside_mm` to either side; the sheet cuts the seam at a cosine of `crossing`.
        """
        way_mm = aside_mm * math.sqrt(max(1.0 - crossing**2, 0.0)) / crossing
        before, behind = self.at(np.array([station_mm - way_mm, station_mm + way_mm]))
        return 0.25 * way_mm * float(np.linalg.norm(behind - before, axis=1).max())

    def course(self, station_mm: float, along_mm: Float64) -> Float64:
        """Return point, way, left and up of the line as rows (n, 12), at distances from a station, mm.

        The distances (n,) are evenly spaced about 0. All are in the frame on the line at the station.
        """
        axes = self.at(station_mm + along_mm)
        ways = np.cross(axes[:, 0], axes[:, 1])
        ways /= np.linalg.norm(ways, axis=1)[:, np.newaxis]
        middle = len(along_mm) // 2
        own = np.stack([ways[middle], *axes[middle]])
        steps = 0.5 * (along_mm[1] - along_mm[0]) * (ways[1:] + ways[:-1])
        points = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        return np.hstack(
            [(points - points[middle]) @ own.T, ways @ own.T, axes[:, 0] @ own.T, axes[:, 1] @ own.T]
        )

    def straightened(self, station_mm: float, x_mm: Float64, y_mm: Float64, z_mm: Float64) -> Float64:
        """Return y and z (2, n) of points as each lies across the line at its own foot on it, mm.

        The points (n,) are given in a frame on the seam, x along it from `station_mm` on: a plane sheet that
        cuts a seam askew shows each of them at another station.
        """
        along_mm = np.arange(-COURSE_MM, COURSE_MM + COURSE_STEP_MM, COURSE_STEP_MM)
        table = self.course(station_mm, along_mm)
        points, foot_mm = np.stack([x_mm, y_mm, z_mm]), x_mm
        turn = np.gradient(table[:, 3:6], COURSE_STEP_MM, axis=0)
        for _ in range(FOOT_STEPS):
            off, way, bent = (
                np.array([np.interp(foot_mm, along_mm, column) for column in columns.T])
                for columns in (table[:, :3], table[:, 3:6], turn)
            )
            off = points - off
            pace = np.maximum(1.0 - np.sum(bent * off, axis=0), MIN_PACE)
            foot_mm = foot_mm + np.sum(way * off, axis=0) / pace
        there = np.array([np.interp(foot_mm, along_mm, column) for column in table.T])
        off = points - there[:3]
        return np.stack([np.sum(there[6:9] * off, axis=0), np.sum(there[9:] * off, axis=0)])


STRAIGHT = LineDirections(np.zeros(1), np.array([[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]))
"""A line along x of base."""
