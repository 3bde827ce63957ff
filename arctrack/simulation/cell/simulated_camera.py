"""Simulated sensor of a tracker in a cell: a camera, and the tracker of its frames."""

from typing import Any, Protocol

import numpy.typing as npt

from arctrack.control.frame_tracking import Capture, TrackedFrame

Shown = npt.NDArray[Any] | None
"""Content of a frame: an image, or where a camera without a picture saw the seam; None for nothing."""


COMPUTED_S = 0.012
"""Duration of a track, s: the same on every machine."""


class SimulatedCamera(Protocol):
    """A camera at the robot's tool, and the tracking behind it."""

    def begin(self) -> None:
        """Reset the tracker, as in a new process."""

    def look(self, off_mm: float) -> Shown:
        """Return the camera's present frame, of a seam that seems to lie so far to the left, mm."""

    def garbage(self) -> Shown:
        """Return the frame of a broken camera."""

    def track(self, shown: Shown, capture: Capture) -> TrackedFrame:
        """Track a frame."""
