"""Check of whether the robot on the bus stands where the recording's robot stood."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from robot_io import GateReason, PoseAssembler, PoseBuffer, PoseKind, PoseStatus, Received


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
    """Comparison of each pose off the bus with the recording's pose at the same time."""

    def __init__(self, poses: PoseBuffer, policy: AgreementPolicy | None = None) -> None:
        self._poses = poses
        self._policy = policy or AgreementPolicy()
        self._assembler = PoseAssembler()

    def verdict(self, received: Received, now_s: float) -> GateReason | None:
        """Return NONE or ROBOT_ELSEWHERE of a pose that a message completes, None where it completes none.

        `now_s` is the time of its reading on the recording's clock. A pose for which the recording has none
        is elsewhere.
        """
        sample = self._assembler.push(received)
        if sample is None or sample.kind is not PoseKind.ACTUAL:
            return None
        sampled_at_s = now_s - received.max_age_s - (received.timestamp_s - sample.timestamp_s)
        recorded = self._poses.at(sampled_at_s)
        if recorded.status is PoseStatus.REFUSED:
            return GateReason.ROBOT_ELSEWHERE
        apart_mm = float(np.linalg.norm(recorded.T_base_tool[:3, 3] - sample.position_base_mm))
        turn = Rotation.from_quat(sample.quaternion_xyzw).inv() * Rotation.from_matrix(
            recorded.T_base_tool[:3, :3]
        )
        agrees = (
            apart_mm <= self._policy.position_mm and np.degrees(turn.magnitude()) <= self._policy.rotation_deg
        )
        return GateReason.NONE if agrees else GateReason.ROBOT_ELSEWHERE
