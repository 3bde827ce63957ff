"""A torch led over each port, as over CAN, and what is left to a robot after a fault: nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from port_cell import port_cell

from robot_io import Command, Switch
from robot_io.ports.session import MAX_STEP_S, RATE_MM_S
from validation.fault_schedules.judged_cell import JudgedCell
from validation.fault_schedules.worlds import draw_world

pytestmark = pytest.mark.slow
INTERFACES = ("tcp_json", "egm", "rsi", "rtde")
DATAGRAMS = ("egm", "rsi")


def ran(interface: str, seconds: float) -> JudgedCell:
    rng = np.random.default_rng(1)
    world = draw_world(rng)
    cell = JudgedCell(world, rng) if interface == "can" else port_cell(world, rng, interface)
    cell.run(seconds)
    return cell


def torch_rms_mm(cell: JudgedCell) -> float:
    return float(np.sqrt(np.mean([off_mm**2 for time_s, off_mm in cell.torch_error_mm if time_s > 3.0])))


def test_the_torch_is_led_as_over_can_and_the_lag_is_measured() -> None:
    over_can = ran("can", 10.0)
    can_lag = over_can.tracker.poses.look_ahead.lag
    for interface in INTERFACES:
        cell = ran(interface, 10.0)
        lag = cell.tracker.poses.look_ahead.lag
        assert torch_rms_mm(cell) == pytest.approx(torch_rms_mm(over_can), abs=0.01), interface
        # An answer waits for the robot's next report: half a cycle, and more on the way to a new value.
        assert -0.005 < lag.lag_s - can_lag.lag_s < 0.02, interface
        assert lag.sigma_s < 0.005


class Faults:
    """One cell after another fault, armed anew between them."""

    def __init__(self, interface: str) -> None:
        self.cell = ran(interface, 1.2)
        self.node, self.interface = self.cell.robot, interface
        assert self.node.usable_s(1.1)

    @property
    def now_s(self) -> float:
        return self.cell.scheduler.now_s

    def go(self, seconds: float) -> None:
        self.cell.run(self.now_s + seconds)

    def check_ends(self, within_s: float, seconds: float = 0.6) -> None:
        """Nothing counts from some time after now on."""
        begun_s = self.now_s
        self.go(seconds)
        assert self.node.usable_s(begun_s + within_s) == []

    def arm(self) -> None:
        """DISARM, then TRACK: offsets count again, softly from zero."""
        self.cell.command(Command.DISARM)
        self.go(0.35)
        before = len(self.node.applied)
        self.cell.command(Command.TRACK)
        self.go(0.5)
        first = next(each for each in self.node.applied[before:] if each[3])
        assert abs(first[1]) <= 0.1 * RATE_MM_S
        assert self.node.usable_s(self.now_s - 0.05)

    def check_needs_arming(self) -> None:
        """What ended a session ends offsets until the program has commanded DISARM."""
        self.check_ends(0.0, 0.3)
        self.arm()


def check_wire(faults: Faults) -> None:
    """Silence, garbage, frozen, late and reordered messages, a lost connection."""
    node = faults.node
    node.is_silent = True
    faults.check_ends(0.01)
    node.is_silent = False
    faults.check_needs_arming()

    rng = np.random.default_rng(2)
    node.on_wire = lambda data: [(rng.bytes(len(data)), 0.0)]
    faults.check_ends(0.01)
    node.on_wire = lambda data: [(data, 0.0)]
    assert node.refused > 20
    faults.check_needs_arming()

    node.on_wire = lambda data: [(data[: len(data) // 2], 0.0)]
    faults.check_ends(0.01)
    node.on_wire = lambda data: [(data, 0.0)]
    faults.check_needs_arming()

    frozen: list[bytes] = []
    node.on_wire = lambda data: [(frozen.append(data) or frozen[0], 0.0)]
    faults.check_ends(0.01)
    node.on_wire = lambda data: [(data, 0.0)]
    faults.check_needs_arming()

    node.on_wire = lambda data: [(data, 0.1)]
    faults.check_ends(0.01, 0.45)
    node.on_wire = lambda data: [(data, 0.0)]
    faults.go(0.3)
    if faults.interface in DATAGRAMS:
        # What overtakes is taken; what was overtaken is not, and no answer repeats an older stamp.
        node.on_wire = lambda data: [(data, rng.uniform(0.0, 0.02))]
        faults.go(0.5)
        assert node.usable_s(faults.now_s - 0.1)
        node.on_wire = lambda data: [(data, 0.0)]
    faults.arm()

    node.connect()
    faults.check_needs_arming()


def check_clocks(faults: Faults) -> None:
    """The robot's clock set on and back, the tracker's as well."""
    faults.node.clock_s += 1.0
    faults.go(0.5)
    assert faults.node.usable_s(faults.now_s - 0.1)
    faults.node.clock_s -= 1.0
    faults.check_ends(0.01)
    faults.check_needs_arming()


def check_states(faults: Faults) -> None:
    """The robot's own states, and a tracker that stops."""
    cell, robot = faults.cell, faults.node.robot
    for change in ({"emergency_stop": Switch.ON}, {"arc": Switch.OFF}, {"correction": Switch.OFF}):
        welding = robot.status
        robot.status = replace(welding, **change)
        faults.check_ends(0.05, 0.3)
        robot.status = welding
        faults.arm()
    before = len(faults.node.applied)
    cell.tracker.is_running = False
    faults.check_ends(0.2)
    if faults.interface == "rsi":
        # RSI stops without answers: it gets one in each cycle, and the displacement stays.
        answers = faults.node.applied[before:]
        assert len(answers) == pytest.approx(0.6 / 0.004, abs=2)
        assert len({each[1:3] for each in answers[60:]}) == 1
    cell.tracker.resume()
    faults.arm()
    cell.command(Command.DISARM)
    faults.check_ends(0.01, 0.3)


@pytest.mark.parametrize("check", [check_wire, check_clocks, check_states])
@pytest.mark.parametrize("interface", INTERFACES)
def test_nothing_counts_after_a_fault(interface: str, check) -> None:
    faults = Faults(interface)
    check(faults)
    # A session that ended took RSI with it, whose correction begins at zero; within one nothing jumps.
    if interface == "rsi" and check is check_states:
        steps_mm = np.abs(np.diff([each[1] for each in faults.node.applied]))
        assert np.nanmax(steps_mm) <= RATE_MM_S * MAX_STEP_S + 1e-3
