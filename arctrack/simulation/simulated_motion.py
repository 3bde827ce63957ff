"""Plan of a simulated recording, and the motion by it: tool pose, true seam, and what is seen of both."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from arctrack.errors import ArctrackError
from arctrack.simulation.programmed_path import ProgrammedPath
from arctrack.simulation.turning_seam import TurningSeam
from noise_model.arc.scene import Scene, make_scene
from noise_model.compiled.arrays import Float64
from noise_model.effects import apply_setup_effects
from noise_model.setup import Setup
from noise_model.surface.joint import (
    BentSeam,
    Joint,
    SeamLine,
    corrugation_height,
    seam_frame,
    seam_height_mm,
    section,
)
from noise_model.transforms import invert, transform

MEETS_WITHIN_MM = 100.0
"""Range along the seam, from the laser sheet's foot, in which their crossing is sought."""

MIN_FRAMES = 12
RATES_HZ, SPEEDS_MM_S, WANDERS_MM, TILTS_DEG = (0.01, 1000.0), (0.0, 1000.0), (0.0, 100.0), (0.0, 45.0)
"""Ranges of a plan: times are written to the microsecond, and the tool goes forward."""


@dataclass(frozen=True)
class SimulationPlan:
    """Plan of a simulated recording.

    Parameters
    ----------
    frames : int
        How many frames.
    rate_hz : float
        Frames a second.
    travel_speed_mm_s : float
        The torch's speed along the seam.
    seed : int
        The same seed makes the same recording.
    seam_wander_mm : float
        How far the true seam leaves its nominal line to the side, half of it up and down.
    weave_mm : float
        How far the tool swings to either side.
    height_mm : tuple of float
        The tool's lowest and highest height over the nominal seam.
    tilt_deg : float
        How far the tool tilts.
    pose_rate_hz, pose_jitter_s : float
        Poses a second, and 1 sigma of their times.
    production : bool
        True has laser and arc on in every frame.
    exact : bool
        True keeps the nominal values for the true ones.
    video : bool
        True writes one lossless video instead of PNGs.
    path : str, optional
        `circle:RADIUS` or `corner:RADIUS`, mm: the nominal seam in place of the setup's straight one.
    """

    frames: int = 24
    rate_hz: float = 10.0
    travel_speed_mm_s: float = 8.0
    seed: int = 0
    seam_wander_mm: float = 0.5
    weave_mm: float = 1.5
    height_mm: tuple[float, float] = (0.1, 2.5)
    tilt_deg: float = 4.0
    pose_rate_hz: float = 100.0
    pose_jitter_s: float = 0.0011
    production: bool = False
    exact: bool = False
    video: bool = False
    path: str | None = None

    def __post_init__(self) -> None:
        least = 1 if self.production else MIN_FRAMES
        if self.frames < least:
            cure = "" if self.production else "; with --production a single one will do"
            raise ArctrackError(f"--frames {self.frames}: at least {least} are needed{cure}")
        for option, value, (low, high) in (
            ("--fps", self.rate_hz, RATES_HZ),
            ("--speed-mm-s", self.travel_speed_mm_s, SPEEDS_MM_S),
            ("--seam-wander-mm", self.seam_wander_mm, WANDERS_MM),
            ("--weave-mm", self.weave_mm, WANDERS_MM),
            ("--tilt-deg", self.tilt_deg, TILTS_DEG),
        ):
            if not low <= value <= high:
                raise ArctrackError(f"{option} {value:g}: must be from {low:g} to {high:g}")


class SeenTruth(NamedTuple):
    """The truth at a pose: the setup and seam to render, and the seam point (3,), tool frame."""

    setup: Setup
    seam: BentSeam
    point_tool: Float64


class SimulatedMotion:
    """Tool pose and true seam over time; phases are drawn once.

    The tool follows the setup's joint, the true seam runs along `true_joint`, by default the same.
    """

    def __init__(
        self, setup: Setup, plan: SimulationPlan, draw: np.random.Generator, true_joint: Joint | None = None
    ) -> None:
        self._setup, self._plan = setup, plan
        start_mm = np.asarray((true_joint or setup.joint).seam_in_base_mm[0])
        self._T_base_true = seam_frame(true_joint or setup.joint, start_mm)
        self._phases = draw.uniform(0.0, 2.0 * np.pi, 6)
        self._corrugation = section(setup.joint).corrugation
        self._T_base_joint = seam_frame(setup.joint, np.asarray(setup.joint.seam_in_base_mm[0]))
        ends_mm = transform(invert(self._T_base_joint), np.asarray(setup.joint.seam_in_base_mm))[:, 0]
        # The path starts where base's x is 0, if the seam runs there.
        self._start_mm = 0.0 if ends_mm[0] <= 0.0 <= ends_mm[1] else float(ends_mm[0])

    def T_base_tool(self, timestamp_s: float) -> Float64:
        """Return the tool's pose, (4, 4) mm."""
        x_mm, T_seam_tool = self._start_mm + self._plan.travel_speed_mm_s * timestamp_s, np.eye(4)
        lateral_mm, height_mm, R_tilt = self._swing(timestamp_s)
        # The torch keeps its distance to a corrugated sheet.
        height_mm += float(corrugation_height(np.array(x_mm), self._corrugation))
        T_seam_tool[:3, :3], T_seam_tool[:3, 3] = R_tilt, (x_mm, lateral_mm, height_mm)
        return self._T_base_joint @ T_seam_tool

    def _swing(self, timestamp_s: float) -> tuple[float, float, Float64]:
        """Return how far the tool is to the left of its path and over it, mm, and its tilt (3, 3)."""
        plan = self._plan
        low_mm, high_mm = plan.height_mm
        height_mm = 0.5 * (low_mm + high_mm)
        height_mm += 0.5 * (high_mm - low_mm) * self._wave(timestamp_s / 2.4, 1)
        tilts_deg = [
            plan.tilt_deg * self._wave(timestamp_s / period_s, 2 + n) for n, period_s in enumerate((2.9, 1.9))
        ]
        lateral_mm = plan.weave_mm * self._wave(timestamp_s / 1.7, 0)
        return (
            lateral_mm,
            height_mm,
            np.asarray(Rotation.from_euler("xy", tilts_deg, degrees=True).as_matrix()),
        )

    def seen_from(self, true_setup: Setup, T_base_tool: Float64) -> SeenTruth:
        """Return what the true setup sees from a pose (4, 4)."""
        seam = self.true_seam(*make_scene(apply_setup_effects(true_setup), T_base_tool).stations_mm)
        return SeenTruth(true_setup, seam, self.seam_point(T_base_tool, seam))

    def scene_at(self, seen: SeenTruth, T_base_tool: Float64) -> Scene:
        """Return the scene of a pose (4, 4) along the stretch that the sheet meets."""
        station_mm = float((invert(self._T_base_true) @ T_base_tool @ [*seen.point_tool, 1.0])[0])
        stretch = seen.seam.lines[int(seen.seam.stretch_at(np.array(station_mm)))]
        return make_scene(seen.setup, T_base_tool, stretch)

    def true_seam(self, first_mm: float, last_mm: float, torch_mm: float) -> BentSeam:
        """Return the true seam from one station to another, the arc where it is at the torch's."""
        return BentSeam.along(self._line, (first_mm, last_mm), torch_mm, self._setup.joint.has_ridges)

    def seam_point(self, T_base_tool: Float64, seam: BentSeam) -> Float64:
        """Return the point (3,) where the true seam meets the laser plane, tool frame, mm."""
        return self._drawn_point(invert(T_base_tool) @ self._T_base_true, self._line, seam)

    def _drawn_point(
        self, T_tool_joint: Float64, line_at: Callable[[float], SeamLine], seam: BentSeam
    ) -> Float64:
        """Return where a seam that is drawn by its stretches meets the laser plane (3,), tool frame, mm."""
        station_mm, _ = self._met(T_tool_joint, line_at)
        drawn = seam.lines[int(seam.stretch_at(np.array(station_mm)))]
        return self._met(T_tool_joint, lambda station_mm: drawn)[1]

    def _met(self, T_tool_joint: Float64, line_at: Callable[[float], SeamLine]) -> tuple[float, Float64]:
        """Return the station at which a seam meets the laser plane, and where (3,), tool frame, mm."""
        plane = self._setup.laser.plane

        def point_tool(station_mm: float) -> Float64:
            height_mm = seam_height_mm(self._setup.joint)
            height_mm += float(corrugation_height(np.array(station_mm), self._corrugation))
            point_joint = transform(line_at(station_mm).frame(), np.array([station_mm, 0.0, height_mm]))
            return transform(T_tool_joint, point_joint)

        def distance_mm(station_mm: float) -> float:
            return float(self._setup.laser.off_mm(point_tool(station_mm)))

        foot_mm = transform(
            invert(T_tool_joint), np.array([-plane[3] / plane[0] if plane[0] else math.nan, 0.0, 0.0])
        )[0]
        ends_mm = foot_mm - MEETS_WITHIN_MM, foot_mm + MEETS_WITHIN_MM
        # A sheet along the seam has no foot: NaN.
        if not distance_mm(ends_mm[0]) * distance_mm(ends_mm[1]) <= 0.0:
            raise ArctrackError(
                f"[laser] plane_in_tool: the sheet does not meet the seam within {MEETS_WITHIN_MM:g} mm of "
                "where it meets the tool's axis of travel; it hardly leans across the seam"
            )
        station_mm = float(brentq(distance_mm, *ends_mm, xtol=1e-9))
        return station_mm, point_tool(station_mm)

    def _line(self, station_mm: float) -> SeamLine:
        wander = np.array([self._plan.seam_wander_mm, 0.5 * self._plan.seam_wander_mm])
        # Wavelengths sideways and in height: plates are straight, cut edges less so.
        wave_number = 2.0 * np.pi / np.array((100.0, 600.0))
        phase = wave_number * station_mm + self._phases[4:]
        place = wander * np.sin(phase)
        slope = wander * wave_number * np.cos(phase)
        return SeamLine(station_mm, float(place[0]), float(place[1]), float(slope[0]), float(slope[1]))

    def _wave(self, turns: float, phase: int) -> float:
        return math.sin(2.0 * math.pi * turns + float(self._phases[phase]))


class TurningMotion(SimulatedMotion):
    """Tool pose and true seam along a path that turns; the tool looks at its path."""

    def __init__(
        self, setup: Setup, plan: SimulationPlan, draw: np.random.Generator, path: ProgrammedPath
    ) -> None:
        super().__init__(setup, plan, draw)
        self._path = path
        self._seam = TurningSeam(path, self._displacement_mm)

    def T_base_tool(self, timestamp_s: float) -> Float64:
        """Return the tool's pose, (4, 4) mm."""
        station_mm = self._plan.travel_speed_mm_s * timestamp_s
        lateral_mm, height_mm, R_tilt = self._swing(timestamp_s)
        T_base_tool = self._path.T_base_seam(station_mm)
        T_base_tool[:3, 3] = transform(T_base_tool, np.array([0.0, lateral_mm, height_mm]))
        T_base_tool[:3, :3] = self._path.R_base_tool(station_mm) @ R_tilt
        return T_base_tool

    def seen_from(self, true_setup: Setup, T_base_tool: Float64) -> SeenTruth:
        """Return what the true setup sees from a pose (4, 4); no point where the sheet misses the seam."""
        seen = self._seam.seen_from(true_setup, T_base_tool)
        first_mm, last_mm, torch_mm = make_scene(
            apply_setup_effects(seen.joint_setup), T_base_tool
        ).stations_mm
        seam = BentSeam.along(seen.line_at, (first_mm, last_mm), torch_mm, False)
        try:
            point_tool = self._drawn_point(invert(T_base_tool) @ seen.T_base_joint, seen.line_at, seam)
        except ArctrackError:
            point_tool = np.full(3, math.nan)
        return SeenTruth(seen.joint_setup, seam, point_tool)

    def _displacement_mm(self, station_mm: float) -> tuple[float, float]:
        line = self._line(station_mm)
        return line.y_mm, line.z_mm
