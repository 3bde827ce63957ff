"""Check of whether the robot on the bus stands where the recording's robot stood."""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from robot_io import GateReason, PoseAssembler, PoseAt, PoseBuffer, PoseKind, PoseSample, PoseStatus, Received
from tracker.state import NAN


@dataclass(frozen=True)
class AgreementPolicy:
    """Largest difference of the two. Each field's metadata states `unit`, `role` and `source`."""

    position_mm: float = field(
        default=5.0,
        metadata={
            "unit": "mm",
            "role": "largest distance of the two tools",
            "source": "half a second at 10 mm/s: as well as two programs are started together by hand",
        },
    )
    rotation_deg: float = field(
        default=3.0,
        metadata={
            "unit": "deg",
            "role": "largest angle between the two tools",
            "source": "50 mm from tool to stripe turn it into 2.6 mm, half of what the position may be off",
        },
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
