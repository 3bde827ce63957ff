"""What may go wrong in a cell, each fault with what must be said of it and how soon."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from arctrack.cell.bus import BusTrouble
from arctrack.cell.cell import Cell
from arctrack.cell.robot_party import SOURCE, Spoil, Told
from arctrack.cell.tracker_party import Camera
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

End = Callable[[], None]
"""What ends a fault."""

Begin = Callable[[Cell, np.random.Generator], End]
"""Begins a fault in a cell, with what chance decides."""

Spoiler = Callable[[Cell, np.random.Generator, float], Spoil]
"""Draws what is wrong with poses from a time, s, on."""

POSES = frozenset({GateReason.POSE_IMPLAUSIBLE})
DELAYED = frozenset({GateReason.BUS_DELAYED})


@dataclass(frozen=True)
class FaultKind:
    """One thing that goes wrong.

    Parameters
    ----------
    name : str
        What it is called in the table.
    begin : callable
        Makes it so in a cell, and returns what ends it.
    reasons : frozenset of GateReason
        What the tracker may say of it; empty where it need not say anything.
    told_s : float
        After how long nothing is VALID or HELD any more, s; NaN where offsets may go on.
    from_start : bool
        Whether it holds from the first frame on.
    is_slow_bus : bool
        Whether offsets get old on the bus itself, which the tracker cannot know.
    recovery_s : float
        How long after its end all is to be well again, s.
    note : str
        What the table says of it.
    """

    name: str
    begin: Begin
    reasons: frozenset[GateReason] = frozenset()
    told_s: float = math.nan
    from_start: bool = False
    is_slow_bus: bool = False
    recovery_s: float = 1.6
    note: str = ""


def _camera(camera: Camera) -> Begin:
    def begin(cell: Cell, rng: np.random.Generator) -> End:
        cell.tracker.ghost_mm = float(rng.choice((-1.0, 1.0)) * rng.uniform(1.5, 4.0))
        cell.tracker.camera = camera

        def end() -> None:
            cell.tracker.camera = Camera.RIGHT

        return end

    return begin


def _poses(spoiler: Spoiler) -> Begin:
    def begin(cell: Cell, rng: np.random.Generator) -> End:
        cell.robot.spoil = spoiler(cell, rng, cell.scheduler.now_s)

        def end() -> None:
            cell.robot.spoil = None

        return end

    return begin


def _stop(_cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    return lambda _, told: None


def _jump(_cell: Cell, rng: np.random.Generator, _begun_s: float) -> Spoil:
    direction = rng.normal(size=3)
    by = direction / np.linalg.norm(direction) * rng.uniform(2.0, 10.0)

    def spoil(_: float, told: Told) -> Told:
        x, y, z = (np.array(told.place_mm) + by).tolist()
        return replace(told, place_mm=(x, y, z))

    return spoil


def _freeze(_cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    first: list[Told] = []

    def spoil(_: float, told: Told) -> Told:
        first.append(told)
        return first[0]

    return spoil


def _delayed(delay_s: Callable[[float], float]) -> Spoiler:
    def spoiler(cell: Cell, _rng: np.random.Generator, begun_s: float) -> Spoil:
        shadow = _Shadow(cell)

        def spoil(now_s: float, told: Told) -> Told:
            return shadow.told(told, now_s - delay_s(now_s - begun_s))

        return spoil

    return spoiler


class _Shadow:
    """Where the tool was: the travel and the weave at another time, the offset that it has now."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell

    def told(self, told: Told, then_s: float) -> Told:
        robot, world = self._cell.robot.robot, self._cell.world
        back_s = robot.now_s - then_s
        phase = 2.0 * math.pi * world.weave_hz
        weave_mm = world.weave_mm * (
            math.sin(phase * (robot.weave_s - back_s)) - math.sin(phase * robot.weave_s)
        )
        x, y, z = told.place_mm
        return replace(told, place_mm=(x - world.speed_mm_s * back_s, y + weave_mm, z))


def _repeat(_cell: Cell, rng: np.random.Generator, _begun_s: float) -> Spoil:
    kept: list[Told] = []
    times = int(rng.integers(2, 4))

    def spoil(_: float, told: Told) -> Told:
        # The same sample again, and honest about its age.
        if len(kept) % times == 0:
            kept.append(told)
        else:
            kept.append(replace(kept[-1], age_s=kept[-1].age_s + 0.01))
        return kept[-1]

    return spoil


def _mirror_y(_cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    return lambda _, told: replace(told, place_mm=(told.place_mm[0], -told.place_mm[1], told.place_mm[2]))


def _mirror_about_seam(cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    def spoil(_: float, told: Told) -> Told:
        x, y, z = told.place_mm
        return replace(told, place_mm=(x, 2.0 * cell.world.start_base_mm[1] - y, z))

    return spoil


def _conjugate(_cell: Cell, _rng: np.random.Generator, _begun_s: float) -> Spoil:
    def spoil(_: float, told: Told) -> Told:
        x, y, z, w = told.quaternion
        return replace(told, quaternion=(-x, -y, -z, w))

    return spoil


def _drift(_cell: Cell, rng: np.random.Generator, begun_s: float) -> Spoil:
    rate_mm_s = float(rng.choice((-1.0, 1.0)) * rng.uniform(0.2, 1.0))

    def spoil(now_s: float, told: Told) -> Told:
        x, y, z = told.place_mm
        return replace(told, place_mm=(x, y + rate_mm_s * (now_s - begun_s), z))

    return spoil


def _said(change: Callable[[RobotStatus], RobotStatus | None]) -> Begin:
    """Let the robot say something else, and do it where it says so of its motion."""

    def begin(cell: Cell, _rng: np.random.Generator) -> End:
        robot = cell.robot.robot
        robot.advance(cell.scheduler.now_s)
        right, told = robot.status, change(robot.status)
        if told is None:
            cell.robot.said = lambda _: None
        else:
            robot.status = told

        def end() -> None:
            robot.advance(cell.scheduler.now_s)
            robot.status, cell.robot.said = right, None

        return end

    return begin


def _bad_crc(cell: Cell, _rng: np.random.Generator) -> End:
    robot = cell.robot.robot
    right = robot.status
    robot.status = replace(right, emergency_stop=Switch.ON)
    cell.robot.breaks_status = True

    def end() -> None:
        robot.status, cell.robot.breaks_status = right, False

    return end


def _no_command(cell: Cell, _rng: np.random.Generator) -> End:
    cell.robot.commands = False

    def end() -> None:
        cell.robot.commands = True

    return end


def _disarm(cell: Cell, _rng: np.random.Generator) -> End:
    cell.command(Command.DISARM)
    return lambda: cell.command(Command.TRACK)


def _bus(trouble: Callable[[np.random.Generator], BusTrouble]) -> Begin:
    def begin(cell: Cell, rng: np.random.Generator) -> End:
        drawn = trouble(rng)
        cell.bus.trouble.append(drawn)
        return lambda: cell.bus.trouble.remove(drawn)

    return begin


def _queue_full(cell: Cell, _rng: np.random.Generator) -> End:
    cell.tracker.queue_full = True

    def end() -> None:
        cell.tracker.queue_full = False

    return end


def _clock(step_s: float) -> Begin:
    def begin(cell: Cell, _rng: np.random.Generator) -> End:
        cell.tracker.clock_s += step_s
        return lambda: None

    return begin


def _second_tracker(cell: Cell, rng: np.random.Generator) -> End:
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
        cell.command(Command.RESET, is_new_request=True)
        cell.scheduler.at(cell.scheduler.now_s + 0.25, lambda: cell.command(Command.TRACK))

    return end


def _stopped(cell: Cell, _rng: np.random.Generator) -> End:
    cell.tracker.is_running = False
    return cell.tracker.resume


def _killed(cell: Cell, _rng: np.random.Generator) -> End:
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
KINDS: tuple[FaultKind, ...] = (
    FaultKind(
        "camera stops", _camera(Camera.STOPPED), frozenset({R.CAMERA_STOPPED, R.CAPTURE_TOO_OLD}), 1.05
    ),
    FaultKind("camera freezes", _camera(Camera.FROZEN), POSES, 0.6),
    FaultKind(
        "camera shows garbage", _camera(Camera.GARBAGE), note="the seam's measured stretch is followed"
    ),
    FaultKind("camera drops 10 %", _camera(Camera.DROPPING), note="offsets go on"),
    FaultKind("camera shows a seam elsewhere", _camera(Camera.GHOST), POSES, 0.5),
    FaultKind("poses stop", _poses(_stop), POSES, 0.13),
    FaultKind("poses jump", _poses(_jump), POSES, 0.05),
    FaultKind("poses run backwards", _poses(_delayed(lambda t_s: 2.0 * t_s)), POSES, 0.3),
    FaultKind("poses repeat", _poses(_repeat), POSES, 0.1),
    FaultKind("poses freeze", _poses(_freeze), POSES, 0.25),
    FaultKind("y mirrored", _poses(_mirror_y), POSES, 0.05),
    FaultKind("y mirrored from the start", _poses(_mirror_y), POSES, 0.0, from_start=True),
    FaultKind("y mirrored about the seam", _poses(_mirror_about_seam), POSES, 0.6),
    FaultKind("quaternion conjugated", _poses(_conjugate), POSES, 0.05),
    FaultKind("poses 100 ms late", _poses(_delayed(lambda _: 0.1)), POSES, 0.6),
    FaultKind(
        "poses 100 ms late from the start", _poses(_delayed(lambda _: 0.1)), POSES, 1.0, from_start=True
    ),
    FaultKind("poses drift", _poses(_drift), recovery_s=3.5, note="a seam that runs off looks the same"),
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
    FaultKind("process killed, another begins", _killed, note="nothing goes out"),
)
"""All faults, in the table's order."""
