"""The frames of a video file in order, grey levels as they are stored: FFV1 bit exact, H.264 its luma."""

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np

from arctrack.errors import in_file
from arctrack.recording import ffv1
from arctrack.recording.ffv1 import opened_video
from noise_model.compiled.arrays import Integers


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
