"""Pictures of a replay, drawn after its last offset was sent, so that drawing delays no robot."""

import tempfile
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from arctrack.errors import without_extra
from arctrack.output import writing
from arctrack.recording import BadFrame, Recording, Truth
from arctrack.recording.results import (
    OVERLAY_VIDEO,
    OVERVIEW_PICTURE,
    REPLAY_MCAP,
    REPLAY_PAGE,
    REPLAY_RRD,
    counts_in_words,
)
from arctrack.replay.pages.drawing import Drawing
from arctrack.replay.pages.drawing_spool import ReplayedFrame, SeenFile
from arctrack.replay.pages.overlay import OverlayVideo
from arctrack.replay.pages.overview import Overview
from arctrack.replay.pages.page import ReplayPage, frames_to_show
from arctrack.replay.pages.view import ReplayView, ToDraw, truth_by_frame
from noise_model.compiled.arrays import Float64
from tracker.state import Frame

EXTRAS = {REPLAY_MCAP: "mcap", REPLAY_RRD: "rerun"}
"""The exports, and arctrack's extra that holds the package that each needs."""


class Export(Protocol):
    """A file that takes a replay frame by frame."""

    def add(
        self, frame: Frame | None, seen: ReplayedFrame, view: ReplayView, true_mm: Float64 | None
    ) -> None:
        """Append a frame, None if it could not be read."""


@dataclass(frozen=True)
class ReplayPictures:
    """Pictures of a replay in a results folder, with the truth and the tracks, where there is a truth.

    `exports` are the files of `EXTRAS` to write. `on_drawn` is called with the number of frames drawn.
    """

    recording: Recording
    truth: Truth | None
    folder: Path
    use_arc_map: bool
    drawing: Drawing
    pictures: bool = True
    exports: tuple[str, ...] = ()
    on_drawn: Callable[[int], None] | None = None

    @contextmanager
    def after(self) -> Iterator[SeenFile]:
        """Take what a replay sees, and draw it at the context's end.

        A replay that is broken off leaves the video of what it saw, no more. Raises ArctrackError where a
        package that an export needs is missing, or a process that draws has ended.
        """
        exporters = {name: exporter(name) for name in self.exports}
        with ExitStack() as opened:
            with writing(self.folder):
                # A file without a name: a replay that is killed leaves none behind.
                file = opened.enter_context(tempfile.TemporaryFile(dir=self.folder))
            seen = SeenFile(file, self.folder)
            try:
                yield seen
            except BaseException:
                self._draw_video(seen)
                raise
            self._draw(seen, exporters)

    def _draw_video(self, seen: SeenFile) -> None:
        """Draw the video alone, and by no process: another error would hide what broke the replay off."""
        if self.pictures and len(seen):
            with self._video() as overlay:
                for asked in self._to_draw(seen, set()):
                    picture = self.drawing.drawer(asked).picture
                    assert picture is not None
                    overlay.write(picture)

    def _draw(self, seen: SeenFile, exporters: "Mapping[str, Exporter]") -> None:
        recording, truth_mm = self.recording, truth_by_frame(self.truth)
        overview = Overview(recording)
        page = ReplayPage(recording, self.truth, self.use_arc_map)
        on_page = set(frames_to_show(seen.flags)) if self.pictures else set()
        with ExitStack() as opened:
            overlay = opened.enter_context(self._video()) if self.pictures else None
            exports = [
                opened.enter_context(export(self.folder / name, recording))
                for name, export in exporters.items()
            ]
            to_draw = self._to_draw(seen, on_page, exported=bool(exports))
            for n, (asked, drawn) in enumerate(self.drawing.draw(to_draw)):
                frame, each = asked.frame, asked.seen
                if overlay is not None and drawn.picture is not None:
                    overlay.write(drawn.picture)
                    overview.add(frame, each.track, each.offset)
                    page.add(frame, each, drawn.shown)
                for export in exports:
                    assert drawn.view is not None
                    export.add(frame, each, drawn.view, truth_mm.get(each.track.frame))
                if self.on_drawn is not None:
                    self.on_drawn(n + 1)
        if self.pictures:
            laser_on = sum(row.laser_on for row in recording.rows)
            counts = counts_in_words(seen.offset_count, seen.valid, laser_on)
            overview.save(self.folder / OVERVIEW_PICTURE, self.truth, counts)
            page.save(self.folder / REPLAY_PAGE, counts)

    def _video(self) -> OverlayVideo:
        return OverlayVideo(self.folder / OVERLAY_VIDEO, self.recording.setup, self.recording.frame_rate_hz)

    def _to_draw(self, seen: SeenFile, on_page: Container[int], exported: bool = False) -> Iterator[ToDraw]:
        frames = self.recording.frames(range(len(seen)))
        for n, (frame, each) in enumerate(zip(frames, seen, strict=True)):
            readable = None if isinstance(frame, BadFrame) else frame
            yield ToDraw(readable, each, self.pictures, n in on_page, exported)


Exporter = Callable[[Path, Recording], AbstractContextManager[Export]]


def exporter(name: str) -> Exporter:
    """Return what opens an export; ArctrackError, with the cure, if the package that it needs is missing."""
    try:
        if name == REPLAY_MCAP:
            from arctrack.replay.pages.mcap_file import McapFile

            return McapFile.of_recording
        from arctrack.replay.pages.rrd_file import RrdFile

        return RrdFile
    except ModuleNotFoundError as error:
        raise without_extra(name, error, EXTRAS[name]) from None
