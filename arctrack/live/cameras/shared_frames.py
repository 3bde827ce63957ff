"""Frames from one process to others, through memory that they share (`arctrack.live.journal.ring`)."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from arctrack.closing import Closing
from arctrack.errors import ArctrackError
from arctrack.live.journal.private_memory import private_path
from arctrack.live.journal.ring import RingError, RingReader, RingWriter
from tracker.state import Frame

KIND = struct.Struct("<8sII8s")
"""Kind of the records: frames of a version, height, width, dtype."""

VERSION = b"frames1"
FIELDS = struct.Struct("<QdddBB6x")
"""The frame's number, time of its mid-exposure, exposure, current, laser, arc: then the image."""

SLOTS = 4


class SharedFramesError(ArctrackError):
    """Frames cannot be shared, or read."""


def ring_name(name: str) -> str:
    """Return the name of the ring that holds frames of a name."""
    return f"frames-{name}"


def path_of(name: str) -> Path:
    """Return where frames of a name lie."""
    return private_path(ring_name(name))


def pack_fields(frame: Frame) -> bytes:
    """Return all of a frame but its image."""
    return FIELDS.pack(
        frame.index, frame.timestamp_s, frame.exposure_s, frame.current_a, frame.laser_on, frame.arc_on
    )


def unpack_frame(fields: npt.NDArray[np.uint8], image_dn: npt.NDArray[Any]) -> Frame:
    """Return the frame of its packed fields and its image."""
    index, timestamp_s, exposure_s, current_a, laser_on, arc_on = FIELDS.unpack_from(fields.data)
    return Frame(index, timestamp_s, image_dn, exposure_s, current_a, bool(laser_on), bool(arc_on))


class SharedFramesWriter(Closing):
    """Publisher of frames in shared memory; readers never block it.

    A name has one writer at a time. Grey levels are uint8 or uint16. Raises SharedFramesError if a writer of
    this name is alive, or there is no room.
    """

    def __init__(self, name: str, height: int, width: int, dtype: npt.DTypeLike = np.uint8) -> None:
        self._shape, self._dtype = (height, width), np.dtype(dtype)
        kind = KIND.pack(VERSION, height, width, self._dtype.str.encode())
        try:
            self._ring = RingWriter(
                ring_name(name), SLOTS, FIELDS.size + height * width * self._dtype.itemsize, kind
            )
        except RingError as error:
            raise SharedFramesError(f"frames {name!r}: {_said(error)}") from error
        self.path = self._ring.path

    def publish(self, frame: Frame) -> None:
        """Publish a frame; ValueError if its image is not of the size and type that were agreed."""
        image = np.ascontiguousarray(frame.image_dn)
        if image.shape != self._shape or image.dtype != self._dtype:
            raise ValueError(f"frame {frame.index}: is {image.shape} of {image.dtype}")
        self._ring.write(pack_fields(frame), image)

    def close(self) -> None:
        """Take the frames away."""
        self._ring.close()


class SharedFramesReader(Closing):
    """Reader of the newest frame published under a name.

    `missed` counts frames that were published and not read; a gap in the frame numbers is a frame lost before
    it was published. Raises SharedFramesError if nobody publishes such frames.
    """

    def __init__(self, name: str) -> None:
        self.missed = 0
        self._dtype: np.dtype[Any]
        try:
            self._ring = RingReader(ring_name(name))
        except RingError as error:
            raise SharedFramesError(f"frames {name!r}: {_said(error)}") from error
        version, height, width, dtype = KIND.unpack_from(self._ring.kind.ljust(KIND.size, b"\0"))
        if version.rstrip(b"\0") != VERSION:
            self._ring.close()
            raise SharedFramesError(f"frames {name!r}: are of another version")
        self._shape, self._dtype = (height, width), np.dtype(dtype.rstrip(b"\0").decode())
        self._seen = self._ring.count
        self._index: int | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """The images' height and width, px."""
        return self._shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of their grey levels."""
        return self._dtype

    @property
    def is_writer_alive(self) -> bool:
        """True while a process publishes: what it leaves is the last that it wrote."""
        return self._ring.is_writer_alive

    @property
    def is_newest_read(self) -> bool:
        """True if no frame was published since the last read."""
        return self._ring.count == self._seen

    def newest(self) -> Frame | None:
        """Return the newest frame that was not read yet, None where there is none; its image is a copy."""
        newest = self._ring.newest(self._seen)
        if newest is None:
            return None
        position, record = newest
        frame = unpack_frame(record, record[FIELDS.size :].view(self._dtype).reshape(self._shape))
        skipped = -1 if self._index is None else frame.index - self._index - 1
        # Of numbers that do not rise, nothing is known but how many were published.
        self.missed += max(skipped, position - self._seen)
        self._seen, self._index = position + 1, frame.index
        return frame

    def close(self) -> None:
        """Read no more."""
        self._ring.close()


def _said(error: RingError) -> str:
    """Return what is wrong, without the ring's own name."""
    return str(error).partition(": ")[2]
