"""What may fail in a cell: cameras, poses, robots, buses, processes; and what must be said of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from arctrack.simulation.cell.robot_node import SOURCE
from arctrack.simulation.cell.weld.events import End, rearm
from robot_io import (
    Command,
    GateReason,
    MotionState,
    Protector,
    RobotMode,
    RobotStatus,
    SeamOffset,
    Switch,
    Validity,
    WeldingState,
)
from validation.fault_schedules import pose_faults
from validation.fault_schedules.fault_kind import POSES, Begin, FaultKind
from validation.fault_schedules.faulty_bus import BusTrouble
from validation.fault_schedules.faulty_tracker import CameraBehaviour
from validation.fault_schedules.judged_cell import JudgedCell

LONGEST_S = 0.9
"""A fault lasts no longer by itself, s."""

DELAYED = frozenset({GateReason.BUS_DELAYED})


def _camera(behaviour: CameraBehaviour) -> Begin:
    def begin(cell: JudgedCell, rng: np.random.Generator) -> End:
        cell.tracker.ghost_mm = float(rng.choice((-1.0, 1.0)) * rng.uniform(1.5, 4.0))
        cell.tracker.behaviour = behaviour

        def end() -> None:
            cell.tracker.behaviour = CameraBehaviour.RIGHT

        return end

    return begin


def _poses(spoiler: pose_faults.Spoiler) -> Begin:
    def begin(cell: JudgedCell, rng: np.random.Generator) -> End:
        cell.robot.spoil = spoiler(cell, rng, cell.scheduler.now_s)

        def end() -> None:
            cell.robot.spoil = None

        return end

    return begin


def _drift(cell: JudgedCell, rng: np.random.Generator) -> End:
    """Let poses drift and be right again. Nothing tells which of both is right: the seam is begun anew."""
    end_drift = _poses(pose_faults.drift)(cell, rng)

    def end() -> None:
        end_drift()
        rearm(cell, Command.DISARM)

    return end


def _said(change: Callable[[RobotStatus], RobotStatus | None]) -> Begin:
    """Let the robot say something else, and do it where it says so of its motion."""

    def begin(cell: JudgedCell, _rng: np.random.Generator) -> End:
        robot = cell.robot.robot
        robot.advance(cell.scheduler.now_s)
        right, told = robot.status, change(robot.status)
        if told is None:
            cell.robot.change_status = lambda _: None
        else:
            robot.status = told

        def end() -> None:
            robot.advance(cell.scheduler.now_s)
            robot.status, cell.robot.change_status = right, None

        return end

    return begin


def _bad_crc(cell: JudgedCell, _rng: np.random.Generator) -> End:
    robot = cell.robot.robot
    right = robot.status
    robot.status = replace(right, emergency_stop=Switch.ON)
    cell.robot.spoils_crc = True

    def end() -> None:
        robot.status, cell.robot.spoils_crc = right, False

    return end


def _no_command(cell: JudgedCell, _rng: np.random.Generator) -> End:
    cell.robot.commands = False

    def end() -> None:
        cell.robot.commands = True

    return end


def _disarm(cell: JudgedCell, _rng: np.random.Generator) -> End:
    cell.command(Command.DISARM)
    return lambda: cell.command(Command.TRACK)


def _bus(trouble: Callable[[np.random.Generator], BusTrouble]) -> Begin:
    def begin(cell: JudgedCell, rng: np.random.Generator) -> End:
        drawn = trouble(rng)
        cell.bus.trouble.append(drawn)
        return lambda: cell.bus.trouble.remove(drawn)

    return begin


def _queue_full(cell: JudgedCell, _rng: np.random.Generator) -> End:
    cell.tracker.queue_full = True

    def end() -> None:
        cell.tracker.queue_full = False

    return end


def _disk_full(cell: JudgedCell, _rng: np.random.Generator) -> End:
    cell.tracker.disk.is_full = True

    def end() -> None:
        cell.tracker.disk.is_full = False

    return end


def _stutter(cell: JudgedCell, rng: np.random.Generator) -> End:
    """Stop the process again and again, each time for as long as chance has it."""
    ended: list[bool] = []

    def stop() -> None:
        if not ended:
            cell.tracker.is_running = False
            cell.scheduler.at(cell.scheduler.now_s + rng.uniform(0.01, 0.15), go_on)

    def go_on() -> None:
        if not ended:
            cell.tracker.resume()
            cell.scheduler.at(cell.scheduler.now_s + rng.uniform(0.01, 0.15), stop)

    stop()

    def end() -> None:
        ended.append(True)
        cell.tracker.resume()

    return end


def _restarted(cell: JudgedCell, _rng: np.random.Generator) -> End:
    cell.tracker.start()

    def end() -> None:
        cell.command(Command.DISARM)
        cell.scheduler.at(cell.scheduler.now_s + 0.25, lambda: cell.command(Command.TRACK))

    return end


def _clock(step_s: float) -> Begin:
    def begin(cell: JudgedCell, _rng: np.random.Generator) -> End:
        cell.tracker.clock_s += step_s
        return lambda: None

    return begin


def _second_tracker(cell: JudgedCell, rng: np.random.Generator) -> End:
    protector = Protector(SOURCE)
    ended: list[bool] = []
    far_mm = float(rng.uniform(-5.0, 5.0))

    def speak() -> None:
        if not ended:
            offset = SeamOffset(far_mm, 0.0, 20.0, 0.9, Validity.VALID)
            cell.bus.send("other", *protector.protect(offset))
            cell.scheduler.at(cell.scheduler.now_s + 0.02, speak)

    speak()

    def end() -> None:
        ended.append(True)
        rearm(cell, Command.RESET)

    return end


def _stopped(cell: JudgedCell, _rng: np.random.Generator) -> End:
    cell.tracker.is_running = False
    return cell.tracker.resume


def _killed(cell: JudgedCell, _rng: np.random.Generator) -> End:
    cell.tracker.is_running = False

    def end() -> None:
        cell.tracker.start()
        cell.tracker.is_running = True
        # A tracker that begins is armed anew: it follows no command that it did not see come.
        cell.command(Command.DISARM)
        cell.scheduler.at(cell.scheduler.now_s + 0.25, lambda: cell.command(Command.TRACK))

    return end


def _turned_motion(motion: MotionState) -> Callable[[RobotStatus], RobotStatus]:
    speed = {MotionState.STOPPED: 0.0, MotionState.PAUSED: 0.0}
    return lambda status: replace(
        status, motion=motion, travel_speed_mm_s=speed.get(motion, status.travel_speed_mm_s)
    )


STATUS_S = 0.05
"""Two cycles of the status, and the way on the bus."""

R = GateReason
FAULTS: tuple[FaultKind, ...] = (
    FaultKind(
        "camera stops",
        _camera(CameraBehaviour.STOPPED),
        frozenset({R.CAMERA_STOPPED, R.CAPTURE_TOO_OLD}),
        1.05,
    ),
    FaultKind("camera freezes", _camera(CameraBehaviour.FROZEN), POSES, 0.6),
    FaultKind(
        "camera shows garbage",
        _camera(CameraBehaviour.GARBAGE),
        note="the seam's measured stretch is followed",
    ),
    FaultKind("camera drops 10 %", _camera(CameraBehaviour.DROPPING), note="offsets go on"),
    FaultKind("camera shows a seam elsewhere", _camera(CameraBehaviour.GHOST), POSES, 0.5),
    FaultKind("poses stop", _poses(pose_faults.stop), POSES, 0.13),
    FaultKind("poses jump", _poses(pose_faults.jump), POSES, 0.05),
    FaultKind("poses run backwards", _poses(pose_faults.delayed(lambda t_s: 2.0 * t_s)), POSES, 0.3),
    FaultKind(
        "poses repeat with their age",
        _poses(pose_faults.repeated(as_new=False)),
        note="a sample that is sent again says nothing new",
    ),
    FaultKind(
        "poses repeat as new",
        _poses(pose_faults.repeated(as_new=True)),
        note="late by two cycles at most; told where the tool goes fast",
    ),
    FaultKind("poses freeze", _poses(pose_faults.freeze), POSES, 0.25),
    FaultKind("y mirrored", _poses(pose_faults.mirror_y), POSES, 0.05),
    FaultKind("y mirrored from the start", _poses(pose_faults.mirror_y), POSES, 0.0, from_start=True),
    FaultKind("y mirrored about the seam", _poses(pose_faults.mirror_about_seam), POSES, 0.6),
    FaultKind("quaternion conjugated", _poses(pose_faults.conjugate), POSES, 0.05),
    FaultKind("poses 100 ms late", _poses(pose_faults.delayed(lambda _: 0.1)), POSES, 0.6),
    FaultKind(
        "poses 100 ms late from the start",
        _poses(pose_faults.delayed(lambda _: 0.1)),
        POSES,
        1.0,
        from_start=True,
    ),
    FaultKind(
        "poses drift",
        _drift,
        recovery_s=3.5,
        follows_mm=pose_faults.DRIFT_MM_S[1] * LONGEST_S,
        note="a seam that runs off looks the same: the torch follows, until the robot disarms",
    ),
    FaultKind("status lost", _said(lambda _: None), frozenset({R.ROBOT_STATUS_STALE}), 0.25),
    FaultKind("status with a bad CRC", _bad_crc, frozenset({R.ROBOT_STATUS_STALE}), 0.25),
    FaultKind(
        "emergency stop",
        _said(lambda status: replace(status, emergency_stop=Switch.ON, motion=MotionState.STOPPED)),
        frozenset({R.EMERGENCY_STOP}),
        STATUS_S,
    ),
    FaultKind(
        "stopped", _said(_turned_motion(MotionState.STOPPED)), frozenset({R.ROBOT_NOT_MOVING}), STATUS_S
    ),
    FaultKind("paused", _said(_turned_motion(MotionState.PAUSED)), frozenset({R.ROBOT_NOT_MOVING}), STATUS_S),
    FaultKind(
        "retracting", _said(_turned_motion(MotionState.RETRACTING)), frozenset({R.ROBOT_NOT_MOVING}), STATUS_S
    ),
    FaultKind(
        "welding fault",
        _said(lambda status: replace(status, welding=WeldingState.FAULT)),
        frozenset({R.WELDING_FAULT}),
        STATUS_S,
    ),
    FaultKind(
        "arc off", _said(lambda status: replace(status, arc=Switch.OFF)), frozenset({R.ARC_OFF}), STATUS_S
    ),
    FaultKind(
        "manual mode",
        _said(lambda status: replace(status, mode=RobotMode.MANUAL)),
        frozenset({R.NOT_AUTOMATIC}),
        STATUS_S,
    ),
    FaultKind("disarmed", _disarm, frozenset({R.NOT_ARMED}), 0.13),
    FaultKind("commands lost", _no_command, frozenset({R.HEARTBEAT_LOST}), 0.2),
    FaultKind("bus off", _bus(lambda _: BusTrouble(lost=1.0)), note="nothing goes out or comes in"),
    FaultKind("send queue full", _queue_full, note="nothing goes out"),
    FaultKind("bits flipped at 1e-3", _bus(lambda _: BusTrouble(flipped=1e-3)), note="CRC drops them"),
    FaultKind("frames doubled", _bus(lambda _: BusTrouble(doubled=0.3)), note="the counter drops them"),
    FaultKind("frames lost, 10 %", _bus(lambda _: BusTrouble(lost=0.1)), note="two in a row may be lost"),
    FaultKind("frames overtake", _bus(lambda _: BusTrouble(shuffled_s=0.03)), note="the counter drops them"),
    FaultKind(
        "robot's frames late by the counter's turns",
        _bus(lambda rng: BusTrouble(("robot",), late_s=0.15 * int(rng.integers(1, 3)))),
        note="told by the silence, then by the way",
    ),
    FaultKind(
        "tracker's frames late by the counter's turns",
        _bus(lambda rng: BusTrouble(("tracker",), late_s=0.15 * int(rng.integers(1, 3)))),
        DELAYED,
        0.5,
        is_slow_bus=True,
        note="told by the round trip that the robot states no more",
    ),
    FaultKind(
        "robot's frames 100 ms late",
        _bus(lambda _: BusTrouble(("robot",), late_s=0.1)),
        DELAYED | POSES,
        0.3,
        note="told by the way of its SYNC",
    ),
    FaultKind(
        "robot's frames 100 ms late from the start",
        _bus(lambda _: BusTrouble(("robot",), late_s=0.1)),
        DELAYED | POSES,
        0.0,
        from_start=True,
    ),
    FaultKind("clock set on by 1 s", _clock(1.0), note="at once; SYNC shows that it was set"),
    FaultKind("clock set back by 1 s", _clock(-1.0), note="at once; SYNC shows that it was set"),
    FaultKind("second tracker", _second_tracker, frozenset({R.OTHER_TRACKER}), 0.05),
    FaultKind("process stopped", _stopped, note="nothing goes out"),
    FaultKind("process stops again and again", _stutter, note="what waited is read with its age"),
    FaultKind(
        "process killed, another begins at once",
        _restarted,
        frozenset({R.NOT_ARMED}),
        0.03,
        note="it waits to be disarmed: the robot may stand anywhere",
    ),
    FaultKind("disk full", _disk_full, note="offsets go on; what is not logged is counted"),
    FaultKind("process killed, another begins", _killed, note="nothing goes out"),
)
"""All of them, in the table's order."""
