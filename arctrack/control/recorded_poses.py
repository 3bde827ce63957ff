"""Trust in a recording's poses, frame by frame, by the watch of a live run."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from scipy.spatial.transform import Rotation

from arctrack.control.innovation import InnovationLimits, SeamMeasurement, SeamMotion
from arctrack.control.policy import ServicePolicy
from arctrack.control.pose_watch import Doubt, PoseWatch, nominal_path
from arctrack.errors import in_file
from arctrack.recording import Recording
from arctrack.recording.poses import LOG_NAMES, can_channel
from noise_model.transforms import invert
from robot_io import BusLogError, BusLogReader, GateReason, PoseKind, PoseSample, Received, RobotStatus
from robot_io.clocks.sync import SyncLimits
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_questions import Implausibility

LOOK_BACK_S, MIN_LOOKS = 0.4, 10
"""The seam in the image is asked over so long, and over so many frames at least.

Two bad frames then fail no window, whatever the frame rate: each counts for 4 sigmas in 2 axes at most.
"""


class RecordedPoses:
    """Plausibility of a recording's poses as its frames go by.

    A CAN log has what the robot said: its motion, its program, its clock. `poses.csv` has poses alone; then
    progress along the path is not tested, and the image tells a pose that stands still. Samples need no age:
    a recording's clocks are taken as they are, and its own limits hold for the age of a sample and the gap
    between two.

    Once the image has contradicted the poses, they are not trusted to the recording's end: the torch comes
    only later to what was measured with them.

    `doubt` says why poses were not trusted at the latest verdict (None if they were); `hears_robot` says that
    a RobotStatus was recorded so far.
    """

    def __init__(self, recording: Recording, limits: PlausibilityLimits) -> None:
        self.doubt: Doubt | None = Implausibility.UNPROVEN
        self.hears_robot = False
        self._path = recording.poses.path
        T_tool_controllertool = recording.T_tool_controllertool
        # Number of periods without a pose after which poses have stopped, where that is longer than the
        # limit.
        self._watch = PoseWatch(
            nominal_path(recording.setup.joint),
            replace(
                limits,
                age_required=False,
                gap_s=max(limits.gap_s, 4.0 * recording.poses.period_s),
            ),
            seam_limits(recording.frame_rate_hz),
            SyncLimits(),
            ServicePolicy().status_age_s,
            T_controllertool_tool=invert(T_tool_controllertool),
        )
        self._coming = _coming(recording)
        self._next = next(self._coming, None)
        self._is_contradicted = False

    def see(self, seam: SeamMeasurement | None) -> None:
        """Take what a frame showed of the seam; None where it showed none."""
        if seam is not None:
            self._watch.see(seam)

    def verdict(self, now_s: float) -> GateReason:
        """Return the verdict for the gate at a time on the recording's clock, s.

        Times rise from call to call. Raises ArctrackError if the log cannot be read.
        """
        try:
            while self._next is not None and self._next.timestamp_s <= now_s:
                self._take(self._next)
                self._next = next(self._coming, None)
        except BusLogError as error:
            raise in_file(self._path, str(error).removeprefix(f"log {self._path}: ")) from None
        self.doubt = self._watch.doubt(now_s)
        if self.doubt is SeamMotion.CONTRADICTED:
            self._is_contradicted = True
        elif self.doubt is None and self._is_contradicted:
            self.doubt = SeamMotion.CONTRADICTED
        return GateReason.NONE if self.doubt is None else GateReason.POSE_IMPLAUSIBLE

    def _take(self, came: Received | PoseSample) -> None:
        if isinstance(came, PoseSample):
            self._watch.take(came, came.timestamp_s)
            return
        self.hears_robot |= isinstance(came.message, RobotStatus)
        self._watch.hear(came, came.timestamp_s)


def seam_limits(frame_rate_hz: float) -> InnovationLimits:
    """Return what the seam in the image must keep to: the window is of time, not of frames."""
    limits = InnovationLimits()
    if not frame_rate_hz * LOOK_BACK_S < limits.window:
        return limits
    return replace(limits, window=max(MIN_LOOKS, math.ceil(frame_rate_hz * LOOK_BACK_S)))


def _coming(recording: Recording) -> Iterator[Received | PoseSample]:
    """Yield what a live run would have received."""
    poses = recording.poses
    if poses.path.name in LOG_NAMES:
        yield from BusLogReader(poses.path, can_channel(recording.robot))
        return
    quaternions = Rotation.from_matrix(poses.T_base_tool[:, :3, :3]).as_quat()
    for timestamp_s, T_base_tool, quaternion in zip(
        poses.timestamps_s, poses.T_base_tool, quaternions, strict=True
    ):
        x_mm, y_mm, z_mm = T_base_tool[:3, 3].tolist()
        qx, qy, qz, qw = quaternion.tolist()
        yield PoseSample(float(timestamp_s), (x_mm, y_mm, z_mm), (qx, qy, qz, qw), PoseKind.ACTUAL, math.nan)
