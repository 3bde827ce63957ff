"""Trust in poses: by themselves, by the robot's messages, and by the seam in the image."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.control.innovation import InnovationLimits, SeamInnovation, SeamMeasurement, SeamMotion
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import Joint
from robot_io import (
    Command,
    PoseAssembler,
    PoseKind,
    PoseSample,
    Received,
    RobotStatus,
    RobotSync,
    TrackerCommand,
)
from robot_io.clocks.sync import ClockSync, SyncLimits
from robot_io.poses.nominal_path import NominalPath
from robot_io.poses.plausibility import Plausibility, clock_set, update
from robot_io.poses.plausibility_limits import PlausibilityLimits
from robot_io.poses.pose_questions import Implausibility, PoseArrival

BEGINNING = (Command.DISARM, Command.RESET)
"""With these commands a new seam begins: what was before says nothing of it."""

Doubt = Implausibility | SeamMotion
"""Why poses are not trusted."""


class PoseWatch:
    """Judge of whether poses are to be trusted, from the bus and the seam in the image.

    Poses are plausible once they have shown enough. The seam in the image need not have: only its
    contradiction counts.

    Without `path`, the nominal seam, fewer tests apply. A RobotStatus older than `status_age_s` does not say
    how the robot moves. `T_controllertool_tool` (4, 4) is the tool in the tool frame of the controller that
    sends the poses, mm; by default they are one.
    """

    def __init__(
        self,
        path: NominalPath | None,
        limits: PlausibilityLimits,
        seam_limits: InnovationLimits,
        sync_limits: SyncLimits,
        status_age_s: float,
        T_controllertool_tool: Float64 | None = None,
    ) -> None:
        self._path, self._limits = path, limits
        self._seam_limits, self._sync_limits = seam_limits, sync_limits
        self._status_age_s = status_age_s
        is_same = T_controllertool_tool is None or np.array_equal(T_controllertool_tool, np.eye(4))
        self._T_controllertool_tool = None if is_same else T_controllertool_tool
        self._assembler = PoseAssembler()
        self._robot: tuple[RobotStatus, float] | None = None
        self._programmed: PoseSample | None = None
        self._poses = Plausibility()
        self._seam = SeamInnovation()
        self._sync = ClockSync()

    def hear(self, received: Received, now_s: float) -> PoseSample | None:
        """Take an accepted message, read at `now_s`; return the pose that it completes, trusted or not.

        The sample is of the tool, at its time on the clock of `now_s`.
        """
        came_at_s = now_s - received.max_age_s
        if isinstance(received.message, RobotStatus):
            self._robot = (received.message, came_at_s)
        elif isinstance(received.message, TrackerCommand) and received.message.command in BEGINNING:
            self._poses, self._seam = Plausibility(), SeamInnovation()
        elif isinstance(received.message, RobotSync):
            steps = self._sync.steps
            self._sync = self._sync.on_sync(received.message, came_at_s, self._sync_limits)
            if self._sync.steps > steps:
                self._poses = clock_set(self._poses, came_at_s, self._limits)
        sample = self._assembler.push(received)
        if sample is None:
            return None
        sample = replace(sample, timestamp_s=came_at_s - (received.timestamp_s - sample.timestamp_s))
        if self._T_controllertool_tool is not None:
            sample = _of_tool(sample, self._T_controllertool_tool)
        if sample.kind is PoseKind.PROGRAMMED:
            self._programmed = sample
            return None
        self.take(sample, came_at_s)
        return sample

    def take(self, sample: PoseSample, came_at_s: float) -> None:
        """Take a sample of where the tool is, which came at a time, s."""
        robot = self._robot
        is_fresh = robot is not None and abs(came_at_s - robot[1]) <= self._status_age_s
        status = robot[0] if robot is not None and is_fresh else None
        seen = PoseArrival(sample, status, self._programmed, self._seam.motion is SeamMotion.CONTRADICTED)
        self._poses = update(self._poses, seen, self._limits, self._path)

    def see(self, seam: SeamMeasurement) -> None:
        """Take a measurement of the seam, as the pose at its capture puts it."""
        moving = seam.at_speed(self._poses.speed_mm_s, self._poses.turn_rad_s, self._seam_limits)
        self._seam = self._seam.with_seam(moving, self._seam_limits)

    def doubt(self, now_s: float) -> Doubt | None:
        """Return why poses are not trusted at a time, s; None where they are."""
        doubt = self._poses.at(now_s, self._limits)
        if doubt is None and self._seam.motion is SeamMotion.CONTRADICTED:
            return SeamMotion.CONTRADICTED
        return doubt


def nominal_path(joint: Joint) -> NominalPath:
    """Return a joint's nominal seam as the path that poses are held against."""
    points = tuple((float(x), float(y), float(z)) for x, y, z in joint.seam_in_base_mm)
    x, y, z = joint.surface_normal_in_base
    return NominalPath(points, (float(x), float(y), float(z)), joint.surface_normals_in_base)


def _of_tool(sample: PoseSample, T_controllertool_tool: Float64) -> PoseSample:
    """Return the tool's pose, from a sample of the controller's own tool frame."""
    turn = Rotation.from_quat(sample.quaternion_xyzw)
    x, y, z = (np.array(sample.position_base_mm) + turn.apply(T_controllertool_tool[:3, 3])).tolist()
    qx, qy, qz, qw = (turn * Rotation.from_matrix(T_controllertool_tool[:3, :3])).as_quat().tolist()
    return replace(sample, position_base_mm=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw))
