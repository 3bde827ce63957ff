"""The pictures of a replay, drawn while it runs: overlay.mp4 frame by frame, overview.png at the end."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from arctrack.recording import Recording, Truth
from arctrack.recording.results import OVERLAY_VIDEO, OVERVIEW_PICTURE
from arctrack.report.replay.overlay import OverlayVideo
from arctrack.report.replay.overview import Overview
from robot_io import SeamOffset
from tracker.state import Frame, Track


class ReplayPictures:
    """Draws into a results folder; the context's end finishes the video, a good end draws the overview.

    The truth is drawn beside what was tracked, where there is one.
    """

    def __init__(self, recording: Recording, truth: Truth | None, folder: Path) -> None:
        self._truth = truth
        self._overview = Overview(recording)
        self._overview_path = folder / OVERVIEW_PICTURE
        self._overlay = OverlayVideo(folder / OVERLAY_VIDEO, recording.setup, recording.frame_rate_hz)

    def draw(self, frame: Frame | None, track: Track, offset: SeamOffset) -> None:
        """Take a frame, None if it could not be read."""
        self._overlay.write(frame, track, offset)
        self._overview.add(frame, track, offset)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._overlay.close()
        if kind is None:
            self._overview.save(self._overview_path, self._truth)
