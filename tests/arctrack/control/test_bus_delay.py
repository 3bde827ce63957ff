"""The way of SYNC and echo, as a tracker hears of it: what is late is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
from test_controller import JOB, Cell, assert_refused

from arctrack.control.bus_delay import BusDelay
from arctrack.control.controller import Controller
from arctrack.control.policy import ServicePolicy
from robot_io import GateReason, RobotSync, Validity

DELAYED, NONE = GateReason.BUS_DELAYED, GateReason.NONE
POLICY = ServicePolicy()


class Bus:
    """A robot that sends a SYNC ten times a second, over ways of so long."""

    def __init__(self, policy: ServicePolicy = POLICY) -> None:
        self.delay = BusDelay(policy)
        self.robot_s = 0.0
        self.there_s, self.back_s, self.clock_s = 0.0004, 0.0004, 50.0
        self.hears_echoes = True

    @property
    def now_s(self) -> float:
        return self.robot_s + self.there_s + self.clock_s

    def run(self, count: int) -> GateReason:
        for _ in range(count):
            self.robot_s += 0.1
            round_trip_us = round(1e6 * (self.there_s + self.back_s))
            known = self.hears_echoes and round_trip_us < 65_535
            sync = RobotSync(
                round(10 * self.robot_s) % 256, round(1e6 * self.robot_s), round_trip_us if known else None
            )
            self.delay.hear(sync, self.now_s)
        return self.delay.doubt(self.now_s)


def test_a_bus_is_fresh_whose_round_trip_is_short() -> None:
    bus = Bus()
    assert bus.run(30) is NONE
    # Two may be lost, three may not.
    assert bus.delay.doubt(bus.now_s + 0.34) is NONE
    assert bus.delay.doubt(bus.now_s + 0.36) is DELAYED


@pytest.mark.parametrize(("there_s", "back_s"), [(0.021, 0.0), (0.0, 0.021), (0.1, 0.0), (0.0, 0.1)])
def test_a_way_that_is_long_from_the_start_is_told(there_s: float, back_s: float) -> None:
    bus = Bus()
    bus.there_s, bus.back_s = there_s, back_s
    assert bus.run(1) is DELAYED
    assert bus.run(20) is DELAYED
    bus.there_s, bus.back_s = 0.0005, 0.0006
    assert bus.run(2) is NONE


def test_a_way_here_that_gets_longer_is_told_by_the_first_sync_that_is_late() -> None:
    bus = Bus()
    bus.run(30)
    # The robot hears no echo of it yet: the clocks alone tell it.
    bus.there_s, bus.hears_echoes = 0.03, False
    assert bus.run(1) is DELAYED
    bus.there_s, bus.hears_echoes = 0.0004, True
    assert bus.run(1) is NONE


def test_echoes_that_no_longer_come_are_told_by_the_silence() -> None:
    bus = Bus()
    bus.run(30)
    bus.hears_echoes = False
    assert [bus.run(1) for _ in range(4)] == [NONE, NONE, NONE, DELAYED]


def test_clocks_that_cannot_be_compared_are_told() -> None:
    """Round trips that are each short enough, and bounds that stay apart all the same."""
    bus = Bus()
    bus.there_s, bus.back_s = 0.003, 0.003
    assert bus.run(5) is NONE
    assert bus.run(1) is DELAYED


def test_of_a_robot_without_sync_nothing_is_asked_unless_it_is_required() -> None:
    assert Bus().delay.doubt(0.0) is NONE
    required = Bus(replace(POLICY, sync_required=True))
    assert required.delay.doubt(0.0) is DELAYED
    assert required.run(10) is NONE


def test_the_gate_refuses_what_is_late_on_its_way() -> None:
    cell = Cell(JOB)
    cell.step()
    for n in range(10):
        cell.hear(RobotSync(n, 100_000 * n, 25_000 if n == 9 else 800))
        cell.run(4)
        cell.now_s += 0.02
    cell.step()
    assert_refused(cell, DELAYED)
    cell.hear(RobotSync(10, 1_000_000, 800))
    assert cell.step().validity is Validity.VALID
    cell.controller = Controller(JOB, policy=replace(POLICY, sync_required=True))
    cell.run(2)
    assert cell.reason is GateReason.NOT_ARMED
