"""Whole poses from the two frames that carry them: both halves of the same pose, or nothing."""

import math
from dataclasses import dataclass

from robot_io.link.inbox import Received
from robot_io.protocol.dbc import cycle_time_s, message_layout
from robot_io.protocol.messages import PoseKind, RobotPosePosition, RobotPoseRotation


@dataclass(frozen=True)
class PoseSample:
    """A whole pose T_base_tool off the bus.

    Attributes
    ----------
    timestamp_s : float
        When the controller sampled the pose, s: the rotation frame's time less the sample age. Where the age
        is unknown it is the frame's time.
    position_base_mm : tuple (3,)
        The tool's position, mm, base frame.
    quaternion_xyzw : tuple (4,)
        The tool's rotation in base, as a unit quaternion x y z w.
    kind : PoseKind
        The actual pose, or that of the programmed path.
    sample_age_s : float
        Age of the pose when it was sent, s; NaN where the sender does not know it.
    """

    timestamp_s: float
    position_base_mm: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]
    kind: PoseKind
    sample_age_s: float


class PoseAssembler:
    """Pairs position and rotation frames by their E2E counter; a half without its other half is dropped."""

    def __init__(self) -> None:
        # After 15 cycles the counter comes round again.
        self._window_s = 5 * cycle_time_s(message_layout(RobotPosePosition.__name__))
        self._position: tuple[Received, RobotPosePosition] | None = None
        self._rotation: tuple[Received, RobotPoseRotation] | None = None

    def push(self, received: Received) -> PoseSample | None:
        """Take an accepted message, and return the pose that it completes.

        Parameters
        ----------
        received : Received
            A message of any type.

        Returns
        -------
        PoseSample or None
            None while a half is missing, for other messages, and for a pose of which the sender does not know
            every part.
        """
        if isinstance(received.message, RobotPosePosition):
            self._position = (received, received.message)
        elif isinstance(received.message, RobotPoseRotation):
            self._rotation = (received, received.message)
        else:
            return None
        if self._position is None or self._rotation is None:
            return None
        (position_frame, position), (rotation_frame, rotation) = self._position, self._rotation
        if position_frame.counter != rotation_frame.counter:
            return None
        if abs(position_frame.timestamp_s - rotation_frame.timestamp_s) > self._window_s:
            return None
        self._position = self._rotation = None
        return _whole(position, rotation, rotation_frame.timestamp_s)


def _whole(position: RobotPosePosition, rotation: RobotPoseRotation, sent_at_s: float) -> PoseSample | None:
    position_base_mm = (position.x_mm, position.y_mm, position.z_mm)
    quaternion_xyzw = rotation.quaternion_xyzw
    if any(map(math.isnan, (*position_base_mm, *quaternion_xyzw))):
        return None
    sample_age_s = rotation.sample_age_ms / 1000.0
    return PoseSample(
        timestamp_s=sent_at_s if math.isnan(sample_age_s) else sent_at_s - sample_age_s,
        position_base_mm=position_base_mm,
        quaternion_xyzw=quaternion_xyzw,
        kind=position.kind,
        sample_age_s=sample_age_s,
    )
