"""Clock of a replay: when each frame is sent, and what the robot then does."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence

from arctrack.control.controller import Controller
from arctrack.control.pose_agreement import PoseAgreement
from arctrack.recording import FrameRow
from arctrack.recording.exposed import exposed_s
from noise_model.compiled.arrays import Float64
from robot_io import (
    BusMessage,
    Command,
    GateReason,
    Link,
    MotionState,
    Received,
    RobotMode,
    RobotStatus,
    SeamOffset,
    Switch,
    TrackerCommand,
    WeldingState,
)
from tracker.state import Track

PosesVerdict = Callable[[float], GateReason]
"""Says whether the recording's poses are to be trusted at a time, s; times rise from call to call."""

POLL_S = 0.02
"""So often the controller is asked what is due while a frame's time has not come."""


class RecordingTime:
    """Offline clock: runs as fast as possible, computation counts as instantaneous.

    So the same recording sends the same on every machine. The robot is the recording's: it welds while a
    frame's arc burns, and commands the tracker to track. A log begins at 0: where a recording begins before,
    its log is whole seconds late.
    """

    def __init__(
        self,
        rows: Sequence[FrameRow],
        link: Link,
        controller: Controller,
        poses_verdict: PosesVerdict,
        job_number: int | None = None,
    ) -> None:
        self._link, self._controller, self._poses_verdict = link, controller, poses_verdict
        self._job_number = job_number
        self._now_s = first_s = min(exposed_s(row) for row in rows)
        self._log_is_late_s = float(max(0, math.ceil(-first_s)))
        self._hear(assumed_command(rows[0], Command.DISARM, job_number))

    def publish(self, row: FrameRow, track: Track, T_base_tool: Float64 | None, took_ms: float) -> SeamOffset:
        """Send a frame's messages at its end of exposure, and return its offset as it went out.

        Raises LinkError if the link is closed, BusLogError if the log cannot hold its time.
        """
        self._hear_robot(row)
        self._controller.on_poses(self._poses_verdict(self._now_s), self._now_s)
        messages = self._controller.on_track(track, self._now_s, T_base_tool, took_ms)
        self._send(messages)
        return _offset(messages)

    def close(self) -> None:
        """Send the last refusal."""
        self._send(self._controller.close(self._now_s))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the log and the bus, one line each."""
        if not self._log_is_late_s:
            return _faults(self._link)
        return (
            *_faults(self._link),
            f"frames come before 0 s, where a log begins: in bus.blf all times are {self._log_is_late_s:g} s "
            "later",
        )

    def _hear_robot(self, row: FrameRow) -> None:
        """Let the robot say how it stood at a frame, and before: it was not silent between two frames."""
        before_s, exposed = self._now_s, exposed_s(row)
        n_steps = max(1, math.ceil((exposed - before_s) / self._controller.job.limits.hold_s))
        for n in range(1, n_steps + 1):
            self._now_s = exposed if n == n_steps else before_s + n * (exposed - before_s) / n_steps
            self._hear(assumed_robot(row))
            self._hear(assumed_command(row, job_number=self._job_number))

    def _hear(self, message: BusMessage) -> None:
        self._controller.on_message(Received(self._now_s, message, 0), self._now_s)

    def _send(self, messages: Iterable[BusMessage]) -> None:
        _send(self._link, self._controller, messages, self._now_s + self._log_is_late_s)


class RealTime:
    """Real-time clock on a bus beyond this process: a frame is sent when its time has come.

    The robot is the one on the bus. It must stand where the recording's robot stood, and the recording's own
    poses must be trusted. The clock is the recording's, from the first frame on. `check_interrupt` is called
    while it waits, and may raise.
    """

    def __init__(
        self,
        rows: Sequence[FrameRow],
        link: Link,
        controller: Controller,
        agreement: PoseAgreement,
        poses_verdict: PosesVerdict,
        check_interrupt: Callable[[], None],
    ) -> None:
        self._first_s = exposed_s(rows[0])
        self._link, self._controller = link, controller
        self._agreement, self._poses_verdict = agreement, poses_verdict
        self._check_interrupt = check_interrupt
        self._began_s = math.nan
        self._heard = False

    def publish(self, row: FrameRow, track: Track, T_base_tool: Float64 | None, took_ms: float) -> SeamOffset:
        """Wait for a frame's time, send its messages, and return its offset as it went out.

        The clock starts with the first: what is got ready before that takes its own time. Where the replay
        lags behind, the messages go out late. Raises LinkError if the link is closed, BusLogError if the log
        cannot hold its time.
        """
        if math.isnan(self._began_s):
            self._began_s = time.monotonic()
        self._listen_until(exposed_s(row))
        messages = self._controller.on_track(track, self._now_s(), T_base_tool, took_ms)
        _send(self._link, self._controller, messages)
        return _offset(messages)

    def close(self) -> None:
        """Send the last refusal."""
        now_s = self._first_s if math.isnan(self._began_s) else self._now_s()
        _send(self._link, self._controller, self._controller.close(now_s))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the robot and the bus, one line each."""
        bus = f"{self._link.interface}:{self._link.channel}"
        warnings = []
        if not self._heard:
            warnings.append(f"{bus}: no RobotStatus was heard, so every offset was refused")
        return (*warnings, *_faults(self._link))

    def _listen_until(self, due_s: float) -> None:
        """Read the bus until a frame is due, and in any case what waits there.

        Between two frames a bus may bring more than its interface stores, and some interfaces know no better
        time of a message than that of its reading.
        """
        while True:
            self._check_interrupt()
            # One message at a time: a robot that talks all the time must not hold the frame up.
            remaining_s = max(0.0, due_s - self._now_s())
            received = next(self._link.receive(min(remaining_s, POLL_S)), None)
            if received is not None:
                self._hear(received)
            _send(self._link, self._controller, self._controller.poll(self._now_s()))
            if received is None and remaining_s <= POLL_S:
                return

    def _hear(self, received: Received) -> None:
        now_s = self._now_s()
        self._heard |= isinstance(received.message, RobotStatus)
        verdict = self._agreement.verdict(received, now_s)
        if verdict is GateReason.NONE:
            # What it is sent rests on the recording's poses.
            verdict = self._poses_verdict(now_s)
        if verdict is not None:
            self._controller.on_poses(verdict, now_s)
        _send(self._link, self._controller, self._controller.on_message(received, now_s))

    def _now_s(self) -> float:
        return self._first_s + time.monotonic() - self._began_s


def assumed_robot(row: FrameRow) -> RobotStatus:
    """Return a robot that welds in automatic if a frame's arc burns."""
    return RobotStatus(
        mode=RobotMode.AUTOMATIC,
        motion=MotionState.MOVING,
        welding=WeldingState.WELDING if row.arc_on else WeldingState.OFF,
        arc=Switch.ON if row.arc_on else Switch.OFF,
        emergency_stop=Switch.OFF,
        correction=Switch.ON,
        weave=Switch.UNKNOWN,
        current_a=row.current_a,
        travel_speed_mm_s=math.nan,
        path_section=None,
    )


def assumed_command(
    row: FrameRow, command: Command = Command.TRACK, job_number: int | None = None
) -> TrackerCommand:
    """Return what the recording's robot wanted: that its seam be tracked, by the laser of a frame."""
    return TrackerCommand(
        command=command,
        enable_y=True,
        enable_z=True,
        request_number=0,
        job_number=job_number,
        program_number=None,
        laser_enable=Switch.ON if row.laser_on else Switch.OFF,
    )


def _faults(link: Link) -> tuple[str, ...]:
    """Return a line on the faults of a bus, if there were any."""
    faults = {fault.value: count for fault, count in link.faults.items() if count}
    if not faults:
        return ()
    counts = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in sorted(faults.items()))
    return (f"{link.interface}:{link.channel}: faults of the bus: {counts}",)


def _send(
    link: Link, controller: Controller, messages: Iterable[BusMessage], logged_at_s: float | None = None
) -> None:
    for message in messages:
        if not link.send(message, logged_at_s):
            controller.unsent(message)


def _offset(messages: Iterable[BusMessage]) -> SeamOffset:
    """Return the one offset of a frame's messages."""
    (offset,) = (message for message in messages if isinstance(message, SeamOffset))
    return offset
