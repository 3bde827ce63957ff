"""The poses of a recording that is played: its own, while the robot on the bus stands where they say."""

from __future__ import annotations

import math

from arctrack.pose_agreement import PoseAgreement
from arctrack.recorded_poses import RecordedPoses
from arctrack.recording import Recording
from arctrack.service.policy import ServicePolicy
from noise_model.effects import pose_time_s
from robot_io import GateReason, PoseAt, Received, SeamOffset
from robot_io.poses.plausibility_limits import PlausibilityLimits
from tracker.seam.innovation import SeamMeasured
from tracker.seam.steer import AT_ONCE, Lead


class PlayedPoses:
    """Gives the poses that a replay gives, and the same doubts of them.

    Parameters
    ----------
    recording : Recording
        The recording.
    limits : PlausibilityLimits
        What its poses must keep to.
    policy : ServicePolicy
        How long the place of the robot on the bus counts.
    """

    def __init__(self, recording: Recording, limits: PlausibilityLimits, policy: ServicePolicy) -> None:
        self._setup, self._buffer = recording.setup, recording.pose_buffer()
        self._agreement = PoseAgreement(self._buffer)
        self._trust = RecordedPoses(recording, limits)
        self._poses_age_s = policy.poses_age_s
        self._place, self._place_at_s = GateReason.ROBOT_ELSEWHERE, -math.inf

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
        return self._buffer.at(pose_time_s(self._setup, captured_s))

    def see(self, measured: SeamMeasured) -> None:
        """Take where a pose put the seam that was seen."""
        self._trust.see(measured)

    def verdict(self, now_s: float) -> GateReason:
        """Return the doubt of the recorded poses, else whether the robot on the bus is elsewhere."""
        recorded = self._trust.verdict(now_s)
        if recorded is not GateReason.NONE:
            return recorded
        is_fresh = 0.0 <= now_s - self._place_at_s <= self._poses_age_s
        return self._place if is_fresh else GateReason.ROBOT_ELSEWHERE

    def may_last(self, now_s: float) -> bool:
        """Return that it may: a replay keeps what it measured."""
        return True

    def lead(self, now_s: float) -> Lead:
        """Return none: the robot that was recorded follows nobody."""
        return AT_ONCE

    def sent(self, offset: SeamOffset, now_s: float) -> None:
        """Do nothing: the robot that was recorded follows nobody."""

    def rest(self, now_s: float) -> None:
        """Do nothing."""
