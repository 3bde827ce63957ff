"""Poses off the bus: where the tool was at a capture, whether that is trusted, how late the robot follows."""

import math
from collections.abc import Callable

from arctrack.control.innovation import InnovationLimits, SeamMeasurement
from arctrack.control.look_ahead import LagEstimator, LagNow, LookAhead
from arctrack.control.policy import ServicePolicy
from arctrack.control.pose_watch import Doubt, PoseWatch
from noise_model.compiled.arrays import Float64
from robot_io import GateReason, PoseAt, PoseBuffer, PoseError, PoseSample, Received, SeamOffset
from robot_io.clocks.sync import SyncLimits
from robot_io.poses.nominal_path import NominalPath
from robot_io.poses.plausibility_limits import PlausibilityLimits
from tracker.state import AT_ONCE, OffsetLookAhead


class BusPoses:
    """Tool poses from the robot's messages, and whether they are trusted.

    `path` is the nominal seam. `T_controllertool_tool` (4, 4) is the tool in the tool frame of the controller
    that sends the poses, mm; by default they are one. The controller stamps its poses `late_s` later than
    true. `lag_estimator` estimates the robot's lag where an offset must not wait for it; by default it is
    estimated at once.

    With `looks_ahead` offsets are asked for where the torch will be once they act. `doubt` says why poses
    were not trusted at the latest verdict (None if they were). `on_sample` gets each pose, its time on the
    frames' clock, and when it was read, s.
    """

    def __init__(
        self,
        path: NominalPath,
        limits: PlausibilityLimits,
        seam_limits: InnovationLimits,
        policy: ServicePolicy,
        T_controllertool_tool: Float64 | None = None,
        late_s: float = 0.0,
        lag_estimator: LagEstimator | None = None,
    ) -> None:
        self._path, self._limits, self._seam_limits = path, limits, seam_limits
        self._status_age_s = policy.status_age_s
        self._T_controllertool_tool = T_controllertool_tool
        self._late_s, self._lag_estimator = late_s, lag_estimator
        self.looks_ahead = True
        self.on_sample: Callable[[PoseSample, float], None] | None = None
        self._wait_s = policy.pose_wait_s
        self.begin()

    def begin(self) -> None:
        """Reset to the state of a new process."""
        self.watch = PoseWatch(
            self._path,
            self._limits,
            self._seam_limits,
            SyncLimits(),
            self._status_age_s,
            self._T_controllertool_tool,
        )
        self.look_ahead = LookAhead(self._path, estimator=self._lag_estimator or LagNow())
        self.doubt: Doubt | None = None
        self._forget_poses()

    def hear(self, received: Received, now_s: float) -> None:
        """Take an accepted message of any type, read at a time, s."""
        self.look_ahead.hear(received.message)
        sample = self.watch.hear(received, now_s)
        if sample is None:
            return
        if self.on_sample is not None:
            self.on_sample(sample, now_s)
        self.look_ahead.see(sample, self.watch.doubt(now_s) is None)
        try:
            self._buffer.push_quaternion(sample.timestamp_s, sample.position_base_mm, sample.quaternion_xyzw)
            self._newest_s = sample.timestamp_s
        except PoseError:
            # A clock was set: what is older says nothing of now.
            self._forget_poses()

    def is_settled(self, captured_s: float, now_s: float) -> bool:
        """Return True if the pose of a capture is known as well as it will be: the one after it has come."""
        stamped_s = captured_s + self._late_s
        return self._newest_s >= stamped_s or not 0.0 <= now_s - stamped_s < self._wait_s

    def at(self, captured_s: float) -> PoseAt:
        """Return the tool's pose at a capture."""
        return self._buffer.at(captured_s + self._late_s)

    def see(self, measured: SeamMeasurement, is_valid: bool) -> None:
        """Take where a pose put the seam that was seen; a tack's bead jumps, and is no fault of the poses."""
        if is_valid:
            self.watch.see(measured)

    def verdict(self, now_s: float) -> GateReason:
        """Return the poses' verdict for the gate."""
        self.doubt = self.watch.doubt(now_s)
        return GateReason.NONE if self.doubt is None else GateReason.POSE_IMPLAUSIBLE

    def are_trusted(self, now_s: float) -> bool:
        """Return True if the poses are trusted now: measurements by them may be kept."""
        return self.watch.doubt(now_s) is None

    def offset_look_ahead(self, now_s: float) -> OffsetLookAhead:
        """Return the look-ahead of an offset."""
        if self._lag_estimator is None:
            self.look_ahead.update(now_s)
        return self.look_ahead.offset_look_ahead() if self.looks_ahead else AT_ONCE

    def rest(self, now_s: float) -> None:
        """Do what takes longer, while no frame waits."""
        self.look_ahead.update(now_s)

    def sent(self, offset: SeamOffset, now_s: float) -> None:
        """Take an offset that went out at a time, s."""
        self.look_ahead.sent(offset, now_s)

    def _forget_poses(self) -> None:
        self._buffer, self._newest_s = PoseBuffer(256), -math.inf
