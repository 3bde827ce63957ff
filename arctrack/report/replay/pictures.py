"""The pictures of a replay, drawn when its last offset has gone out: whoever draws keeps no robot waiting."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from arctrack.output import writing
from arctrack.recording import BadFrame, Recording, Truth
from arctrack.recording.results import OVERLAY_VIDEO, OVERVIEW_PICTURE, REPLAY_PAGE
from arctrack.report.replay.overlay import OverlayVideo
from arctrack.report.replay.overview import Overview
from arctrack.report.replay.page import ReplayPage, frames_to_show
from arctrack.report.replay.seen import Seen, SeenFile
from arctrack.report.replay.view import Viewer
from tracker.geometry import SensorGeometry
from tracker.state import Frame


@dataclass(frozen=True)
class ReplayPictures:
    """What draws a replay into a results folder; the truth beside what was tracked, where there is one.

    `on_drawn` hears the number of frames drawn.
    """

    recording: Recording
    truth: Truth | None
    folder: Path
    use_arc_map: bool
    on_drawn: Callable[[int], None] | None = None

    @contextmanager
    def after(self) -> Iterator[SeenFile]:
        """Take what a replay sees, and draw it at the context's end.

        A replay that is broken off leaves the video of what it saw, no more.
        """
        with ExitStack() as opened:
            with writing(self.folder):
                # A file without a name: a replay that is killed leaves none behind.
                file = opened.enter_context(tempfile.TemporaryFile(dir=self.folder))
            seen = SeenFile(file, self.folder)
            try:
                yield seen
            except BaseException:
                self._draw(seen, whole=False)
                raise
            self._draw(seen, whole=True)

    def _draw(self, seen: SeenFile, whole: bool) -> None:
        recording = self.recording
        if not len(seen):
            return
        overview = Overview(recording)
        viewer = Viewer(SensorGeometry.of(recording.setup), self.truth)
        page = ReplayPage(recording, self.truth, self.use_arc_map, viewer)
        shown = set(frames_to_show(seen.flags)) if whole else set()
        path = self.folder / OVERLAY_VIDEO
        with OverlayVideo(path, recording.setup, recording.frame_rate_hz) as overlay:
            for n, (frame, each) in enumerate(self._frames(seen)):
                overlay.write(frame, each.track, each.offset)
                overview.add(frame, each.track, each.offset)
                page.add(frame, each, viewer.view(frame, each) if n in shown else None)
                if self.on_drawn is not None:
                    self.on_drawn(n + 1)
        if whole:
            overview.save(self.folder / OVERVIEW_PICTURE, self.truth)
            page.save(self.folder / REPLAY_PAGE)

    def _frames(self, seen: SeenFile) -> Iterator[tuple[Frame | None, Seen]]:
        """Read the frames that were seen once more; None where one could not be read."""
        frames = self.recording.frames(range(len(seen)))
        for frame, each in zip(frames, seen, strict=True):
            yield None if isinstance(frame, BadFrame) else frame, each
