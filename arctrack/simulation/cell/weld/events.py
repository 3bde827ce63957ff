"""Events in a run with a rendered camera: some of them show in the image alone."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from arctrack.simulation.cell.cell import Cell
from arctrack.simulation.cell.fault_kind import End, FaultKind
from arctrack.simulation.cell.weld.rendered_camera import RenderedCamera
from arctrack.simulation.cell.weld.welding_events import (
    ARC_FAULT,
    LONG_TACK_MM,
    SHORT_TACK_MM,
    SLIPPED,
    rearm,
    way,
)
from robot_io import Command, MotionState, Switch, WeldingState

STRUCK_S, UNSTEADY_S = 0.5, 0.4
"""Time at which the arc is struck, and for which it is unsteady then."""

IN_VIEW_MM, OUT_OF_VIEW_MM = 15.0, 40.0
"""Distance of a tack's begin before the sensor, and lateral distance at which no camera sees the seam."""


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


LOOP_EVENTS: Mapping[str, FaultKind] = {
    "ignition": FaultKind("ignition", _ignition, from_start=True, lasts_s=lambda _: STRUCK_S + UNSTEADY_S),
    "arc_told_late": FaultKind("arc told late", _report_arc_late, lasts_s=lambda _: 0.5),
    "arc_fault": ARC_FAULT,
    "tack": FaultKind("tack", _short_tack, lasts_s=way(IN_VIEW_MM + SHORT_TACK_MM)),
    "long_tack": FaultKind("long tack", _long_tack, lasts_s=way(IN_VIEW_MM + LONG_TACK_MM)),
    "out_of_view": FaultKind("seam out of view", _out_of_view, lasts_s=way(LONG_TACK_MM)),
    # The robot disarms a second after the part has slipped.
    "slip": replace(SLIPPED, lasts_s=lambda _: 1.0),
}
"""Events by their names on the command line."""
