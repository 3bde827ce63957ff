"""Events in welding: an arc is struck or fails, a tack hides the joint, a part moves."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from arctrack.simulation.cell.cell import Cell
from arctrack.simulation.cell.robot import RETRACT_MM_S
from arctrack.simulation.cell.weld.rendered_camera import RenderedCamera
from arctrack.simulation.cell.world import World
from robot_io import Command, MotionState, RobotStatus, Switch, WeldingState

End = Callable[[], None]
"""Callback that ends an event."""

STOPPED_S, IGNITION_S = 0.3, 0.3
"""Time for which the robot stands after the arc failed, and until it burns again."""

BACK_UP_MM = 15.0
"""Distance that it backs up, to weld over the crater."""

SHORT_TACK_MM, LONG_TACK_MM = 8.0, 60.0
"""One that is bridged, and one that is longer than a job lets be bridged."""

STRUCK_S, UNSTEADY_S = 0.5, 0.4
"""Time at which the arc is struck, and for which it is unsteady then."""

IN_VIEW_MM, OUT_OF_VIEW_MM = 15.0, 40.0
"""Distance of a tack's begin before the sensor, and lateral distance at which no camera sees the seam."""


@dataclass(frozen=True)
class WeldingEvent:
    """An event in a cell.

    `begin` starts it, with what chance decides, and returns what ends it; `lasts_s` gives its duration in a
    world.
    """

    name: str
    begin: Callable[[Cell, np.random.Generator], End]
    lasts_s: Callable[[World], float]
    from_start: bool = False


def arc_fault(cell: Cell, _rng: np.random.Generator) -> End:
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


def arc_fault_s(_: World) -> float:
    """Return the time from an arc's failure until it burns again."""
    return STOPPED_S + BACK_UP_MM / RETRACT_MM_S + IGNITION_S


def displace_part(cell: Cell, rng: np.random.Generator) -> End:
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


def _rendered_camera(cell: Cell) -> RenderedCamera:
    camera = cell.tracker.camera
    assert isinstance(camera, RenderedCamera)
    return camera


def _ignition(cell: Cell, rng: np.random.Generator) -> End:
    """Strike the arc: bright and unsteady at first, while the robot still stands."""
    robot, camera = cell.robot.robot, _rendered_camera(cell)
    right = robot.status
    robot.status = replace(
        right,
        welding=WeldingState.IGNITING,
        arc=Switch.OFF,
        motion=MotionState.STOPPED,
        current_a=0.0,
        travel_speed_mm_s=0.0,
    )

    def strike() -> None:
        robot.advance(cell.scheduler.now_s)
        robot.status = replace(robot.status, arc=Switch.ON, current_a=right.current_a)
        # Log-normal output of an arc that begins, over its nominal one: sigma and median.
        camera.arc_level = lambda _: 2.0 * float(np.exp(0.7 * rng.standard_normal()))

    cell.scheduler.at(cell.scheduler.now_s + STRUCK_S, strike)

    def end() -> None:
        robot.advance(cell.scheduler.now_s)
        robot.status, camera.arc_level = right, None

    return end


def _report_arc_late(cell: Cell, _rng: np.random.Generator) -> End:
    """Let the robot say that the arc is off while it burns in the image."""
    cell.robot.change_status = lambda status: replace(status, arc=Switch.OFF)

    def end() -> None:
        cell.robot.change_status = None

    return end


def _tack(cell: Cell, length_mm: float) -> None:
    first_mm = cell.robot.robot.station_mm + cell.world.look_ahead_mm + IN_VIEW_MM
    _rendered_camera(cell).tacks_mm = ((first_mm, first_mm + length_mm),)


def _short_tack(cell: Cell, _rng: np.random.Generator) -> End:
    _tack(cell, SHORT_TACK_MM)
    return lambda: None


def _long_tack(cell: Cell, _rng: np.random.Generator) -> End:
    _tack(cell, LONG_TACK_MM)
    return lambda: rearm(cell, Command.RESET)


def _out_of_view(cell: Cell, _rng: np.random.Generator) -> End:
    camera = _rendered_camera(cell)
    camera.aside_mm = OUT_OF_VIEW_MM

    def end() -> None:
        camera.aside_mm = 0.0
        rearm(cell, Command.RESET)

    return end


LOOP_EVENTS: Mapping[str, WeldingEvent] = {
    "ignition": WeldingEvent("ignition", _ignition, lambda _: STRUCK_S + UNSTEADY_S, from_start=True),
    "arc_told_late": WeldingEvent("arc told late", _report_arc_late, lambda _: 0.5),
    "arc_fault": WeldingEvent("arc fault, 15 mm back, restart", arc_fault, arc_fault_s),
    "tack": WeldingEvent("tack", _short_tack, way(IN_VIEW_MM + SHORT_TACK_MM)),
    "long_tack": WeldingEvent("long tack", _long_tack, way(IN_VIEW_MM + LONG_TACK_MM)),
    "out_of_view": WeldingEvent("seam out of view", _out_of_view, way(LONG_TACK_MM)),
    # The robot disarms a second after the part has slipped.
    "slip": WeldingEvent("part slips aside", displace_part, lambda _: 1.0),
}
"""Events by their names on the command line."""
