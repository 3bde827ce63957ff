"""A robot for tests of its poses: travels along x with a weave, and says so on a bus that rounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from robot_io import MotionState, PoseKind, PoseSample, RobotMode, RobotStatus, Switch, WeldingState
from robot_io.poses.nominal_path import NominalPath
from robot_io.poses.plausibility import Plausibility, update
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_questions import Implausibility, PoseArrival
from robot_io.protocol.messages import RobotPoseRotation

LIMITS = PlausibilityLimits()
PERIOD_S = 0.01
PATH = NominalPath(((0.0, 40.0, 0.0), (300.0, 40.0, 0.0)))
WEAVE_MM, WEAVE_HZ = 2.0, 2.0


def status(motion=MotionState.MOVING, speed_mm_s=10.0):
    return RobotStatus(
        RobotMode.AUTOMATIC,
        motion,
        WeldingState.WELDING,
        Switch.ON,
        Switch.OFF,
        Switch.ON,
        Switch.ON,
        120.0,
        speed_mm_s,
        None,
    )


def on_the_bus(timestamp_s, position_mm, rotation, age_s=0.002, kind=PoseKind.ACTUAL):
    """Return a sample as the bus rounds it."""
    q = RobotPoseRotation.from_quaternion(tuple(rotation.as_quat()))
    step = LIMITS.quaternion_step
    rounded = replace(q, **{n: step * round(getattr(q, n) / step) for n in ("small_a", "small_b", "small_c")})
    position = tuple(0.025 * round(float(x) / 0.025) for x in position_mm)
    return PoseSample(float(timestamp_s), position, rounded.quaternion_xyzw, kind, age_s)


@dataclass(frozen=True)
class Robot:
    """Travels at a speed, weaves across, its tool turned and tilted; times jitter."""

    speed_mm_s: float = 10.0
    weave_mm: float = WEAVE_MM
    weave_hz: float = WEAVE_HZ
    y_mm: float = 40.0
    turned_deg: tuple[float, float, float] = (4.0, 8.0, 10.0)
    jitter_s: float = 0.0003
    seed: int = 0

    def place(self, t_s):
        weave = self.weave_mm * math.sin(2.0 * math.pi * self.weave_hz * t_s)
        return np.array([self.speed_mm_s * t_s, self.y_mm + weave, 1.0])

    @property
    def rotation(self):
        return Rotation.from_euler("xyz", self.turned_deg, degrees=True)

    def seen(self, until_s: float, change: Callable[[float, PoseArrival], PoseArrival | None] | None = None):
        """Yield what is seen from 0 on; `change` gets the time and spoils it, None drops it."""
        rng = np.random.default_rng(self.seed)
        for n in range(round(until_s / PERIOD_S)):
            t_s = n * PERIOD_S
            jitter_s = float(np.clip(rng.normal(0.0, self.jitter_s), -0.002, 0.002)) if self.jitter_s else 0.0
            sample = on_the_bus(t_s + jitter_s, self.place(t_s), self.rotation)
            seen = PoseArrival(sample, status(speed_mm_s=self.speed_mm_s))
            spoilt = seen if change is None else change(t_s, seen)
            if spoilt is not None:
                yield spoilt


def doubts(
    run: Iterator[PoseArrival], limits: PlausibilityLimits = LIMITS, path: NominalPath | None = PATH
) -> list[tuple[float, Implausibility | None]]:
    """Return the time and the doubt after each sample."""
    state = Plausibility()
    found = []
    for seen in run:
        state = update(state, seen, limits, path)
        found.append((seen.sample.timestamp_s, state.doubt))
    return found


def moved(seen: PoseArrival, by_mm=(0.0, 0.0, 0.0), by_s=0.0) -> PoseArrival:
    """Return what is seen of a sample that is elsewhere, or of another time."""
    sample = seen.sample
    position = tuple(x + d for x, d in zip(sample.position_base_mm, by_mm, strict=True))
    sample = replace(sample, position_base_mm=position, timestamp_s=sample.timestamp_s + by_s)
    return replace(seen, sample=sample)
