"""The program of the live cell's robot: it arms a tracker that it hears, and goes from part to part."""

from __future__ import annotations

from dataclasses import replace
from itertools import count, groupby

import numpy as np
from heartbeat import BEAT

from arctrack.live.simulated_cell import Program
from arctrack.simulation.cell.bus import Bus
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.robot_node import RobotNode
from arctrack.simulation.cell.scheduler import Scheduler
from arctrack.simulation.cell.weld.closed_loop import LoopPlan, setup_of, world_of
from robot_io import (
    Command,
    CommandHeard,
    Protector,
    Source,
)

PART_MM = 40.0


def test_a_part_ends_disarmed_and_the_next_one_begins_at_its_start() -> None:
    plan = LoopPlan(joint="lap", weave_mm=0.0, length_mm=200.0, size_px=(160, 120))
    scheduler = Scheduler()
    bus = Bus(scheduler, np.random.default_rng(1))
    party = RobotNode(Robot(world_of(plan, setup_of(plan))), bus, scheduler)
    robot, protector = party.robot, Protector(Source.LIVE)
    Program(party, scheduler, PART_MM)
    bus.join("tracker", lambda _frame: None)
    rolling, heard = count(), CommandHeard.OTHER

    def beat() -> None:
        number = robot.command.request_number
        said = replace(BEAT, rolling=next(rolling) % 256, request_number=number, command_heard=heard)
        bus.send("tracker", *protector.protect(said))

    scheduler.every(0.05, beat, 0.001)
    seen: list[tuple[Command, int, float]] = []

    def look() -> None:
        robot.advance(scheduler.now_s)
        seen.append((robot.command.command, robot.parts, robot.station_mm))

    scheduler.every(0.01, look, 0.0093)
    robot.offset_mm = np.array([1.0, 0.0])
    scheduler.run(1.0)
    # A tracker that has not acknowledged DISARM is not armed.
    assert {command for command, _, _ in seen} == {Command.DISARM}
    heard = CommandHeard.DISARM
    scheduler.run(6.0)

    assert [command for command, _ in groupby(command for command, _, _ in seen)] == [
        Command.DISARM,
        Command.TRACK,
        Command.DISARM,
        Command.TRACK,
    ]
    # It stands still where the part ended no longer than the tracker takes to hear of it.
    assert max(station for _, _, station in seen) < PART_MM + 4.0
    assert {parts for _, parts, _ in seen} == {0, 1}
    assert all(command is Command.DISARM for command, parts, station in seen if parts and station < 1.0)
    assert robot.offset_mm.tolist() == [0.0, 0.0]
