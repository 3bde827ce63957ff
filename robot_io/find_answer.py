"""Whole answers to a FIND from the three frames that carry one: all of them, or nothing."""

import math
from dataclasses import dataclass

from robot_io.link.inbox import Received
from robot_io.protocol.messages import FindRefusal, FindResult, FoundPosition, FoundRotation

WINDOW_S = 0.1
"""Longest time over which the frames of an answer come, s (chosen: ten frames of a busy bus take 3 ms).

After 15 answers the counter that they share comes round again.
"""


@dataclass(frozen=True)
class FindAnswer:
    """Answer to a FIND: a joint in base, or why there is none.

    `result.request_number` says which request it answers. Where `is_found` is false nothing of `position` and
    `rotation` is known.
    """

    result: FindResult
    position: FoundPosition
    rotation: FoundRotation

    @property
    def is_found(self) -> bool:
        """True if there is a joint whose place and attitude are known."""
        numbers = (self.position.x_mm, self.position.y_mm, self.position.z_mm, *self.rotation.quaternion_xyzw)
        return self.result.refusal is FindRefusal.NONE and not any(map(math.isnan, numbers))


class FindAssembler:
    """Joins the three frames of an answer by their E2E counter; one that lacks a frame is dropped."""

    def __init__(self) -> None:
        self._result: tuple[Received, FindResult] | None = None
        self._position: FoundPosition | None = None
        self._rotation: FoundRotation | None = None

    def push(self, received: Received) -> FindAnswer | None:
        """Take an accepted message of any type, and return the answer that it completes."""
        message = received.message
        if isinstance(message, FindResult):
            self._result, self._position, self._rotation = (received, message), None, None
        if self._result is None or not isinstance(message, FoundPosition | FoundRotation):
            return None
        first, result = self._result
        is_late = not abs(received.timestamp_s - first.timestamp_s) <= WINDOW_S
        if received.counter != first.counter or received.source is not first.source or is_late:
            return None
        if isinstance(message, FoundPosition):
            self._position = message
        else:
            self._rotation = message
        if self._position is None or self._rotation is None:
            return None
        self._result = None
        return FindAnswer(result, self._position, self._rotation)
