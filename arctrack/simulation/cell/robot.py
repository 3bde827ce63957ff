"""A manipulator: it moves along its path, weaves, follows offsets with dead time and lag, and says so."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from arctrack.simulation.cell.world import World
from noise_model.compiled.arrays import Float64
from noise_model.transforms import transform
from robot_io import (
    Command,
    MotionState,
    RobotMode,
    RobotStatus,
    SeamOffset,
    Switch,
    TrackerCommand,
    Validity,
    WeldingState,
)

RETRACT_MM_S = 20.0
"""Speed of backing up."""

WELDING = RobotStatus(
    mode=RobotMode.AUTOMATIC,
    motion=MotionState.MOVING,
    welding=WeldingState.WELDING,
    arc=Switch.ON,
    emergency_stop=Switch.OFF,
    correction=Switch.ON,
    weave=Switch.ON,
    current_a=120.0,
    travel_speed_mm_s=10.0,
    path_section=0,
)

CORRECTION_MM_S = 30.0
"""Largest speed of a correction in a controller: its axes' acceleration is limited."""

DISARMED = TrackerCommand(Command.DISARM, True, True, 0, 1, 1, Switch.ON)


@dataclass
class Robot:
    """State of the simulated manipulator; `advance` brings it to a time.

    `status` is what it does and says, `command` what it wants of the tracker; `offset_mm` (2,) is the offset
    (y, z) that it has reached; `parts` counts those before this one.
    """

    world: World
    status: RobotStatus = WELDING
    command: TrackerCommand = DISARMED
    offset_mm: Float64 = field(default_factory=lambda: np.zeros(2))
    station_mm: float = 0.0
    now_s: float = 0.0
    weave_s: float = 0.0
    parts: int = 0
    _wanted_mm: Float64 = field(default_factory=lambda: np.zeros(2))
    _queue: list[tuple[float, Float64]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.status = replace(self.status, travel_speed_mm_s=self.world.speed_mm_s)

    def begin_again(self) -> None:
        """Stand where the path begins, without an offset: another part is there."""
        self.station_mm = self.weave_s = 0.0
        self.offset_mm = self._wanted_mm = np.zeros(2)
        self._queue.clear()
        self.parts += 1

    def hear(self, offset: SeamOffset, now_s: float) -> None:
        """Take an offset: absolute, and only if it is VALID or HELD; an axis that is unknown stays."""
        if offset.validity not in (Validity.VALID, Validity.HELD):
            return
        wanted = np.array([offset.offset_y_mm, offset.offset_z_mm])
        self._queue.append((now_s + self.world.latency_s, wanted))

    def advance(self, now_s: float) -> None:
        """Move on to a time, s."""
        while self._queue and self._queue[0][0] <= now_s:
            due_s, wanted = self._queue.pop(0)
            self._move(max(due_s, self.now_s))
            self._wanted_mm = np.where(np.isnan(wanted), self._wanted_mm, wanted)
        self._move(now_s)

    def place_mm(self) -> Float64:
        """Return the tool's place in base, (3,) mm."""
        off_mm = np.array([0.0, self.lateral_mm(), self.offset_mm[1]])
        return transform(self.world.T_base_seam(self.station_mm), off_mm)

    def lateral_mm(self) -> float:
        """Return how far the tool is to the left of its path, with its weave, mm."""
        return float(self.offset_mm[0]) + self._weave_mm()

    def T_base_tool(self) -> Float64:
        """Return the tool's pose, (4, 4) mm."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.world.R_base_tool(self.station_mm), self.place_mm()
        return T

    def _weave_mm(self) -> float:
        return self.world.weave_mm * math.sin(2.0 * math.pi * self.world.weave_hz * self.weave_s)

    def _move(self, now_s: float) -> None:
        elapsed_s = now_s - self.now_s
        self.now_s = now_s
        motion = self.status.motion
        if motion is MotionState.MOVING:
            self.station_mm += self.world.speed_mm_s * elapsed_s
            self.weave_s += elapsed_s
            self._follow(elapsed_s)
        elif motion is MotionState.RETRACTING:
            self.station_mm -= RETRACT_MM_S * elapsed_s

    def _follow(self, elapsed_s: float) -> None:
        """Follow what is wanted by a first-order lag, no faster than a controller lets a correction act."""
        lag_s = self.world.time_constant_s
        off_mm = self._wanted_mm - self.offset_mm
        far_mm, near_mm = math.hypot(*off_mm), CORRECTION_MM_S * lag_s
        # At the largest speed up to where the lag itself is slower.
        fast_s = min(max((far_mm - near_mm) / CORRECTION_MM_S, 0.0), elapsed_s)
        if fast_s > 0.0:
            self.offset_mm = self.offset_mm + CORRECTION_MM_S * fast_s / far_mm * off_mm
            off_mm = self._wanted_mm - self.offset_mm
        self.offset_mm = self.offset_mm + (1.0 - math.exp(-(elapsed_s - fast_s) / lag_s)) * off_mm
