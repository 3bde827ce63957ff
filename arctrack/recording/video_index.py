"""The frames of a video without their pixels: how many, when, and whether the file has its end."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np
from av.video.stream import VideoStream

from arctrack.recording.time_sources import TimeSource

_UNKNOWN = -1
"""The element of a Matroska file that holds all frames (RFC 9559, 5.1), and a size that nobody stated."""


@dataclass(frozen=True)
class VideoIndex:
    """Index of a video's frames; `breaks_off` is what is wrong with its end, None if it is whole."""

    times: TimeSource
    breaks_off: str | None

    def __len__(self) -> int:
        return len(self.times.values)


def payloads(packets: Iterator[av.Packet[VideoStream]]) -> Iterator[av.Packet[VideoStream]]:
    """Yield the packets that hold something, up to where the container breaks off."""
    try:
        yield from (packet for packet in packets if packet.size > 0)
    except av.error.FFmpegError:
        # Nothing behind this can be found again.
        return


def read_index(path: Path, container: av.container.InputContainer) -> VideoIndex:
    """Return the index of a Matroska file that is open, whose packets are all read then."""
    stream = container.streams.video[0]
    tick_s = float(stream.time_base or 0)
    stamps = [packet.pts for packet in payloads(container.demux(stream))]
    times_s = np.array([math.nan if stamp is None else stamp * tick_s for stamp in stamps])
    times = TimeSource("the video's own times", times_s, tick_s)
    stated_s = math.nan if container.duration is None else container.duration / av.time_base
    return VideoIndex(times, _what_breaks_off(path, times_s, stated_s))


def _what_breaks_off(path: Path, times_s: np.ndarray, stated_s: float) -> str | None:
    """Return the problem of a video's end; `stated_s` is its stated duration, NaN without one."""
    size, stated = path.stat().st_size, _stated_bytes(path)
    if stated is None or 0 <= stated <= size:
        return None
    count = len(times_s)
    missing = "its writer did not finish it" if stated == _UNKNOWN else f"{size} of {stated} bytes are there"
    last_s = 2.0 * times_s[-1] - times_s[-2] if count > 1 else math.nan
    if last_s >= stated_s:
        return f"{path} breaks off after its last frame, {count - 1}: {missing}"
    return f"{path} breaks off in frame {count}: {missing}"


def _stated_bytes(path: Path) -> int | None:
    """Return a Matroska file's stated size, `_UNKNOWN` if its writer left it out, None for another file."""
    with path.open("rb") as file:
        while True:
            name = file.read(4)
            size = _element_size(file)
            if size is None or len(name) < 4:
                return None
            if name == bytes.fromhex("18538067"):
                return size if size == _UNKNOWN else file.tell() + size
            file.seek(size, 1)


def _element_size(file: BinaryIO) -> int | None:
    """Return the size that an element of EBML states (RFC 8794, 4), None at the end of the file."""
    first = file.read(1)
    if not first or not first[0]:
        return None
    length = 9 - first[0].bit_length()
    value = int.from_bytes(first + file.read(length - 1), "big") & ((1 << 7 * length) - 1)
    return _UNKNOWN if value == (1 << 7 * length) - 1 else value
