"""Latest messages of the robot, and how long they count."""

from dataclasses import dataclass
from typing import Generic, TypeVar

from robot_io import SOURCES, BusMessage, RobotStatus, Source, TrackerCommand, Trusted

M = TypeVar("M", bound=BusMessage)

TRUSTED = Trusted(robot=(Source.LIVE,), tracker=SOURCES)
"""The robot must be a live one; a tracker of any source is another one."""


@dataclass(frozen=True)
class TimedMessage(Generic[M]):
    """A message and the time, s, at which it came."""

    message: M
    came_at_s: float


def fresh(latest: TimedMessage[M] | None, now_s: float, max_age_s: float) -> M | None:
    """Return a message that is not stale; one from as far in the future is stale as well."""
    if latest is None or not abs(now_s - latest.came_at_s) <= max_age_s:
        return None
    return latest.message


class OutageWatch:
    """Detector of silences of the robot that may hide a DISARM or a correction set to OFF."""

    def __init__(self) -> None:
        self._came_at_s: dict[type[BusMessage], float] = {}

    def hear(self, message: BusMessage, came_at_s: float, now_s: float, hold_s: float) -> bool:
        """Take an accepted message; return whether the last of its kind may be more than `hold_s` older.

        `came_at_s` is the earliest time at which it came, `now_s` that of its reading. `hold_s` is the
        longest silence after which the robot still stands where it was sent.
        """
        kind = type(message)
        if kind not in (TrackerCommand, RobotStatus):
            return False
        before_s = self._came_at_s.get(kind, now_s)
        self._came_at_s[kind] = came_at_s
        return not now_s - before_s <= hold_s

    def set_back(self, back_s: float) -> None:
        """Go on by a clock that was set back, s."""
        self._came_at_s = {kind: at_s - back_s for kind, at_s in self._came_at_s.items()}
