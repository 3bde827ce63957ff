"""Programmed paths that turn: straight stretches and arcs, and the tool that keeps its sensor over them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from arctrack.errors import ArctrackError
from noise_model.compiled.arrays import Float64, Point
from noise_model.setup import Setup
from noise_model.surface.joint import Joint

SAGITTA_MM = 0.005
"""Largest distance of the nominal line's points' chords from an arc."""

LEAD_IN_MM, LEG_MM = 60.0, 400.0
"""Length of the straight stretches before and behind a corner: the sensor sees the first from the start."""

DENSE_STEP_MM, DENSE_BEYOND_MM = 0.5, 60.0
"""Spacing of the stations among which a sheet's is sought, and how far they go over the path's ends."""

MIN_RADIUS_MM, MAX_RADIUS_MM = 2.0, 10_000.0

FILLET_DEG = 45.0
"""A fillet's bisector, leaned away from the upright plate or pipe on the left."""


@dataclass(frozen=True)
class ProgrammedPath:
    """A path in a level plane of base that starts along x and turns to the left.

    `pieces` are (length, mm; curvature, 1/mm). `roll_deg` is the joint's turn about the travel: 0 for joints
    of a level plate, that of its bisector for a fillet around an upright wall. The tool looks at its path
    `ahead_mm` before the torch.
    """

    pieces: tuple[tuple[float, float], ...]
    ahead_mm: float
    start_base_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roll_deg: float = 0.0

    @classmethod
    def of(cls, text: str, setup: Setup) -> ProgrammedPath:
        """Return the path that `circle:RADIUS` or `corner:RADIUS`, mm, names, for a setup."""
        shape, _, number = text.partition(":")
        try:
            radius_mm = float(number)
        except ValueError:
            radius_mm = math.nan
        if shape not in ("circle", "corner") or not MIN_RADIUS_MM <= radius_mm <= MAX_RADIUS_MM:
            raise ArctrackError(
                f"--path {text}: give circle:RADIUS or corner:RADIUS in mm, such as circle:100, "
                f"with a radius from {MIN_RADIUS_MM:g} to {MAX_RADIUS_MM:g}"
            )
        joint, ahead_mm = setup.joint, float(np.linalg.norm(setup.laser.point_mm[:2]))
        if shape == "circle" and radius_mm < ahead_mm:
            raise ArctrackError(
                f"--path {text}: the sensor looks {ahead_mm:g} mm ahead; a circle of less than that turns "
                "away from it: take a larger radius"
            )
        if joint.has_ridges:
            raise ArctrackError(f"--path {text}: ridges run across a straight seam; take another --joint")
        roll_deg = FILLET_DEG if joint.type == "fillet" else 0.0
        bend = 1.0 / radius_mm
        if shape == "circle":
            return cls(((1.5 * math.pi * radius_mm, bend),), ahead_mm, roll_deg=roll_deg)
        pieces = (LEAD_IN_MM, 0.0), (0.5 * math.pi * radius_mm, bend), (LEG_MM, 0.0)
        return cls(pieces, ahead_mm, roll_deg=roll_deg)

    @property
    def length_mm(self) -> float:
        """The path's length."""
        return math.fsum(length_mm for length_mm, _ in self.pieces)

    def heading(self, station_mm: float) -> tuple[float, float, float]:
        """Return (x, y), mm, and direction, rad, at a station; beyond its ends the path runs on straight."""
        x = y = angle = 0.0
        if station_mm < 0.0:
            return station_mm, 0.0, 0.0
        for length_mm, bend in (*self.pieces, (math.inf, 0.0)):
            way_mm = min(station_mm, length_mm)
            chord_mm = way_mm * float(np.sinc(0.5 * bend * way_mm / math.pi))
            x += chord_mm * math.cos(angle + 0.5 * bend * way_mm)
            y += chord_mm * math.sin(angle + 0.5 * bend * way_mm)
            angle += bend * way_mm
            station_mm -= way_mm
            if station_mm <= 0.0:
                break
        return x, y, angle

    def T_base_seam(self, station_mm: float) -> Float64:
        """Return the seam's frame (4, 4) at a station: x along the travel, y to its left, z out."""
        x, y, angle = self.heading(station_mm)
        T = np.eye(4)
        T[:3, :3] = self._turned(angle)
        T[:3, 3] = np.add(self.start_base_mm, (x, y, 0.0))
        return T

    def R_base_tool(self, station_mm: float) -> Float64:
        """Return the rotation (3, 3) of the tool at a station."""
        x, y, _ = self.heading(station_mm)

        def beyond_mm(to_mm: float) -> float:
            u, v, _ = self.heading(to_mm)
            return math.hypot(u - x, v - y) - self.ahead_mm

        # An arc's chord is no shorter than 2/pi of it, up to a half turn.
        seen_mm = brentq(beyond_mm, station_mm, station_mm + 2.0 * self.ahead_mm, xtol=1e-9)
        u, v, _ = self.heading(seen_mm)
        return self._turned(math.atan2(v - y, u - x))

    @cached_property
    def stations_mm(self) -> Float64:
        """Stations of the nominal line's points, from the start to the end."""
        stations = [0.0]
        for length_mm, bend in self.pieces:
            steps = max(1, math.ceil(length_mm / math.sqrt(8.0 * SAGITTA_MM / bend))) if bend else 1
            stations += [stations[-1] + length_mm * (n + 1) / steps for n in range(steps)]
        return np.array(stations)

    @cached_property
    def dense(self) -> tuple[Float64, Float64]:
        """Stations (n,) close together, and the path's points (n, 3) there, base frame, mm."""
        stations_mm = np.arange(-DENSE_BEYOND_MM, self.length_mm + DENSE_BEYOND_MM, DENSE_STEP_MM)
        return stations_mm, np.array([self.T_base_seam(float(s))[:3, 3] for s in stations_mm])

    @cached_property
    def points_base_mm(self) -> tuple[Point, ...]:
        """The nominal line's points."""
        return self._vectors(3)

    @cached_property
    def normals_base(self) -> tuple[Point, ...] | None:
        """The surface's normal at each of them; None for a level plate, whose normal is base's z."""
        return self._vectors(2) if self.roll_deg else None

    def _vectors(self, column: int) -> tuple[Point, ...]:
        frames = (self.T_base_seam(float(station_mm)) for station_mm in self.stations_mm)
        return tuple((float(x), float(y), float(z)) for x, y, z in (T[:3, column] for T in frames))

    def taken_by(self, joint: Joint) -> Joint:
        """Return a joint whose nominal seam is this path."""
        return replace(joint, seam_in_base_mm=self.points_base_mm, surface_normals_in_base=self.normals_base)

    def _turned(self, angle_rad: float) -> Float64:
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ self._rolled

    @cached_property
    def _rolled(self) -> Float64:
        return np.asarray(Rotation.from_euler("X", self.roll_deg, degrees=True).as_matrix())
