"""A video that is written frame by frame, whatever its codec."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
from av.video.stream import VideoStream

from arctrack.closing import Closing


def address(path: Path) -> str:
    """Return a path as FFmpeg takes it: what stands before a colon in a relative one would be a protocol."""
    return str(path.absolute())


class VideoFile(Closing):
    """A video file with one stream; what was written before a crash can be played once it is closed."""

    def __init__(self, path: Path, codec: Literal["ffv1", "libx264"], rate: Fraction) -> None:
        self._container = av.open(address(path), mode="w")
        self._stream: VideoStream = self._container.add_stream(codec, rate=rate)

    def close(self) -> None:
        """Write what is buffered and close the file."""
        self._container.mux(self._stream.encode())
        self._container.close()
