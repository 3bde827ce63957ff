"""What was heard last, and how long it counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from robot_io import SOURCES, BusMessage, Source, Trusted

M = TypeVar("M", bound=BusMessage)

TRUSTED = Trusted(robot=(Source.LIVE,), tracker=SOURCES)
"""The robot must be a live one; a tracker of any source is another one."""


@dataclass(frozen=True)
class Heard(Generic[M]):
    """A message and the time, s, at which it came."""

    message: M
    came_at_s: float


def fresh(heard: Heard[M] | None, now_s: float, max_age_s: float) -> M | None:
    """Return a message that is not stale; one from as far in the future is stale as well."""
    if heard is None or not abs(now_s - heard.came_at_s) <= max_age_s:
        return None
    return heard.message
