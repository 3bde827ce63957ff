"""Tracker's messages on the bus, without thread, clock or socket, so that every run can be repeated.

A live run, a replay and a simulation pass the controller what came (`on_message`, `on_track`, `on_poses`) and
the time (`poll`), on one clock of their own. It returns the messages to send, in order. Nothing is VALID
before a message of the robot, and whatever ends that is answered with REFUSED.
"""

import math
from collections import Counter
from collections.abc import Mapping

from arctrack.control import tracker_messages
from arctrack.control.bus_delay import BusDelay
from arctrack.control.find_responder import FindResponder, JointFinder
from arctrack.control.job import NO_JOB, Job
from arctrack.control.part_fitness import PartWatch
from arctrack.control.policy import ServicePolicy
from arctrack.control.robot_messages import OutageWatch, TimedMessage, fresh
from arctrack.control.tracker_messages import NO_TRACK, UNKNOWN_POINT, HeartbeatSchedule, has
from noise_model.compiled.arrays import Float64
from robot_io import (
    BusMessage,
    Command,
    CommandHeard,
    Conditions,
    Fault,
    FindRefusal,
    FindResult,
    GateReason,
    JointType,
    LaserState,
    LastSent,
    MotionState,
    PoseAt,
    Received,
    RequestResult,
    RobotStatus,
    RobotSync,
    SeamOffset,
    Source,
    Switch,
    TrackerCommand,
    TrackerHeartbeat,
    TrackerState,
    TrackerSyncEcho,
    Validity,
    Verdict,
    decide,
    forbidden_by,
    message_layout,
)
from tracker import flags
from tracker.state import NAN, Frame, Track

ARMING = (Command.ARM, Command.TRACK, Command.SEARCH, Command.HOLD)
"""The commands under which offsets may go out."""

_REFUSED = SeamOffset(NAN, NAN, NAN, NAN, Validity.REFUSED)


class Controller:
    """Controller of the tracker's messages on the bus.

    All times are on one clock, which the caller chooses. Times that run backwards make earlier messages
    stale.

    A robot that is armed already as the controller begins must be disarmed first: it may still stand where a
    tracker before this one sent it, and the first offset after arming is zero.

    The first offset is zero after whatever may have made the robot go back to its path: a command that is
    not one of `ARMING`, another job, a correction that was not ON, or more than `hold_s` without a command or
    a status, for such a silence may hide each of these.

    Parameters
    ----------
    job : Job or mapping of int to Job
        What is tracked, and how; or jobs by the number by which `TrackerCommand` names them. A number that
        none of them has is refused.
    source : Source
        Where frames and poses come from. Frames are protected by whoever sends the messages.
    policy : ServicePolicy
        How long what was heard is trusted.
    finder : JointFinder, optional
        What answers a FIND; without one each is refused.

    Attributes
    ----------
    verdicts : Counter of Verdict
        What became of the offsets of all tracks.
    reasons : Counter of GateReason
        Why they were held or refused.
    gate_reason : GateReason
        Why the offset of the newest track did not go out as it was measured; NONE if it did.
    """

    def __init__(
        self,
        job: Job | Mapping[int, Job],
        source: Source = Source.LIVE,
        policy: ServicePolicy | None = None,
        finder: JointFinder | None = None,
    ) -> None:
        self.verdicts: Counter[Verdict] = Counter()
        self.reasons: Counter[GateReason] = Counter()
        self.gate_reason = GateReason.NONE
        self._jobs = job
        self._source = source
        self._policy = policy or ServicePolicy()
        self._part, self._bus_delay = PartWatch(), BusDelay(self._policy)
        self._find = FindResponder(finder)
        self._robot: TimedMessage[RobotStatus] | None = None
        self._command: TimedMessage[TrackerCommand] | None = None
        self._poses_doubt, self._poses_at_s = GateReason.POSE_IMPLAUSIBLE, NAN
        self._laser = LaserState.UNKNOWN
        self._dropped = 0
        self._fault = Fault.NONE
        self._closed = False
        self._was_disarmed = False
        self._outages = OutageWatch()
        self._request_number, self._request_result = 0, RequestResult.NONE
        self._zero_mm = (0.0, 0.0)
        self._track, self._track_at_s = NO_TRACK, NAN
        self._last_sent = self._sent_before = LastSent()
        self._now_s = -math.inf
        self._offset = _REFUSED
        self._refused_at_s, self._is_refusal_owed = NAN, False
        self._state = TrackerState.STARTING
        self._heartbeats = HeartbeatSchedule(source)

    @property
    def job(self) -> Job:
        """The job that the robot names; `NO_JOB` while it names none that there is."""
        if isinstance(self._jobs, Job):
            return self._jobs
        number = None if self._command is None else self._command.message.job_number
        return NO_JOB if number is None else self._jobs.get(number, NO_JOB)

    @property
    def state(self) -> TrackerState:
        """State that was sent last."""
        return self._state

    @property
    def is_finding(self) -> bool:
        """True while a FIND waits for its answer."""
        return self._find.is_pending

    @property
    def fault(self) -> Fault:
        """Fault that holds until the robot commands RESET."""
        return self._fault

    def is_laser_on(self, now_s: float) -> bool:
        """Return True if the laser may be on: for this job, commanded by a robot, and no fault."""
        command = self._fresh_command(now_s)
        return (
            command is not None
            and self.job.uses_laser
            and command.laser_enable is Switch.ON
            and command.command not in (Command.DISARM, Command.RESET)
            and self._fault is Fault.NONE
            and not self._closed
        )

    def is_armed(self, now_s: float) -> bool:
        """Return True if the robot commands that offsets may go out."""
        command = self._fresh_command(now_s)
        return command is not None and command.command in ARMING

    def on_message(self, received: Received, now_s: float) -> list[BusMessage]:
        """Take an accepted message, and return what answers it.

        Parameters
        ----------
        received : Received
            A message off the bus. One that a tracker sends is not ours: another tracker is there.
        now_s : float
            The time of its reading, s; it came at most `received.max_age_s` before.

        Returns
        -------
        list of BusMessage
            The echo of a RobotSync; else empty. `poll` says what else follows.
        """
        message, came_at_s = received.message, now_s - received.max_age_s
        self._follow_clock(now_s)
        if self._outages.hear(message, came_at_s, now_s, self.job.limits.hold_s):
            self._forget_offset()
        if message_layout(type(message).__name__).senders == ["TRACKER"]:
            self._fault = Fault.OTHER_TRACKER
        elif isinstance(message, RobotStatus):
            self._robot = TimedMessage(message, came_at_s)
            if message.correction is not Switch.ON:
                self._forget_offset()
        elif isinstance(message, TrackerCommand):
            self._obey(message, came_at_s, now_s)
        elif isinstance(message, RobotSync):
            self._bus_delay.hear(message, came_at_s)
            delay_us = round(1e6 * received.max_age_s)
            known = 0 <= delay_us <= 1_048_574
            return [TrackerSyncEcho(message.sequence, delay_us if known else None, self._source)]
        self._judge_find(now_s)
        return []

    def on_shown(self, frame: Frame, pose: PoseAt, is_doubted: bool, now_s: float) -> None:
        """Take a frame with its pose, for a FIND; `is_doubted` says that poses are not trusted."""
        self._judge_find(now_s)
        robot = self._fresh_robot(now_s)
        is_moving = robot is not None and robot.motion is MotionState.MOVING
        self._find.see(frame, pose, is_doubted, is_moving, now_s)

    def on_poses(self, doubt: GateReason, now_s: float) -> None:
        """Take the verdict on the newest poses: NONE, POSE_IMPLAUSIBLE or ROBOT_ELSEWHERE."""
        self._poses_doubt, self._poses_at_s = doubt, now_s

    def on_laser(self, laser: LaserState) -> None:
        """Take what the laser does."""
        self._laser = laser

    def on_dropped(self, dropped: int) -> None:
        """Take how many frames were dropped since the start."""
        self._dropped = dropped

    def on_track(
        self, track: Track, now_s: float, T_base_tool: Float64 | None = None, latency_ms: float = NAN
    ) -> list[BusMessage]:
        """Take a frame's result, and return what is to be sent.

        Parameters
        ----------
        track : Track
            The frame's result, its capture on the controller's clock.
        now_s : float
            The time, s.
        T_base_tool : array (4, 4), optional
            The pose at the capture, mm.
        latency_ms : float
            How long the track took, ms; NaN if nobody timed it.

        Returns
        -------
        list of BusMessage
            One SeamOffset, SeamPoint, SeamGeometry and TrackerStatus, behind what is due of version and
            heartbeat.
        """
        self._follow_clock(now_s)
        self._track, self._track_at_s = track, now_s
        self._judge_part(track, T_base_tool, now_s)
        conditions = self._conditions(track, now_s)
        decision = decide(
            tracker_messages.proposal(track, self._zero_mm),
            conditions,
            self.job.limits,
            self._last_sent,
            now_s,
        )
        self.gate_reason = decision.reason
        self._sent_before, self._last_sent = self._last_sent, decision.last_sent
        self._offset, self._is_refusal_owed = decision.message, False
        self.verdicts[decision.verdict] += 1
        if decision.verdict is not Verdict.SEND:
            self.reasons[decision.reason] += 1
        self._state = self._state_of(track, decision.verdict, now_s)
        return [
            *self._due(now_s),
            decision.message,
            tracker_messages.seam_point(track, T_base_tool),
            tracker_messages.geometry(track, JointType[self.job.joint_type.upper()]),
            tracker_messages.status(
                track, self._state, decision.reason, conditions.robot is None, latency_ms, self._dropped
            ),
        ]

    def poll(self, now_s: float) -> list[BusMessage]:
        """Return the messages that are due.

        Version, heartbeat, REFUSED where an offset holds no longer, the answer to a FIND.
        """
        self._follow_clock(now_s)
        answers = self._find_answers(now_s)
        if not self._track_at_s <= now_s:
            # It begins, or the clock was set back: from now on a camera has its time.
            self._track_at_s = now_s
        is_camera_stopped = now_s - self._track_at_s > self._policy.camera_timeout_s
        reason = forbidden_by(self._conditions(self._track, now_s, is_camera_stopped), self.job.limits)
        refused = self._offset.validity is Validity.REFUSED
        is_repeated = is_camera_stopped and self._is_due(self._refused_at_s, now_s)
        is_refusal_sent = refused and not (is_repeated or self._is_refusal_owed)
        if reason is GateReason.NONE or is_refusal_sent:
            self._state = self._state_of(self._track, None, now_s)
            return [*answers, *self._due(now_s)]
        return [*self._refuse(reason, now_s), *answers, *self._due(now_s)]

    def unsent(self, message: BusMessage) -> None:
        """Take back a message that did not go out.

        What the robot did not receive is neither held nor followed; a refusal is sent again.
        """
        if message is self._offset:
            self._last_sent = self._sent_before
            self._is_refusal_owed = self._offset.validity is Validity.REFUSED

    def close(self, now_s: float) -> list[BusMessage]:
        """Return the last messages, REFUSED first; nothing is VALID any more."""
        self._closed = True
        self._heartbeats.hurry()
        refused = self._refuse(GateReason.SHUTTING_DOWN, now_s)
        return [*refused, *self._find_answers(now_s), *self._due(now_s)]

    def _follow_clock(self, now_s: float) -> None:
        """Note the time; where the clock was set back, what was sent is as old as it was a moment ago."""
        back_s = self._now_s - now_s
        if 0.0 < back_s < math.inf:
            # Else, once the clock is there again, it would pass for new.
            self._last_sent = self._last_sent.set_back(back_s)
            self._sent_before = self._sent_before.set_back(back_s)
            self._outages.set_back(back_s)
        self._now_s = now_s

    def _forget_offset(self) -> None:
        """Let the next offset be zero: the robot may have gone back to its path."""
        self._last_sent = self._sent_before = LastSent()

    def _refuse(self, reason: GateReason, now_s: float) -> list[BusMessage]:
        self._refused_at_s = now_s
        self._is_refusal_owed = False
        self._offset, self._sent_before = _REFUSED, self._last_sent
        self._state = self._state_of(self._track, Verdict.REFUSE, now_s)
        is_stale = self._fresh_robot(now_s) is None
        return [
            _REFUSED,
            UNKNOWN_POINT,
            tracker_messages.status(self._track, self._state, reason, is_stale, NAN, self._dropped),
        ]

    def _conditions(self, track: Track, now_s: float, is_camera_stopped: bool = False) -> Conditions:
        """Return the conditions of an offset.

        A missing command does not forget what was sent: the robot still stands there.
        """
        newest = self._command
        command = None if newest is None else newest.message
        fault = GateReason.NONE
        if self._closed:
            fault = GateReason.SHUTTING_DOWN
        elif self._fault is not Fault.NONE:
            is_other = self._fault is Fault.OTHER_TRACKER
            fault = GateReason.OTHER_TRACKER if is_other else GateReason.PART_REFUSED
        elif newest is not None and self._fresh_command(now_s) is None:
            fault = GateReason.HEARTBEAT_LOST
        elif command is not None and self.job is NO_JOB:
            fault = GateReason.JOB_UNKNOWN
        doubt = GateReason.NONE
        if is_camera_stopped:
            doubt = GateReason.CAMERA_STOPPED
        elif command is not None and command.command is Command.SEARCH and not self.job.offsets_in_search:
            doubt = GateReason.SEARCH_ONLY
        elif self._bus_delay.doubt(now_s) is not GateReason.NONE:
            doubt = self._bus_delay.doubt(now_s)
        elif not self._part.is_fit(self.job):
            doubt = GateReason.PART_REFUSED
        elif self.job.poses_proven:
            is_fresh = 0.0 <= now_s - self._poses_at_s <= self._policy.poses_age_s
            doubt = self._poses_doubt if is_fresh else GateReason.POSE_IMPLAUSIBLE
        enable_y, enable_z = self.job.correction.enabled
        return Conditions(
            # A tracker that has stopped following is not to be held to its last offset: it refuses at once.
            armed=self._is_armed(command, track),
            enable_y=enable_y and command is not None and command.enable_y,
            enable_z=enable_z and command is not None and command.enable_z,
            robot=self._fresh_robot(now_s),
            fault=fault,
            doubt=doubt,
            hold=command is not None and command.command is Command.HOLD,
        )

    def _judge_part(self, track: Track, T_base_tool: Float64 | None, now_s: float) -> None:
        command, robot = self._fresh_command(now_s), self._fresh_robot(now_s)
        if command is None or command.command not in ARMING:
            return
        fault = self._part.look(track, T_base_tool, self.job, robot is not None and robot.arc is Switch.OFF)
        if self._fault is Fault.NONE:
            self._fault = fault

    def _is_armed(self, command: TrackerCommand | None, track: Track) -> bool:
        return (
            command is not None
            and command.command in ARMING
            and self._was_disarmed
            and not has(track, flags.FOLLOW_STOPPED)
        )

    def _state_of(self, track: Track, verdict: Verdict | None, now_s: float) -> TrackerState:
        if self._fault is not Fault.NONE:
            return TrackerState.FAULT
        if self._robot is None and self._command is None:
            return TrackerState.STARTING
        command = self._fresh_command(now_s)
        if command is None or self._closed or not self._is_armed(command, track):
            return TrackerState.DISARMED
        is_held = self._offset.validity is Validity.HELD if verdict is None else verdict is Verdict.HOLD
        if is_held or command.command is Command.HOLD or has(track, flags.OFFSET_HELD):
            return TrackerState.HOLDING
        if command.command is Command.SEARCH or not track.valid:
            return TrackerState.SEARCHING
        return TrackerState.TRACKING

    def _obey(self, command: TrackerCommand, came_at_s: float, now_s: float) -> None:
        before = self._command
        self._command = TimedMessage(command, came_at_s)
        if before is not None and before.message.job_number != command.job_number:
            # Another job's zero, and another job's seam.
            self._zero_mm = (0.0, 0.0)
            self._forget_offset()
            self._part.begin()
        if command.command not in ARMING:
            self._was_disarmed = True
            self._forget_offset()
            if command.command not in (Command.STORE_ZERO, Command.FIND):
                self._part.begin()
        if before is not None and before.message.request_number == command.request_number:
            return
        self._request_number, self._request_result = command.request_number, RequestResult.NONE
        if command.command is Command.RESET:
            self._fault = Fault.NONE
            self._request_result = RequestResult.DONE
        elif command.command is Command.FIND:
            self._find.ask(command, now_s)
        elif command.command is Command.STORE_ZERO:
            # Whether the first request after the start is a new one, nobody knows.
            zero_mm = tracker_messages.displacement(
                self._track, self.job.limits, self.job.correction.enabled, now_s
            )
            self._request_result = RequestResult.REFUSED
            if before is not None and zero_mm is not None:
                self._zero_mm, self._request_result = zero_mm, RequestResult.DONE

    def _judge_find(self, now_s: float) -> None:
        """Refuse a FIND that waits once it cannot be answered."""
        if not self._find.is_pending:
            return
        command, robot = self._fresh_command(now_s), self._fresh_robot(now_s)
        refusal = FindRefusal.NONE
        if self._closed:
            refusal = FindRefusal.SHUTTING_DOWN
        elif command is None or command.command is not Command.FIND or not self._find.is_asked_by(command):
            refusal = FindRefusal.WITHDRAWN
        elif self._fault is not Fault.NONE:
            refusal = FindRefusal.FAULT
        elif self.job is NO_JOB:
            refusal = FindRefusal.JOB_UNKNOWN
        elif robot is None:
            refusal = FindRefusal.ROBOT_STATUS_STALE
        elif robot.arc is not Switch.OFF:
            refusal = FindRefusal.ARC_ON
        elif self._bus_delay.doubt(now_s) is not GateReason.NONE:
            refusal = FindRefusal.BUS_DELAYED
        if refusal is not FindRefusal.NONE:
            self._find.refuse(refusal)

    def _find_answers(self, now_s: float) -> list[BusMessage]:
        """Return the answer to a FIND where it is there."""
        self._judge_find(now_s)
        answers = self._find.answers(self.job.part, now_s)
        for answer in answers:
            if isinstance(answer, FindResult) and answer.request_number == self._request_number:
                is_found = answer.refusal is FindRefusal.NONE
                self._request_result = RequestResult.DONE if is_found else RequestResult.REFUSED
        return answers

    def _fresh_robot(self, now_s: float) -> RobotStatus | None:
        return fresh(self._robot, now_s, self._policy.status_age_s)

    def _fresh_command(self, now_s: float) -> TrackerCommand | None:
        return fresh(self._command, now_s, self._policy.command_age_s)

    def _due(self, now_s: float) -> list[BusMessage]:
        """Return version and heartbeat where their time has come."""
        return self._heartbeats.due(self._heartbeat(now_s), now_s)

    def _is_due(self, since_s: float, now_s: float) -> bool:
        return not 0.0 <= now_s - since_s < self._policy.repeat_s

    def _obeyed_command(self, now_s: float) -> CommandHeard:
        command = self._fresh_command(now_s)
        if command is None:
            return CommandHeard.NONE if self._command is None else CommandHeard.LOST
        return CommandHeard.DISARM if command.command is Command.DISARM else CommandHeard.OTHER

    def _heartbeat(self, now_s: float) -> TrackerHeartbeat:
        job_number = None if self._command is None else self._command.message.job_number
        return TrackerHeartbeat(
            state=self._state,
            source=self._source,
            laser=self._laser,
            fault=self._fault,
            request_number=self._request_number,
            request_result=self._request_result,
            job_number=job_number,
            rolling=0,
            command_heard=self._obeyed_command(now_s),
        )
