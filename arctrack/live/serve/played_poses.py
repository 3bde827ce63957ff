"""The poses of a recording that is played: its own, while the robot on the bus stands where they say."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from arctrack.control.innovation import SeamMeasurement
from arctrack.control.policy import ServicePolicy
from arctrack.control.pose_agreement import PoseAgreement
from arctrack.control.pose_watch import Doubt
from arctrack.control.recorded_poses import RecordedPoses
from arctrack.recording import Recording
from arctrack.recording.steps import RecordedStep
from noise_model.effects import pose_time_s
from robot_io import GateReason, PoseAt, PoseStatus, Received, SeamOffset
from robot_io.poses.plausibility_limits import PlausibilityLimits
from tracker.state import AT_ONCE, OffsetLookAhead


class PlayedPoses:
    """Poses of a recording with the plausibility doubts that a replay has.

    `on_begin` is called where the recorded seam begins again with the requested pose.
    """

    def __init__(self, recording: Recording, limits: PlausibilityLimits, policy: ServicePolicy) -> None:
        self._setup, self._buffer = recording.setup, recording.pose_buffer()
        self._agreement = PoseAgreement(self._buffer)
        self._trust = RecordedPoses(recording, limits)
        # A live run's steps, by the time of their frames: they say how it went on.
        steps = {} if recording.steps is None else recording.steps.steps
        self._steps = {row.timestamp_s: steps[row.index] for row in recording.rows if row.index in steps}
        self._step: RecordedStep | None = None
        self.on_begin: Callable[[], None] | None = None
        self._poses_age_s = policy.poses_age_s
        self._place, self._place_at_s = GateReason.ROBOT_ELSEWHERE, -math.inf

    @property
    def doubt(self) -> Doubt | None:
        """Reason for which the recorded poses were not trusted at the latest verdict, or None."""
        return self._trust.doubt

    def begin(self) -> None:
        """Do nothing: a recording has one seam."""

    def hear(self, received: Received, now_s: float) -> None:
        """Take a message: a pose of the robot says whether it stands where the recording's did."""
        verdict = self._agreement.verdict(received, now_s)
        if verdict is not None:
            self._place, self._place_at_s = verdict, now_s

    def is_settled(self, captured_s: float, now_s: float) -> bool:
        """Return that the pose is known: all are, and the buffer gives what a live run would have."""
        return True

    def at(self, captured_s: float) -> PoseAt:
        """Return the recorded pose at a capture."""
        buffered = self._buffer.at(pose_time_s(self._setup, captured_s))
        step = self._step = self._steps.get(captured_s)
        if step is None:
            return buffered
        if step.begins and self.on_begin is not None:
            self.on_begin()
        if step.pose is None:
            return replace(buffered, status=PoseStatus.REFUSED)
        status = PoseStatus.EXTRAPOLATED if step.pose.extrapolated else PoseStatus.INTERPOLATED
        return replace(buffered, status=status, T_base_tool=step.pose.T_base_tool)

    def see(self, measured: SeamMeasurement) -> None:
        """Take where a pose put the seam that was seen."""
        self._trust.see(measured)

    def verdict(self, now_s: float) -> GateReason:
        """Return the doubt of the recorded poses, else whether the robot on the bus is elsewhere."""
        recorded = self._trust.verdict(now_s)
        if recorded is not GateReason.NONE:
            return recorded
        is_fresh = 0.0 <= now_s - self._place_at_s <= self._poses_age_s
        return self._place if is_fresh else GateReason.ROBOT_ELSEWHERE

    def are_trusted(self, now_s: float) -> bool:
        """Return that it may, as in a replay, unless the run that was recorded did not keep it."""
        return self._step is None or self._step.keeps_state

    def offset_look_ahead(self, now_s: float) -> OffsetLookAhead:
        """Return none: the robot that was recorded follows nobody now; it may have done so then."""
        return AT_ONCE if self._step is None else self._step.look_ahead

    def sent(self, offset: SeamOffset, now_s: float) -> None:
        """Do nothing: the robot that was recorded follows nobody."""

    def rest(self, now_s: float) -> None:
        """Do nothing."""
