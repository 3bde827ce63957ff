"""Events in welding: the arc fails and is struck again, tacks hide the joint, parts move."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from arctrack.simulation.cell.cell import Cell
from arctrack.simulation.cell.fault_kind import POSES, End, FaultKind
from arctrack.simulation.cell.robot import RETRACT_MM_S
from arctrack.simulation.cell.world import World
from robot_io import Command, GateReason, MotionState, RobotStatus, Switch, WeldingState

R = GateReason

STOPPED_S, IGNITION_S = 0.3, 0.3
"""Time for which the robot stands after the arc failed, and until it burns again."""

BACK_UP_MM = 15.0
"""Distance that it backs up, to weld over the crater."""

SHORT_TACK_MM, LONG_TACK_MM = 8.0, 60.0
"""One that is bridged, and one that is longer than a job lets be bridged."""


def _arc_fault(cell: Cell, _rng: np.random.Generator) -> End:
    """Let the arc fail; the robot stops, backs up and strikes it again."""
    robot = cell.robot.robot
    right = robot.status

    def say(status: RobotStatus) -> None:
        robot.advance(cell.scheduler.now_s)
        robot.status = status

    out = replace(
        right,
        welding=WeldingState.FAULT,
        arc=Switch.OFF,
        motion=MotionState.STOPPED,
        current_a=0.0,
        travel_speed_mm_s=0.0,
    )
    back = replace(
        out, welding=WeldingState.OFF, motion=MotionState.RETRACTING, travel_speed_mm_s=RETRACT_MM_S
    )
    struck = replace(out, welding=WeldingState.IGNITING)
    now_s = cell.scheduler.now_s
    backed_s = now_s + STOPPED_S + BACK_UP_MM / RETRACT_MM_S
    say(out)
    cell.scheduler.at(now_s + STOPPED_S, lambda: say(back))
    cell.scheduler.at(backed_s, lambda: say(struck))
    return lambda: say(right)


def _displaced(cell: Cell, rng: np.random.Generator) -> End:
    """Displace the part. The robot disarms, searches the seam again and goes on."""
    y_mm, z_mm = cell.world.displaced_mm
    slipped_mm = float(rng.choice((-1.0, 1.0)) * rng.uniform(1.5, 3.0))
    cell.world = replace(cell.world, displaced_mm=(y_mm + slipped_mm, z_mm))

    def end() -> None:
        cell.tracker.camera.begin()
        rearm(cell, Command.DISARM)

    return end


def rearm(cell: Cell, by: Command) -> None:
    """Let the robot command RESET or DISARM, and TRACK a moment later."""
    cell.command(by, is_new_request=by is Command.RESET)
    # Time from DISARM or RESET until the robot commands TRACK again.
    cell.scheduler.at(cell.scheduler.now_s + 0.25, lambda: cell.command(Command.TRACK))


def way(way_mm: float) -> Callable[[World], float]:
    """Return the robot's time for a way, mm."""
    return lambda world: way_mm / world.speed_mm_s


ARC_FAULT = FaultKind(
    "arc fault, 15 mm back, restart",
    _arc_fault,
    frozenset({R.WELDING_FAULT, R.ARC_OFF, R.ROBOT_NOT_MOVING}),
    0.05,
    lasts_s=lambda _: STOPPED_S + BACK_UP_MM / RETRACT_MM_S + IGNITION_S,
)

SLIPPED = FaultKind(
    "part slips aside", _displaced, POSES, 0.6, note="until the robot disarms, and searches the seam anew"
)
