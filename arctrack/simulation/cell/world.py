"""True world: the seam and the programmed path."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.simulation.programmed_path import ProgrammedPath
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import corrugation_height
from noise_model.transforms import invert, transform
from robot_io.poses.nominal_path import NominalPath

CUT_STEPS = 12
"""Steps that meet the plane: on an arc of radius r each leaves the share |displacement| / r."""


@dataclass(frozen=True)
class World:
    """A nominal seam along base's x, the true seam close to it, and a robot that travels along.

    - `turned_deg`: rotation of the tool about base's x, y and z.
    - `displaced_mm`, `slope`: offset (y, z) of the true seam from the nominal one at its start, mm, and its
      slope, mm per mm.
    - `bend_mm`, `bend_length_mm`: amplitude of an additional bend in y, and its wave length.
    - `weave_mm`, `weave_hz`: weave across the seam.
    - `latency_s`, `time_constant_s`: how the robot follows an offset, dead time and first-order lag.
    - `look_ahead_mm`: distance from the torch to where the stripe meets the seam.
    - `noise_mm`: 1 sigma of a measurement of the seam.
    - `corrugation`: height, width and pitch of ridges across the seam, mm, as in
      `noise_model.surface.joint.Section`; the programmed path goes over them.
    - `course`: the programmed path where it turns, and the tool with it; it begins at base's origin.
    - `part_mm`: how far the part lies off its place, base frame, on a course that turns.
    """

    start_base_mm: tuple[float, float, float]
    speed_mm_s: float
    weave_mm: float
    weave_hz: float
    turned_deg: tuple[float, float, float]
    displaced_mm: tuple[float, float]
    slope: tuple[float, float]
    bend_mm: float
    bend_length_mm: float
    latency_s: float
    time_constant_s: float
    look_ahead_mm: float = 35.0
    noise_mm: float = 0.03
    length_mm: float = 400.0
    corrugation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    course: ProgrammedPath | None = None
    part_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def path(self) -> NominalPath:
        """The nominal seam."""
        if self.course is not None:
            return NominalPath(self.course.points_base_mm, normals_base=self.course.normals_base)
        x, y, z = self.start_base_mm
        return NominalPath(((x, y, z), (x + self.length_mm, y, z)))

    @cached_property
    def R_seam_tool(self) -> Float64:
        """The tool's rotation (3, 3) against a straight path, or against where it looks on one that turns."""
        return np.asarray(Rotation.from_euler("xyz", self.turned_deg, degrees=True).as_matrix())

    def R_base_tool(self, station_mm: float) -> Float64:
        """Return the tool's rotation (3, 3) at a station."""
        return (
            self.R_seam_tool
            if self.course is None
            else self.course.R_base_tool(station_mm) @ self.R_seam_tool
        )

    def T_base_seam(self, station_mm: float) -> Float64:
        """Return the programmed path's frame (4, 4) at a station: x along it, y to its left, z out."""
        if self.course is not None:
            return self.course.T_base_seam(station_mm)
        T = np.eye(4)
        T[:3, 3] = np.add(self.start_base_mm, (station_mm, 0.0, self.ridge_mm(station_mm)))
        return T

    def seam_mm(self, station_mm: float) -> tuple[float, float]:
        """Return the true displacement (y, z) of the seam at a station, mm.

        Of a part that lies displaced it is where the seam cuts the plane across the path.
        """
        if self.course is None or not any(self.part_mm):
            return self.along_mm(station_mm)
        to_mm, T_seam_base = station_mm, invert(self.T_base_seam(station_mm))
        for _ in range(CUT_STEPS):
            point = transform(self.T_base_seam(to_mm), np.array([0.0, *self.along_mm(to_mm)])) + self.part_mm
            x_mm, y_mm, z_mm = transform(T_seam_base, point).tolist()
            to_mm -= x_mm
        return y_mm, z_mm

    def along_mm(self, station_mm: float) -> tuple[float, float]:
        """Return the displacement (y, z) of the seam in its part, mm."""
        bend_mm = self.bend_mm * math.sin(2.0 * math.pi * station_mm / self.bend_length_mm)
        return (
            self.displaced_mm[0] + self.slope[0] * station_mm + bend_mm,
            self.displaced_mm[1] + self.slope[1] * station_mm,
        )

    def seam_slope(self, station_mm: float) -> tuple[float, float]:
        """Return the slope (y, z) of the true seam against the nominal one at a station, mm per mm."""
        wave_number = 2.0 * math.pi / self.bend_length_mm
        bend_slope = self.bend_mm * wave_number * math.cos(wave_number * station_mm)
        return self.slope[0] + bend_slope, self.slope[1]

    def ridge_mm(self, station_mm: float) -> float:
        """Return the height of the ridges, and of the programmed path over them, at a station, mm."""
        if self.corrugation[0] == 0.0:
            return 0.0
        x_mm = self.start_base_mm[0] + station_mm
        return float(corrugation_height(np.array(x_mm), np.array(self.corrugation)))
