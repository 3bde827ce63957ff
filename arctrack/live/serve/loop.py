"""Core of the live loop: one turn takes what came, tracks the newest frame, and sends what is due.

No thread, process or signal: whoever calls `turn` has the time. Frames and times are the camera's. Messages
wait in the bus' buffer while a frame is tracked; each states its age when it is read.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from arctrack.control.controller import Controller
from arctrack.control.frame_tracking import FrameTracking
from arctrack.control.pose_watch import BEGINNING
from arctrack.control.processor import DELAYS, TOO_BUSY, ProcessorWait
from arctrack.control.tracking_service import SeamTracker, TrackingService
from arctrack.live.cameras.camera import CameraProtocol, UnreadableFrame
from arctrack.live.journal.records import Status
from arctrack.live.serve.exposure import ExposureChooser
from arctrack.live.serve.journal_writer import JournalWriter
from arctrack.live.serve.latency import LatencyCounts, Quantiles
from arctrack.recording.writer import as_stated
from robot_io import (
    BusMessage,
    GateReason,
    LaserState,
    Link,
    Received,
    RobotPulse,
    SeamOffset,
    Source,
    Switch,
    TrackerCommand,
    TrackerStatus,
    Validity,
)
from tracker.state import NAN, Frame, Track

TURN_S, NEAR_S, SPIN_S = 0.002, 0.0002, 0.0005
"""So long a turn waits for a message; a frame that comes meanwhile waits as long at most.

Once the next frame is due it is the second; so near the time when it is expected, nothing is waited for: a
process that sleeps is woken late.
"""

LiveSeam = SeamTracker[FrameTracking]
OnTrack = Callable[[Track, list[BusMessage]], None]
"""Callback with each track, and what was sent of it."""


@dataclass(frozen=True)
class LoopResult:
    """Totals of a run.

    `dropped` frames gave way to a newer one, `dark` ones were taken without the laser. `offsets` counts sent
    offsets by validity, `reasons` why the gate held the measured ones back. Latencies run from mid-exposure
    and from the frame's arrival to the sent offset; `delayed` offsets were late or refused for a delay while
    the machine was too busy. `waited_s` and `ran_s` are the loop's time waiting for and on a processor, NaN
    where the kernel does not tell. `ended_s` is the monotonic time of these figures.
    """

    frames: int
    dropped: int
    dark: int
    valid: int
    offsets: Mapping[str, int]
    reasons: Mapping[str, int]
    capture_to_send: Quantiles
    arrival_to_send: Quantiles
    delayed: int
    waited_s: float
    ran_s: float
    ended_s: float


class LiveLoop:
    """Loop that feeds a tracking service with a camera's frames and a bus' messages, in one thread.

    `seams` are by the robot's job number; the first one is tracked until the robot names a job. In a live run
    the robot's commands choose the seam; a recording has its own. `on_track` gets each track and what was
    sent of it.
    """

    def __init__(
        self,
        camera: CameraProtocol,
        link: Link,
        controller: Controller,
        seams: Mapping[int, LiveSeam],
        source: Source = Source.LIVE,
        on_track: OnTrack | None = None,
        journal_writer: JournalWriter | None = None,
        exposure: ExposureChooser | None = None,
    ) -> None:
        self.camera, self.link, self.controller = camera, link, controller
        self._seams, self._source, self._on_track = seams, source, on_track
        self._journal_writer = journal_writer
        self._exposure = exposure
        self._job_number, self.seam = next(iter(seams.items()))
        self._service = TrackingService[Frame | None](
            controller, self.seam, link.send, camera.now_s, self._count
        )
        self._command: TrackerCommand | None = None
        self._waiting: Frame | UnreadableFrame | None = None
        self._replaced = 0
        self._laser = LaserState.UNKNOWN
        self._processor = ProcessorWait()
        self._frames = self._valid = self._dark = self._delayed = 0
        self._offsets: Counter[Validity] = Counter()
        self._offset: SeamOffset | None
        self._reason, self._offset = GateReason.NOT_ARMED, None
        self._arrived_s = self._period_s = self._frame_s = self._checked_s = NAN
        self._since_capture, self._since_arrival = LatencyCounts(), LatencyCounts()

    @property
    def is_over(self) -> bool:
        """True once nothing is left to be tracked, now or ever."""
        return self.camera.is_over and self._waiting is None

    @property
    def warning(self) -> str | None:
        """Warning for the user, once in a run."""
        return TOO_BUSY if self._delayed else None

    def turn(self, wait_s: float | None = None) -> None:
        """Read the bus, switch the laser, track the newest frame once its pose is there, send what is due."""
        self._listen(self._wait_s() if wait_s is None else wait_s)
        now_s = self.camera.now_s()
        # Period of the loop's turns: those about a frame's arrival are shorter.
        is_time = not 0.0 <= now_s - self._checked_s < 0.001
        if is_time:
            self._checked_s = now_s
            self._processor.look()
            self._laser = self.camera.switch_laser(self.controller.is_laser_on(now_s))
            self.controller.on_laser(self._laser)
        frame = self._without_dark(self.camera.newest())
        if frame is not None:
            self._replaced += self._waiting is not None
            self._waiting = as_stated(frame) if isinstance(frame, Frame) else frame
            now_s = self.camera.now_s()
            self._period_s, self._arrived_s = now_s - self._arrived_s, now_s
        waiting = self._waiting
        if waiting is not None and self.seam.poses.is_settled(waiting.timestamp_s, self.camera.now_s()):
            self._waiting = None
            self._track(waiting)
        if is_time:
            self._service.poll()
            if self._journal_writer is not None:
                self._journal_writer.write_status(self.camera.now_s(), self.status)

    def close(self) -> None:
        """Send the last refusal, and switch the laser off."""
        self.controller.on_laser(self.camera.switch_laser(False))
        self._service.close()

    def status(self) -> Status:
        """Return how the run stands."""
        result = self.result()
        return Status(
            now_s=self.camera.now_s(),
            wall_s=time.time(),
            source=self._source,
            state=self.controller.state,
            fault=self.controller.fault,
            laser=self._laser,
            reason=self._reason,
            offset=self._offset,
            robot=self._service.robot,
            command=self._command,
            job_number=self._job_number,
            frames=result.frames,
            valid=result.valid,
            dropped=result.dropped,
            offsets=result.offsets,
            reasons=result.reasons,
            faults={fault.value: count for fault, count in self.link.faults.items() if count},
            capture_ms=_shown(result.capture_to_send),
            arrival_ms=_shown(result.arrival_to_send),
            frame_s=self._frame_s,
            processor_wait=self._processor.share,
            capture_counts=self._since_capture.up_to_buckets(),
            arrival_counts=self._since_arrival.up_to_buckets(),
            capture_sum_s=self._since_capture.sum_s,
            arrival_sum_s=self._since_arrival.sum_s,
        )

    def result(self) -> LoopResult:
        """Return what the run has come to so far."""
        return LoopResult(
            frames=self._frames,
            dropped=self._dropped,
            dark=self._dark,
            valid=self._valid,
            offsets={validity.name: count for validity, count in sorted(self._offsets.items())},
            reasons={reason.name: count for reason, count in sorted(self.controller.reasons.items())},
            capture_to_send=self._since_capture.quantiles(),
            arrival_to_send=self._since_arrival.quantiles(),
            delayed=self._delayed,
            waited_s=self._processor.waited_s,
            ran_s=self._processor.ran_s,
            ended_s=time.monotonic(),
        )

    @property
    def _dropped(self) -> int:
        return self.camera.dropped + self._replaced

    def _wait_s(self) -> float:
        """Return how long a message may be waited for: until the next frame is expected, and then shortly."""
        if self._waiting is not None:
            return NEAR_S
        until_s = self._arrived_s + self._period_s - self.camera.now_s()
        # Written so that a camera that stopped, or was not seen twice, has the longest wait.
        if not until_s > -self._period_s:
            return TURN_S
        if abs(until_s) <= SPIN_S:
            return 0.0
        return min(until_s - SPIN_S, TURN_S) if until_s > 0.0 else NEAR_S

    def _listen(self, wait_s: float) -> None:
        """Read what waits on the bus; wait for the first message alone."""
        # Messages read in a turn at most: a robot that sends all the time must not hold a frame up.
        for _ in range(64):
            received = next(self.link.receive(wait_s), None)
            if received is None:
                return
            self._hear(received)
            wait_s = 0.0

    def _hear(self, received: Received) -> None:
        if self._source is Source.LIVE and isinstance(received.message, TrackerCommand):
            self._obey(received.message)
        if isinstance(received.message, RobotPulse):
            self.camera.tell_pulse(received.message, self.camera.now_s() - received.max_age_s)
        self._service.hear(received)

    def _obey(self, command: TrackerCommand) -> None:
        """Take up the seam that the robot names; after DISARM and RESET another part may come."""
        before, self._command = self._command, command
        number = command.job_number
        if number is not None and number != self._job_number and number in self._seams:
            self.seam, self._job_number = self._seams[number], number
            self._service.take_up(self.seam)
        elif command.command in BEGINNING and (before is None or before.command not in BEGINNING):
            self.seam.tracking.begin()

    def _without_dark(self, frame: Frame | UnreadableFrame | None) -> Frame | UnreadableFrame | None:
        """Return a frame unless it is one of the arc's light alone, which neither waits nor is tracked."""
        is_between = self.camera.traits.interleaves and self._laser is LaserState.ON
        if not is_between or not isinstance(frame, Frame) or frame.laser_on:
            return frame
        self._dark += 1
        return None

    def _track(self, frame: Frame | UnreadableFrame) -> None:
        shown = self._lit(frame) if isinstance(frame, Frame) else None
        dropped = self._dropped
        self.controller.on_dropped(dropped)
        outcome = self._service.track(shown, frame.index, frame.timestamp_s)
        if math.isfinite(outcome.sent_s):
            self._since_capture.add(outcome.sent_s - frame.timestamp_s)
            self._since_arrival.add(outcome.sent_s - self._arrived_s)
        track = outcome.tracked.track
        self._frames += 1
        self._frame_s = frame.timestamp_s
        self._valid += track.valid
        if self._journal_writer is not None:
            self._journal_writer.on_sent(outcome, self._job_number, self._arrived_s, dropped)
        if self._on_track is not None:
            self._on_track(track, outcome.messages)
        if self._exposure is not None and shown is not None:
            wanted_s = self._exposure.choose(
                self.seam.tracking, shown, outcome.tracked.track, outcome.T_base_tool
            )
            if wanted_s is not None:
                self.camera.want_exposure(wanted_s)
        self.seam.poses.rest(self.camera.now_s())

    def _lit(self, frame: Frame) -> Frame:
        """Return a frame that says whether laser and arc were on, by the robot where its camera cannot."""
        if self.camera.traits.knows_arc:
            return frame
        robot = self._service.robot
        lit = replace(
            frame,
            laser_on=frame.laser_on and self._laser is not LaserState.OFF,
            arc_on=robot is not None and robot.arc is Switch.ON,
            current_a=NAN if robot is None else robot.current_a,
        )
        return as_stated(lit)

    def _count(self, message: BusMessage, sent_s: float) -> None:
        if isinstance(message, SeamOffset):
            self._offsets[message.validity] += 1
            self._offset = message
        elif isinstance(message, TrackerStatus):
            self._reason = message.gate_reason
            self._delayed += self._reason in DELAYS and self._processor.is_too_long


def _shown(quantiles: Quantiles) -> tuple[float, float, float]:
    return quantiles.p50_ms, quantiles.p99_ms, quantiles.max_ms
