"""What may be wrong with the poses that a robot tells."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from arctrack.simulation.cell.cell import Cell
from arctrack.simulation.cell.robot_node import RobotReport
from validation.fault_schedules.faulty_robot import Spoil

CYCLE_S = 0.01
"""A robot tells a pose so often, s."""

DRIFT_MM_S = (0.2, 1.0)
"""How fast poses drift, mm/s."""

Spoiler = Callable[[Cell, np.random.Generator, float], Spoil]
"""Draws what is wrong with poses from a time, s, on."""


def stop(_cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    """No pose is told."""
    return lambda _, told: None


def jump(_cell: Cell, rng: np.random.Generator, _begun_s: float) -> Spoil:
    """Tell a place that is off by 2 to 10 mm."""
    direction = rng.normal(size=3)
    by = direction / np.linalg.norm(direction) * rng.uniform(2.0, 10.0)

    def spoil(_: float, told: RobotReport) -> RobotReport:
        x, y, z = (np.array(told.place_mm) + by).tolist()
        return replace(told, place_mm=(x, y, z))

    return spoil


def freeze(_cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    """Tell the first pose over and over, as new each time."""
    first: list[RobotReport] = []

    def spoil(_: float, told: RobotReport) -> RobotReport:
        first.append(told)
        return first[0]

    return spoil


def delayed(delay_s: Callable[[float], float]) -> Spoiler:
    """Tell where the tool was, by so long as a time since the beginning, s, says."""

    def spoiler(cell: Cell, _rng: np.random.Generator, begun_s: float) -> Spoil:
        shadow = _Shadow(cell)

        def spoil(now_s: float, told: RobotReport) -> RobotReport:
            return shadow.told(told, now_s - delay_s(now_s - begun_s))

        return spoil

    return spoiler


class _Shadow:
    """Where the tool was: the travel and the weave at another time, the offset that it has now."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell

    def told(self, told: RobotReport, then_s: float) -> RobotReport:
        robot, world = self._cell.robot.robot, self._cell.world
        back_s = robot.now_s - then_s
        phase = 2.0 * math.pi * world.weave_hz
        weave_mm = world.weave_mm * (
            math.sin(phase * (robot.weave_s - back_s)) - math.sin(phase * robot.weave_s)
        )
        x, y, z = told.place_mm
        return replace(told, place_mm=(x - world.speed_mm_s * back_s, y + weave_mm, z))


def repeated(as_new: bool) -> Spoiler:
    """Tell each pose two or three times: as new each time, or honest about its age."""

    def spoiler(_cell: Cell, rng: np.random.Generator, _begun_s: float) -> Spoil:
        kept: list[RobotReport] = []
        times = int(rng.integers(2, 4))

        def spoil(_: float, told: RobotReport) -> RobotReport:
            if len(kept) % times == 0:
                kept.append(told)
            else:
                kept.append(kept[-1] if as_new else replace(kept[-1], age_s=kept[-1].age_s + CYCLE_S))
            return kept[-1]

        return spoil

    return spoiler


def mirror_y(_cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    """Tell base's y with the other sign."""
    return lambda _, told: replace(told, place_mm=(told.place_mm[0], -told.place_mm[1], told.place_mm[2]))


def mirror_about_seam(cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    """Tell the other side of the nominal seam."""

    def spoil(_: float, told: RobotReport) -> RobotReport:
        x, y, z = told.place_mm
        return replace(told, place_mm=(x, 2.0 * cell.world.start_base_mm[1] - y, z))

    return spoil


def conjugate(_cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    """Tell the inverse rotation."""

    def spoil(_: float, told: RobotReport) -> RobotReport:
        x, y, z, w = told.quaternion
        return replace(told, quaternion=(-x, -y, -z, w))

    return spoil


def drift(_cell: Cell, rng: np.random.Generator, begun_s: float) -> Spoil:
    """Tell a place that goes off at `DRIFT_MM_S`."""
    rate_mm_s = float(rng.choice((-1.0, 1.0)) * rng.uniform(*DRIFT_MM_S))

    def spoil(now_s: float, told: RobotReport) -> RobotReport:
        x, y, z = told.place_mm
        return replace(told, place_mm=(x, y + rate_mm_s * (now_s - begun_s), z))

    return spoil
