"""Poses of a recording, and their trust by the watch of a live run."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.control.innovation import InnovationLimits, SeamMeasurement, SeamMotion
from arctrack.control.policy import ServicePolicy
from arctrack.control.pose_watch import Doubt, PoseWatch, nominal_path
from arctrack.errors import in_file
from arctrack.recording import Recording
from arctrack.recording.live_steps import RecordedStep
from arctrack.recording.poses import LOG_NAMES, can_channel
from noise_model.effects import pose_time_s
from noise_model.transforms import invert
from robot_io import (
    BusLogError,
    BusLogReader,
    GateReason,
    PoseAssembler,
    PoseAt,
    PoseBuffer,
    PoseKind,
    PoseSample,
    PoseStatus,
    Received,
    RobotStatus,
    SeamOffset,
)
from robot_io.clocks.sync import SyncLimits
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_questions import Implausibility
from robot_io.stated_limit import stated
from tracker.state import AT_ONCE, NAN, OffsetLookAhead


@dataclass(frozen=True)
class AgreementPolicy:
    """Largest difference of the two. Each field's metadata states `unit`, `role` and `source`."""

    position_mm: float = stated(
        5.0,
        "mm",
        "largest distance of the two tools",
        "half a second at 10 mm/s: as well as two programs are started together by hand",
    )
    rotation_deg: float = stated(
        3.0,
        "deg",
        "largest angle between the two tools",
        "50 mm from tool to stripe turn it into 2.6 mm, half of what the position may be off",
    )


class PoseAgreement:
    """Comparison of each pose off the bus with the recording's pose at the same time.

    A pose counts for `max_age_s` after its reading.
    """

    def __init__(self, poses: PoseBuffer, max_age_s: float) -> None:
        self._poses, self._max_age_s, self._policy = poses, max_age_s, AgreementPolicy()
        self._assembler = PoseAssembler()
        self._latest, self._read_at_s = GateReason.POSE_IMPLAUSIBLE, NAN

    def hear(self, received: Received, now_s: float) -> None:
        """Take a message, read at a time on the recording's clock, s."""
        sample = self._assembler.push(received)
        if sample is None or sample.kind is not PoseKind.ACTUAL:
            return
        sampled_at_s = now_s - received.max_age_s - (received.timestamp_s - sample.timestamp_s)
        is_there = self._agrees(sample, self._poses.at(sampled_at_s))
        self._latest, self._read_at_s = GateReason.NONE if is_there else GateReason.ROBOT_ELSEWHERE, now_s

    def verdict(self, now_s: float) -> GateReason:
        """Return NONE, ROBOT_ELSEWHERE, or POSE_IMPLAUSIBLE where no pose tells."""
        is_fresh = 0.0 <= now_s - self._read_at_s <= self._max_age_s
        return self._latest if is_fresh else GateReason.POSE_IMPLAUSIBLE

    def _agrees(self, sample: PoseSample, recorded: PoseAt) -> bool:
        """Return whether a robot stands where the recording's stood; not where the recording has no pose."""
        if recorded.status is PoseStatus.REFUSED:
            return False
        apart_mm = float(np.linalg.norm(recorded.T_base_tool[:3, 3] - sample.position_base_mm))
        turn = Rotation.from_quat(sample.quaternion_xyzw).inv() * Rotation.from_matrix(
            recorded.T_base_tool[:3, :3]
        )
        turned_deg = math.degrees(turn.magnitude())
        return apart_mm <= self._policy.position_mm and turned_deg <= self._policy.rotation_deg


LOOK_BACK_S, MIN_LOOKS = 0.4, 10
"""Time, s, and least number of frames over which the seam in the image is held against the poses.

Two bad frames then fail no window, whatever the frame rate: each counts for 4 sigmas in 2 axes at most.
"""


class RecordedPoses:
    """Poses of a recording, and their plausibility as its frames go by.

    A CAN log has what the robot said: its motion, its program, its clock. `poses.csv` has poses alone; then
    progress along the path is not tested, and the image tells a pose that stands still. Samples need no age:
    a recording's clocks are taken as they are, and its own limits hold for the age of a sample and the gap
    between two.

    Once the image has contradicted the poses, they are not trusted to the recording's end: the torch comes
    only later to what was measured with them.

    A frame of a live run, as a black box keeps it, has the pose and the look-ahead that it had there.
    `on_begin` is called where the seam began again in that run. With `has_robot` a live robot listens: it
    must stand where the recording's stood.

    `doubt` says why poses were not trusted at the latest verdict (None if they were); `hears_robot` says that
    a RobotStatus was recorded so far.
    """

    def __init__(
        self,
        recording: Recording,
        limits: PlausibilityLimits | None = None,
        policy: ServicePolicy | None = None,
        has_robot: bool = False,
    ) -> None:
        limits, policy = limits or PlausibilityLimits(), policy or ServicePolicy()
        self.doubt: Doubt | None = Implausibility.UNPROVEN
        self.hears_robot = False
        self.on_begin: Callable[[], None] | None = None
        self._setup, self._buffer = recording.setup, recording.pose_buffer()
        self._agreement = PoseAgreement(self._buffer, policy.poses_age_s) if has_robot else None
        times_s = [row.timestamp_s for row in recording.rows]
        # All in one call takes a fraction of the time.
        poses = self._buffer.at_all([pose_time_s(self._setup, time_s) for time_s in times_s])
        self._poses = dict(zip(times_s, poses, strict=True))
        steps = {} if recording.steps is None else recording.steps.steps
        self._steps = {row.timestamp_s: steps[row.index] for row in recording.rows if row.index in steps}
        self._step: RecordedStep | None = None
        # Poses have stopped after four periods without one, where that is longer than the limit.
        gap_s = max(limits.gap_s, 4.0 * recording.poses.period_s)
        self._watch = PoseWatch(
            nominal_path(recording.setup.joint),
            replace(limits, age_required=False, gap_s=gap_s),
            seam_limits(recording.frame_rate_hz),
            SyncLimits(),
            ServicePolicy().status_age_s,
            T_controllertool_tool=invert(recording.T_tool_controllertool),
        )
        self._coming = _coming(recording)
        self._next = next(self._coming, None)
        self._is_contradicted = False

    def begin(self) -> None:
        """Do nothing: a recording has one seam."""

    def hear(self, received: Received, now_s: float) -> None:
        """Take a message: a pose of a live robot says whether it stands where the recording's did."""
        if self._agreement is not None:
            self._agreement.hear(received, now_s)

    def is_settled(self, captured_s: float, now_s: float) -> bool:
        """Return that the pose is known: all are, and the buffer gives what a live run would have."""
        return True

    def at(self, captured_s: float) -> PoseAt:
        """Return the recorded pose at a capture."""
        pose = self._poses.get(captured_s) or self._buffer.at(pose_time_s(self._setup, captured_s))
        step = self._step = self._steps.get(captured_s)
        if step is None:
            return pose
        if step.begins and self.on_begin is not None:
            self.on_begin()
        if step.pose is None:
            return replace(pose, status=PoseStatus.REFUSED)
        status = PoseStatus.EXTRAPOLATED if step.pose.extrapolated else PoseStatus.INTERPOLATED
        return replace(pose, status=status, T_base_tool=step.pose.T_base_tool)

    def see(self, measured: SeamMeasurement, is_valid: bool) -> None:
        """Take where a pose put the seam that was seen, valid or not.

        Where no status says how the robot moves, a seam that jumps is the first that wrong poses show.
        """
        self._watch.see(measured)

    def are_trusted(self, now_s: float) -> bool:
        """Return that it may, unless the run that was recorded did not keep it."""
        return self._step is None or self._step.keeps_state

    def offset_look_ahead(self, now_s: float) -> OffsetLookAhead:
        """Return that of the run that was recorded: nobody follows these offsets."""
        return AT_ONCE if self._step is None else self._step.look_ahead

    def sent(self, offset: SeamOffset, now_s: float) -> None:
        """Do nothing: the robot that was recorded follows nobody."""

    def rest(self, now_s: float) -> None:
        """Do nothing."""

    def verdict(self, now_s: float) -> GateReason:
        """Return the verdict on the recorded poses, else on where a live robot stands.

        Times are on the recording's clock, s, and rise from call to call. Raises ArctrackError if the log
        cannot be read.
        """
        while self._next is not None and self._next.timestamp_s <= now_s:
            self._take(self._next)
            self._next = next(self._coming, None)
        self.doubt = self._watch.doubt(now_s)
        if self.doubt is SeamMotion.CONTRADICTED:
            self._is_contradicted = True
        elif self.doubt is None and self._is_contradicted:
            self.doubt = SeamMotion.CONTRADICTED
        if self.doubt is not None:
            return GateReason.POSE_IMPLAUSIBLE
        return GateReason.NONE if self._agreement is None else self._agreement.verdict(now_s)

    def _take(self, came: Received | PoseSample) -> None:
        if isinstance(came, PoseSample):
            self._watch.take(came, came.timestamp_s)
            return
        self.hears_robot |= isinstance(came.message, RobotStatus)
        self._watch.hear(came, came.timestamp_s)


def seam_limits(frame_rate_hz: float) -> InnovationLimits:
    """Return the limits of the seam's innovation: the window is of time, not of frames."""
    limits = InnovationLimits()
    if not frame_rate_hz * LOOK_BACK_S < limits.window:
        return limits
    return replace(limits, window=max(MIN_LOOKS, math.ceil(frame_rate_hz * LOOK_BACK_S)))


def _coming(recording: Recording) -> Iterator[Received | PoseSample]:
    """Yield what a live run would have received; ArctrackError if the log cannot be read."""
    poses = recording.poses
    if poses.path.name in LOG_NAMES:
        try:
            yield from BusLogReader(poses.path, can_channel(recording.robot))
        except BusLogError as error:
            raise in_file(poses.path, str(error).removeprefix(f"log {poses.path}: ")) from None
        return
    quaternions = Rotation.from_matrix(poses.T_base_tool[:, :3, :3]).as_quat()
    for timestamp_s, T_base_tool, quaternion in zip(
        poses.timestamps_s, poses.T_base_tool, quaternions, strict=True
    ):
        x_mm, y_mm, z_mm = T_base_tool[:3, 3].tolist()
        qx, qy, qz, qw = quaternion.tolist()
        yield PoseSample(float(timestamp_s), (x_mm, y_mm, z_mm), (qx, qy, qz, qw), PoseKind.ACTUAL, math.nan)
