"""Answers to the robot's FIND: one for each request, of frames that were exposed after it alone.

No thread, clock or socket is in here. Frames are taken while the request stands. A `JointFinder` then looks
for the joint in them, in no hurry. Whatever ends the request meanwhile refuses it: an answer is of the part,
the job and the place that were asked for, or it is a refusal.
"""

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.control.job import PartLimits
from arctrack.control.part_fitness import fault_of
from noise_model.compiled.arrays import Float64
from robot_io import (
    BusMessage,
    Fault,
    FindRefusal,
    FindResult,
    FoundPosition,
    FoundRotation,
    PoseAt,
    PoseStatus,
    QuaternionComponent,
    TrackerCommand,
    out_of_range_as_unknown,
)
from tracker.find import UNLIKE, FoundJoint
from tracker.state import NAN, Frame

FRAMES = 5
"""Frames of an answer (chosen, as `PartLimits.looks`: a bad frame or two refuse nothing)."""

SPACING_MM = 4.0
"""Distance between the frames of a robot that moves: over 16 mm the seam's direction is known (chosen)."""

MAX_MOVED_MM = 40.0
"""Distance from the first frame beyond which another one is no longer of the place that was asked for.

Twice what two places of a find lie apart; a robot that moves at 25 frames a second has it at 400 mm/s.
"""

COLLECT_S = 5.0
"""Longest time for the frames: a robot has then gone their way at 3.2 mm/s. Later those count that came."""

COMPUTE_S = 3.0
"""Longest time for the finder after that (it takes 0.05 to 0.8 s; one that was restarted some more)."""


class JointFinder(Protocol):
    """Finder of a joint in frames, beside the loop."""

    def begin(self) -> None:
        """Forget all frames."""

    def keep(self, frame: Frame, T_base_tool: Float64) -> None:
        """Take a frame and its pose (4, 4)."""

    def found(self, job_number: int) -> FoundJoint | None:
        """Return what a job's frames since `begin` show; None while that is not known."""


@dataclass
class _Pending:
    """A request without an answer: its number, its job, when it was read, the frames' places, mm."""

    number: int
    job_number: int
    since_s: float
    places_mm: list[Float64] = field(default_factory=list)
    missing: FindRefusal = FindRefusal.CAMERA_STOPPED
    is_full: bool = False


class FindResponder:
    """Responder to the robot's FIND; without a finder each is refused."""

    def __init__(self, finder: JointFinder | None) -> None:
        self._finder = finder
        self._pending: _Pending | None = None
        self._answers: list[BusMessage] = []

    @property
    def is_pending(self) -> bool:
        """True while a request waits for its answer."""
        return self._pending is not None

    def ask(self, command: TrackerCommand, now_s: float) -> None:
        """Take a new FIND, read at a time, s; it takes the place of an earlier one."""
        self.refuse(FindRefusal.WITHDRAWN)
        number = command.job_number
        self._pending = _Pending(command.request_number, -1 if number is None else number, now_s)
        if self._finder is None:
            self.refuse(FindRefusal.NOT_AVAILABLE)
        elif number is None:
            self.refuse(FindRefusal.JOB_UNKNOWN)
        else:
            self._finder.begin()

    def is_asked_by(self, command: TrackerCommand) -> bool:
        """Return True if a FIND is the request that waits, sent again."""
        pending = self._pending
        wanted = (command.request_number, command.job_number)
        return pending is not None and wanted == (pending.number, pending.job_number)

    def refuse(self, refusal: FindRefusal) -> None:
        """Refuse the request that waits, if one does."""
        if self._pending is not None:
            self._answers += _refused(self._pending.number, refusal)
            self._pending = None

    def see(self, frame: Frame, pose: PoseAt, is_doubted: bool, is_moving: bool, now_s: float) -> None:
        """Take a frame with its pose; `is_doubted` says that poses are not trusted."""
        pending, finder = self._pending, self._finder
        if pending is None or finder is None or pending.is_full:
            return
        # Written so that a NaN fails.
        if not pending.since_s < frame.timestamp_s - 0.5 * frame.exposure_s < now_s:
            return
        if not frame.laser_on:
            pending.missing = FindRefusal.LASER_OFF
        elif pose.status is not PoseStatus.INTERPOLATED:
            pending.missing = FindRefusal.POSE_REFUSED
        elif is_doubted:
            pending.missing = FindRefusal.POSES_DOUBTED
        else:
            self._keep(pending, finder, frame, pose.T_base_tool, is_moving)

    def answers(self, part: PartLimits, now_s: float) -> list[BusMessage]:
        """Return the messages of the answers that are there; `part` is what the job requires of a part."""
        pending = self._pending
        if pending is not None and self._finder is not None:
            waited_s = now_s - pending.since_s
            pending.is_full |= waited_s > COLLECT_S and bool(pending.places_mm)
            joint = self._finder.found(pending.job_number) if pending.is_full else None
            if joint is not None:
                self._answers += found_messages(pending.number, joint, part)
                self._pending = None
            elif not 0.0 <= waited_s <= COLLECT_S + COMPUTE_S * pending.is_full:
                self.refuse(FindRefusal.NOT_AVAILABLE if pending.is_full else pending.missing)
        answers, self._answers = self._answers, []
        return answers

    def _keep(
        self, pending: _Pending, finder: JointFinder, frame: Frame, T_base_tool: Float64, is_moving: bool
    ) -> None:
        place_mm = T_base_tool[:3, 3]
        if pending.places_mm:
            if np.linalg.norm(place_mm - pending.places_mm[0]) > MAX_MOVED_MM:
                self.refuse(FindRefusal.MOVED_TOO_FAR)
                return
            if is_moving and np.linalg.norm(place_mm - pending.places_mm[-1]) < SPACING_MM:
                return
        finder.keep(frame, T_base_tool)
        pending.places_mm.append(place_mm)
        pending.is_full = len(pending.places_mm) == FRAMES


def found_messages(number: int, joint: FoundJoint, part: PartLimits) -> list[BusMessage]:
    """Return the messages that answer a request by its number with a joint, or why it is refused.

    A joint that is refused has no position and no rotation, but its gap and mismatch where they are known.
    """
    track = joint.track
    if joint.refusal or track is None:
        return _refused(number, FindRefusal[joint.refusal.upper()])
    x_mm, y_mm, z_mm = joint.point_base_mm.tolist()
    position = out_of_range_as_unknown(FoundPosition(x_mm, y_mm, z_mm))
    qx, qy, qz, qw = Rotation.from_matrix(joint.R_base_found).as_quat().tolist()
    sigmas_deg = float(joint.direction_sigma_deg.max()), joint.normal_sigma_deg
    rotation = out_of_range_as_unknown(FoundRotation.from_quaternion((qx, qy, qz, qw), *sigmas_deg))
    _, sigma_y_mm, sigma_z_mm = joint.sigma_mm.tolist()
    is_unlike = bool(track.flags & UNLIKE)
    result = out_of_range_as_unknown(
        FindResult(
            request_number=number,
            refusal=FindRefusal.NONE,
            gap_mm=track.gap_mm,
            mismatch_mm=track.mismatch_mm,
            sigma_y_mm=sigma_y_mm,
            sigma_z_mm=sigma_z_mm,
            joint_misfit=is_unlike,
        )
    )
    fault = fault_of(track, part)
    refusal = FindRefusal.NONE
    if fault is not Fault.NONE:
        refusal = FindRefusal[fault.name]
    elif any(map(math.isnan, (result.sigma_y_mm, result.sigma_z_mm))):
        refusal = FindRefusal.SIGMA_TOO_LARGE
    elif any(map(math.isnan, (position.x_mm, position.y_mm, position.z_mm))):
        refusal = FindRefusal.OUT_OF_RANGE
    if refusal is not FindRefusal.NONE:
        return _refused(number, refusal, result.gap_mm, result.mismatch_mm, is_unlike)
    return [result, position, rotation]


def _refused(
    number: int, refusal: FindRefusal, gap_mm: float = NAN, mismatch_mm: float = NAN, is_unlike: bool = False
) -> list[BusMessage]:
    """Return the messages of a refusal: all three, for their counters go up together."""
    return [
        FindResult(number, refusal, gap_mm, mismatch_mm, NAN, NAN, is_unlike),
        FoundPosition(NAN, NAN, NAN),
        FoundRotation(QuaternionComponent.W, NAN, NAN, NAN, NAN, NAN),
    ]
