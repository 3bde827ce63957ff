"""Videos, whatever their codec: opened to be read, or written frame by frame."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
from av.video.stream import VideoStream

from arctrack.closing import Closing
from arctrack.errors import in_file


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
