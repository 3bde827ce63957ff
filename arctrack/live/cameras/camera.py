"""Interface of every kind of camera."""

from dataclasses import dataclass
from typing import Protocol

from robot_io import LaserState, RobotPulse
from tracker.state import Frame


@dataclass(frozen=True)
class UnreadableFrame:
    """A frame that arrived and cannot be used.

    `timestamp_s` is its mid-exposure on the camera's clock, `problem` says what is wrong with it.
    """

    index: int
    timestamp_s: float
    problem: str


@dataclass(frozen=True)
class CameraTraits:
    """Knowledge that a camera has of the light, and its control of it.

    With `knows_arc` its frames carry arc state and current; otherwise the robot reports them. With
    `interleaves` it takes laser-off frames, of the arc's light alone, in between.
    """

    knows_arc: bool
    switches_laser: bool
    interleaves: bool = False


SHARED = CameraTraits(knows_arc=True, switches_laser=True)
"""Another process publishes frames, knows what they show, and heeds the camera's line."""

PLAYED = CameraTraits(knows_arc=True, switches_laser=False)
"""All is recorded."""


class CameraProtocol(Protocol):
    """Frames as they come, and the laser whose stripe they show."""

    @property
    def traits(self) -> CameraTraits:
        """Knowledge of the light, and control of it."""

    @property
    def dropped(self) -> int:
        """Number of frames taken since `begin` and never handed out."""

    @property
    def is_over(self) -> bool:
        """True if no frame will come any more. A live camera may always begin again."""

    def begin(self) -> None:
        """Let frames count from now on."""

    def now_s(self) -> float:
        """Return the time on the clock of the frames, s: the host's monotonic clock for a live camera."""

    def newest(self) -> Frame | UnreadableFrame | None:
        """Return the newest frame that was not handed out yet, None where there is none; never wait."""

    def switch_laser(self, is_on: bool) -> LaserState:
        """Switch the laser, and return what it does; UNKNOWN where the camera has no hold on it."""

    def want_exposure(self, exposure_s: float) -> None:
        """Request an exposure, s; each frame states the one it had."""

    def tell_pulse(self, pulse: RobotPulse, came_at_s: float) -> None:
        """Take the arc's pulse as the robot said it at a time, s: frames are best in its base phase."""

    def close(self) -> None:
        """Take no more frames; the laser goes off."""
