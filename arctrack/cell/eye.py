"""What a tracker in a cell looks with: a camera, and what makes a track of its frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy.typing as npt

from robot_io import PoseAt, RobotStatus
from tracker.seam.innovation import SeamMeasured
from tracker.seam.steer import Lead
from tracker.state import Track

Shown = npt.NDArray[Any] | None
"""What a frame shows: an image, or where a camera without a picture saw the seam; None for nothing."""


@dataclass(frozen=True)
class Capture:
    """A frame as the tracker knows it.

    Attributes
    ----------
    index : int
        The frame's number.
    captured_s : float
        When it was taken, s, on the tracker's clock.
    pose : PoseAt
        The tool's pose then, not refused.
    robot : RobotStatus or None
        What the robot said last; None before it was heard.
    is_trusted : bool
        Whether poses are trusted: what is measured by others must not last.
    lead : Lead
        How far ahead of the torch the offset is asked for.
    """

    index: int
    captured_s: float
    pose: PoseAt
    robot: RobotStatus | None
    is_trusted: bool
    lead: Lead


class Eye(Protocol):
    """A camera at the robot's tool, and the tracking behind it."""

    def begin(self) -> None:
        """Begin to track anew, as a new process does."""

    def look(self, off_mm: float) -> Shown:
        """Return what the camera sees now, of a seam that seems to lie so far to the left, mm."""

    def garbage(self) -> Shown:
        """Return what a camera that is broken shows."""

    def track(self, shown: Shown, capture: Capture) -> tuple[Track, SeamMeasured | None]:
        """Track a frame; the measurement of the seam is what the watch over the poses sees."""
