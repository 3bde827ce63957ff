"""FFV1 video, bit exact: grey frames of 8 or 16 bits in a Matroska file, one packet a frame."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import count, islice
from pathlib import Path
from typing import BinaryIO, Literal

import av
import numpy as np
import numpy.typing as npt
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream

from arctrack.closing import Closing
from arctrack.errors import in_file
from arctrack.recording.time_sources import TimeSource
from noise_model.compiled.arrays import Integers


def address(path: Path) -> str:
    """Return a path as FFmpeg takes it: what stands before a colon in a relative one would be a protocol."""
    return str(path.absolute())


def opened_video(
    path: Path, codecs: Sequence[str], needed: str, containers: Sequence[str]
) -> av.container.InputContainer:
    """Open a video for reading; nothing is decoded yet.

    `codecs` and `containers` are FFmpeg's names of what is allowed, `needed` is the message's cure for
    others. Raises ArctrackError if there is no such file, or it is no video of these kinds.
    """
    # Told what it is: in search of a format FFmpeg takes a script for one, and opens what that names.
    options = {"codec_whitelist": ",".join(codecs)}
    if len(containers) > 1:
        options["format_whitelist"] = ",".join(containers)
    try:
        container = av.open(
            address(path), mode="r", format=containers[0] if len(containers) == 1 else None, options=options
        )
    except FileNotFoundError:
        raise in_file(path, "there is no such file") from None
    except (av.error.FFmpegError, OSError) as error:
        raise in_file(path, f"cannot be read as a video: {error.strerror}") from None
    streams = container.streams.video
    codec = streams[0].codec_context.name if streams else "no video"
    if codec not in codecs:
        container.close()
        raise in_file(path, f"holds {codec}: {needed}")
    return container


class VideoFile(Closing):
    """A video file with one stream; what was written before a crash can be played once it is closed."""

    def __init__(self, path: Path, codec: Literal["ffv1", "libx264"], rate: Fraction) -> None:
        self._container = av.open(address(path), mode="w")
        self._stream: VideoStream = self._container.add_stream(codec, rate=rate)

    def close(self) -> None:
        """Write what is buffered and close the file."""
        self._container.mux(self._stream.encode())
        self._container.close()


PIXEL_FORMATS = {"gray": np.uint8, "gray16le": np.uint16}

_TICK = Fraction(1, 1000)
"""Rounding of times in a Matroska file, s."""

_FOOTER_BYTES = 8
_REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def open_video(path: Path) -> av.container.InputContainer:
    """Open a video in a Matroska file; ArctrackError unless it is FFV1. Nothing is decoded yet."""
    return opened_video(path, ("ffv1",), "must be ffv1 with gray or gray16le, which is exact", ("matroska",))


def grey_size(path: Path) -> tuple[int, int]:
    """Return the width and height of a video's frames; ArctrackError unless they are grey."""
    with open_video(path) as container:
        codec = container.streams.video[0].codec_context
        pixels = codec.format.name if codec.format is not None else "unknown pixels"
        if pixels not in PIXEL_FORMATS:
            raise in_file(path, f"holds ffv1 with {pixels}: must be gray or gray16le, which is exact")
        if len(container.streams.video) > 1:
            raise in_file(
                path, f"holds {len(container.streams.video)} videos: write each to a file of its own"
            )
        # FFmpeg's AVCOL_RANGE_MPEG: black at 16 of 256.
        if codec.color_range == 1:
            raise in_file(
                path,
                "its colour range is limited: black is not 0; write it with the full range, such as by "
                "-color_range pc of ffmpeg if levels are the sensor's",
            )
        return codec.width, codec.height


def check_video(path: Path, width: int, height: int) -> None:
    """Raise ArctrackError unless a video holds grey frames of this size."""
    size = grey_size(path)
    if size != (width, height):
        raise in_file(
            path,
            f"is {size[0]} x {size[1]}, [camera] width and height in recording.toml say {width} x {height}",
        )


def read_video(path: Path, positions: Iterable[int]) -> Iterator[Integers | str]:
    """Yield the frames (H, W) at rising positions (from 0), or what is wrong with one, as text."""
    with _packets(path) as packets:
        for position in positions:
            yield packets.frame(position)


def read_whole_video(path: Path) -> Iterator[Integers | str]:
    """Yield all frames (H, W) of a video in order, or what is wrong with one, as text."""
    with _packets(path) as packets:
        for position in count():
            frame = packets.frame(position)
            if packets.is_over:
                return
            yield frame


@contextmanager
def _packets(path: Path) -> Iterator[_Packets]:
    has_checksums = carries_checksums(path)
    with open_video(path) as container:
        stream = container.streams.video[0]
        # Frame threads delay the output; with one thread a packet in is a frame out.
        stream.codec_context.thread_count = 1
        yield _Packets(container, stream, has_checksums)


def index_of(path: Path) -> VideoIndex:
    """Return a video's number of frames and their times, without decoding them."""
    with open_video(path) as container:
        return read_index(path, container)


def carries_checksums(path: Path) -> bool:
    """Return True if a video has checksums; without them damage within a frame may go unnoticed."""
    with open_video(path) as container:
        # The first packets vote: a damaged one may lie.
        packets = islice(payloads(container.demux(container.streams.video[0])), 8)
        return any(checksums_hold(bytes(packet)) for packet in packets)


class _Packets:
    """Walks through a video's packets; its state is the place in the file, and whether that is its end."""

    def __init__(
        self, container: av.container.InputContainer, stream: VideoStream, has_checksums: bool
    ) -> None:
        self._packets = payloads(container.demux(stream))
        self._codec: VideoCodecContext = stream.codec_context
        self._next = 0
        self.is_over = False
        self._has_checksums = has_checksums
        self._broken_until_keyframe = False

    def frame(self, position: int) -> Integers | str:
        while True:
            packet = next(self._packets, None)
            if packet is None:
                self.is_over = True
                return f"the video ends after {self._next} frames"
            self._next += 1
            wanted = self._next > position
            # A frame that no other builds on need not be decoded to be passed over.
            if wanted or not packet.is_keyframe or self._broken_until_keyframe:
                decoded = self._decode(packet)
                if wanted:
                    return decoded

    def _decode(self, packet: av.Packet[VideoStream]) -> Integers | str:
        damaged = self._has_checksums and not checksums_hold(bytes(packet))
        if packet.is_keyframe:
            self._broken_until_keyframe = False
        try:
            frames = self._codec.decode(packet)
        except av.error.FFmpegError as error:
            self._broken_until_keyframe = True
            return f"frame {self._next - 1} of the video is damaged: {error.strerror}"
        if damaged or self._broken_until_keyframe or len(frames) != 1 or frames[0].is_corrupt:
            self._broken_until_keyframe = True
            return f"frame {self._next - 1} of the video is damaged"
        if frames[0].rotation:
            return (
                f"the video asks to be turned by {frames[0].rotation} degrees: write it as the sensor gave it"
            )
        pixels = frames[0].to_ndarray()
        return np.ascontiguousarray(pixels, dtype=PIXEL_FORMATS[frames[0].format.name])


def checksums_hold(packet: bytes) -> bool:
    """Return True if a packet is a chain of FFV1 slices whose CRC-32s are all right (RFC 9043, 4.9).

    libavcodec's decoder only logs a wrong one and fills the slice with something. A slice's footer is its
    size (3 bytes), an error status (1) and a CRC (4) which makes that of the whole slice 0; its bits run the
    other way round than zlib's. A file without checksums gives False for every packet.
    """
    end = len(packet)
    while end >= _FOOTER_BYTES:
        size = int.from_bytes(packet[end - _FOOTER_BYTES : end - _FOOTER_BYTES + 3], "big") + _FOOTER_BYTES
        if size > end:
            return False
        reflected = packet[end - size : end].translate(_REVERSED_BITS)
        if zlib.crc32(reflected, 0xFFFFFFFF) != 0xFFFFFFFF:
            return False
        end -= size
    return end == 0 and len(packet) > 0


class VideoWriter(VideoFile):
    """Writes frames to an FFV1 video; every frame stands alone and carries checksums."""

    def __init__(self, path: Path, width: int, height: int, dtype: npt.DTypeLike, rate_hz: float) -> None:
        self._format = "gray" if np.dtype(dtype) == np.uint8 else "gray16le"
        super().__init__(path, "ffv1", Fraction(rate_hz).limit_denominator(1000))
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = self._format
        self._stream.options = {"level": "3", "slicecrc": "1", "g": "1"}
        self._stream.codec_context.time_base = _TICK
        self._first_s: float | None = None
        self._next_tick = 0

    def write(self, image_dn: npt.NDArray[np.integer], timestamp_s: float) -> None:
        """Append a frame (H, W) of the type that was announced; times count from the first one's."""
        self._first_s = timestamp_s if self._first_s is None else self._first_s
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image_dn), format=self._format)
        frame.time_base = _TICK
        # Two frames of one tick would be refused.
        frame.pts = max(round((timestamp_s - self._first_s) / float(_TICK)), self._next_tick)
        self._next_tick = frame.pts + 1
        self._container.mux(self._stream.encode(frame))


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
