"""A video, or a folder of images, as a source: each frame comes once its exposure would be over."""

import math
import time
from collections.abc import Callable, Iterator
from itertools import count, repeat
from pathlib import Path

import av
import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.live.cameras.capture.source import Ask, wait_until
from arctrack.recording import ffv1
from arctrack.recording.ffv1 import opened_video
from arctrack.recording.importing.image_decoder import EncodedImage
from arctrack.recording.importing.image_files import find_images
from arctrack.recording.tables import FrameRow, read_frame_rows
from noise_model.compiled.arrays import Integers
from noise_model.setup import Setup
from tracker.state import NAN, Frame, frame_misfit


class LumaVideo:
    """Sequential reader of a grey video; it never seeks.

    `shape` is (height, width), px; `dtype` is uint8, or uint16 beyond 8 bits; `rate_hz` is the rate that the
    file states. Raises ArctrackError if the file cannot be read, or is neither FFV1 nor H.264 with a plane of
    grey.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._opened() as container:
            codec = container.streams.video[0].codec_context
            rate = container.streams.video[0].average_rate
            pixels = codec.format
            if pixels is None or not pixels.components or not pixels.components[0].is_luma:
                name = "unknown pixels" if pixels is None else pixels.name
                raise in_file(path, f"holds {codec.name} with {name}: grey or YUV is needed")
            bits = pixels.components[0].bits
            order = ">" if pixels.is_big_endian else "<"
            self._stored = np.dtype(np.uint8 if bits <= 8 else f"{order}u2")
            self.shape, self.rate_hz = (codec.height, codec.width), float(rate or 0.0)
            self.dtype = np.dtype(np.uint8 if bits <= 8 else np.uint16)
            # FFmpeg only logs a wrong checksum of FFV1, and fills the slice with something.
            self._is_exact = codec.name == "ffv1" and path.suffix.lower() == ".mkv"
            self._is_exact &= pixels.name in ffv1.PIXEL_FORMATS

    def frames(self) -> Iterator[Integers | None]:
        """Yield the frames (H, W) in order; None for one that is damaged."""
        if self._is_exact:
            for image in ffv1.read_whole_video(self._path):
                yield None if isinstance(image, str) else image
            return
        with self._opened() as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            for packet in container.demux(stream):
                try:
                    decoded = packet.decode()
                except av.error.FFmpegError:
                    yield None
                    continue
                for frame in decoded:
                    yield None if frame.is_corrupt else self._luma(frame)

    def _luma(self, frame: av.VideoFrame) -> Integers:
        plane = frame.planes[0]
        rows = np.frombuffer(memoryview(plane), self._stored)
        rows = rows.reshape(-1, plane.line_size // self._stored.itemsize)
        return np.ascontiguousarray(rows[: frame.height, : frame.width], dtype=self.dtype)

    def _opened(self) -> av.container.InputContainer:
        return opened_video(
            self._path,
            ("ffv1", "h264"),
            "FFV1 or H.264 is needed",
            ("matroska", "webm", "mov", "mp4", "m4a", "3gp", "3g2", "mj2", "avi"),
        )


Images = Callable[[], Iterator[Integers | None]]
"""Yields the images from the first on, None for one that cannot be read."""


def sidecar_of(path: Path) -> Path:
    """Return where the times of a video, or of a folder of images, lie: its name with .csv."""
    return path.parent / f"{path.stem if path.is_file() else path.name}.csv"


class FileSource:
    """A video, or a folder of images, played in real time from the moment it begins.

    `rate_hz` and `exposure_s` hold where no table states times and exposures. A looped source begins again
    after its last frame.
    """

    def __init__(
        self, path: Path, images: Images, rate_hz: float, exposure_s: float, is_looped: bool
    ) -> None:
        table = sidecar_of(path)
        self._images, self._is_looped = images, is_looped
        self._rows = read_frame_rows(table)[0] if table.exists() else ()
        self._rate_hz, self._exposure_s = rate_hz, exposure_s
        self._began_s = math.nan
        self._played = self._frames()
        self._next = next(self._played, None)
        if self._next is None:
            raise in_file(path, "holds no frame")

    @property
    def is_over(self) -> bool:
        """True once the last frame was read."""
        return self._next is None

    def begin(self) -> None:
        """Let the first frame's exposure begin now."""
        self._began_s = time.monotonic()

    def read(self) -> Frame | None:
        """Return the next frame once its time has come; None before, and for one that is damaged."""
        if self._next is None:
            return None
        row, image_dn = self._next
        captured_s = self._began_s + row.timestamp_s
        if not wait_until(captured_s + row.exposure_s / 2.0):
            return None
        # The next one is decoded now: when its time has come there is none for it.
        self._next = next(self._played, None)
        if image_dn is None:
            return None
        return Frame(row.index, captured_s, image_dn, row.exposure_s, row.current_a, row.laser_on, row.arc_on)

    def close(self) -> None:
        """Play no more."""
        self._next = None

    def _frames(self) -> Iterator[tuple[FrameRow, Integers | None]]:
        """Yield frames, and their rows with times from the beginning on."""
        index, begins_s = 0, 0.0
        for _ in repeat(None) if self._is_looped else (None,):
            ends_s, taken = begins_s, 0
            for row, image_dn in zip(self._own_rows(), self._images(), strict=False):
                captured_s = begins_s + row.timestamp_s
                shown = FrameRow(
                    index + row.index, captured_s, row.laser_on, row.arc_on, row.current_a, row.exposure_s
                )
                yield shown, image_dn
                period_s = captured_s - ends_s if taken else 1.0 / self._rate_hz
                ends_s, taken = captured_s, row.index + 1
            if taken == 0:
                return
            index, begins_s = index + taken, ends_s + period_s - self._first_s

    @property
    def _first_s(self) -> float:
        return self._rows[0].exposure_s / 2.0 if self._rows else self._exposure_s / 2.0

    def _own_rows(self) -> Iterator[FrameRow]:
        """Yield the table's rows from number 0 on, without a table as many as are needed."""
        if self._rows:
            first = self._rows[0]
            shift_s = self._first_s - first.timestamp_s
            for row in self._rows:
                yield FrameRow(
                    row.index - first.index,
                    row.timestamp_s + shift_s,
                    row.laser_on,
                    row.arc_on,
                    row.current_a,
                    row.exposure_s,
                )
            return
        for n in count():
            yield FrameRow(n, self._first_s + n / self._rate_hz, True, True, NAN, self._exposure_s)


def video_source(path: Path, setup: Setup, is_looped: bool, _ask: Ask) -> FileSource:
    """Return a video as a source; ArctrackError if it cannot be read, or does not fit the setup."""
    video = LumaVideo(path)
    problem = frame_misfit(video.shape, video.dtype, setup)
    if problem is not None:
        raise in_file(path, problem)
    if not video.rate_hz > 0.0 and not sidecar_of(path).exists():
        raise in_file(path, f"states no frame rate: put the times into {sidecar_of(path).name} beside it")
    return FileSource(path, video.frames, video.rate_hz or 1.0, setup.camera.exposure_s, is_looped)


def folder_source(path: Path, setup: Setup, rate_hz: float, is_looped: bool, _ask: Ask) -> FileSource:
    """Return a folder of images as a source, by their numbers.

    Raises ArctrackError if there is none, or if the first does not fit the setup.
    """
    if not path.is_dir():
        raise in_file(path, "is no folder; state the folder of the images")
    paths = find_images([path]).paths
    first = EncodedImage(paths[0]).pixels()
    problem = frame_misfit(first.shape, first.dtype, setup)
    if problem is not None:
        raise in_file(paths[0], problem)

    def images() -> Iterator[Integers | None]:
        for pixels in map(_pixels_of, paths):
            fits = pixels is not None and frame_misfit(pixels.shape, pixels.dtype, setup) is None
            yield pixels if fits else None

    return FileSource(path, images, rate_hz, setup.camera.exposure_s, is_looped)


def _pixels_of(path: Path) -> Integers | None:
    """Return an image's pixels, None where it was damaged since."""
    try:
        return np.ascontiguousarray(EncodedImage(path).pixels())
    except ArctrackError:
        return None
