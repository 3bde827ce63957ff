"""A frame of a replay drawn: its picture in the video, what the page shows of it, its view for exports."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from arctrack.recording import Truth
from arctrack.replay.pages.drawing_spool import ReplayedFrame
from arctrack.replay.pages.overlay import picture_of
from arctrack.replay.pages.view import ReplayView, Viewer
from arctrack.replay.pages.view_json import view_json
from noise_model.compiled.arrays import UInt8
from noise_model.setup import Setup
from tracker.geometry import SensorGeometry
from tracker.state import Frame


@dataclass(frozen=True, eq=False)
class ToDraw:
    """A frame, None if it could not be read, what was seen of it, and what is to be drawn."""

    frame: Frame | None
    seen: ReplayedFrame
    in_video: bool
    on_page: bool
    exported: bool


@dataclass(frozen=True, eq=False)
class Drawn:
    """Drawn parts of a frame, None for those that were not requested.

    `picture` has the planes of the video's picture, `shown` is for the page, `view` is for exports.
    """

    picture: UInt8 | None
    shown: dict[str, Any] | None
    view: ReplayView | None


@dataclass(frozen=True, eq=False)
class FrameDrawer:
    """Renderer of single frames of a recording, in any order, in any process."""

    setup: Setup
    truth: Truth | None

    def __call__(self, asked: ToDraw) -> Drawn:
        """Draw a frame."""
        frame, seen = asked.frame, asked.seen
        view = self._viewer.view(frame, seen) if asked.on_page or asked.exported else None
        return Drawn(
            picture_of(self.setup, frame, seen.track, seen.offset) if asked.in_video else None,
            view_json(view) if view is not None and asked.on_page else None,
            view if asked.exported else None,
        )

    @cached_property
    def _viewer(self) -> Viewer:
        return Viewer(SensorGeometry.of(self.setup), self.truth)
