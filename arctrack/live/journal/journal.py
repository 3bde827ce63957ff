"""Journal of a live run: what it saw and did, for its subprocesses.

Three rings in shared memory: entries (a frame, its step's inputs, its track) for the black box, which reach
some time back; the newest view, for the page; the newest status. The loop writes after an offset was sent,
and never blocks.
"""

import math
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from arctrack.live.journal.private_memory import private_path
from arctrack.live.journal.records import (
    Entry,
    FrameView,
    GapReport,
    ReceivedPose,
    Status,
    pack,
    pack_entry,
    unpack,
    unpack_entry,
)
from arctrack.live.journal.ring import RingError, RingReader, RingWriter, remove_if_dead, ring_bytes

ENTRY_BYTES = 96 * 1024
"""All of an entry but its image: a tracker's state has 40 kB at most, POSES 30 kB."""

MIN_SLOTS, FEW_SLOTS = 8, 4


def entries_name(name: str) -> str:
    """Return the name of a run's ring of entries."""
    return f"entries-{name}"


def view_name(name: str) -> str:
    """Return the name of a run's ring of views."""
    return f"view-{name}"


def status_name(name: str) -> str:
    """Return the name of a run's ring of statuses."""
    return f"status-{name}"


def remove_dead_journal(name: str) -> None:
    """Remove what a run left behind whose process is dead."""
    for ring in (entries_name(name), view_name(name), status_name(name)):
        remove_if_dead(private_path(ring))


def gap_name(name: str) -> str:
    """Return the name of a run's ring of gap reports, which another process writes."""
    return f"gap-{name}"


def slots_for(kept_s: float, rate_hz: float) -> int:
    """Return how many entries a ring holds, so that those of a time, s, can be saved while more come."""
    # Ring size over the frames to keep: what is being saved must not be overwritten.
    return max(MIN_SLOTS, math.ceil(1.25 * kept_s * rate_hz))


def journal_bytes(kept_s: float, rate_hz: float, image_bytes: int) -> int:
    """Return the shared memory that a journal takes, bytes, but for what is small."""
    return ring_bytes(slots_for(kept_s, rate_hz), ENTRY_BYTES + image_bytes)


class Journal:
    """Shared-memory journal of what a live run saw and did.

    It keeps the latest `slots` entries (see `slots_for`) of images of `shape` (height, width). `lost` counts
    entries and views that did not fit. Raises RingError if shared memory has no room.
    """

    def __init__(self, name: str, shape: tuple[int, int], dtype: npt.DTypeLike, slots: int) -> None:
        height, width = shape
        image_bytes = height * width * np.dtype(dtype).itemsize
        self.lost = 0
        # Largest number of poses kept between two frames.
        self._poses: deque[ReceivedPose] = deque(maxlen=128)
        self._rings: list[RingWriter] = []
        try:
            self._entries = self._ring(entries_name(name), slots, ENTRY_BYTES + image_bytes)
            # Bytes of a view: its stripe has seven values a scan line, the rest is small.
            view_bytes = 64 * 1024 + 80 * max(shape)
            self._views = self._ring(view_name(name), FEW_SLOTS, view_bytes)
            self._statuses = self._ring(status_name(name), FEW_SLOTS, 16 * 1024)
        except BaseException:
            self.close()
            raise

    def add_pose(self, pose: ReceivedPose) -> None:
        """Keep a pose for the next entry; the oldest go where there are many."""
        self._poses.append(pose)

    def write_entry(self, entry: Entry) -> int:
        """Write an entry with the poses since the one before, and return its position."""
        poses = tuple(self._poses)
        self._poses.clear()
        try:
            self._entries.write(*pack_entry(replace(entry, poses=poses)))
        except ValueError:
            self.lost += 1
        return self._entries.count - 1

    def write_view(self, view: FrameView) -> None:
        """Write the newest view."""
        try:
            self._views.write(pack(view))
        except ValueError:
            self.lost += 1

    def write_status(self, status: Status) -> None:
        """Write how the run stands."""
        self._statuses.write(pack(status))

    def close(self) -> None:
        """Take the journal away."""
        for ring in self._rings:
            ring.close()

    def _ring(self, name: str, slots: int, record_bytes: int) -> RingWriter:
        ring = RingWriter(name, slots, record_bytes)
        self._rings.append(ring)
        return ring


class JournalReader:
    """Reader of a live run's journal, for another process; raises RingError if there is no such run."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._gaps: RingReader | None = None
        self._entries = RingReader(entries_name(name))
        self._views = RingReader(view_name(name))
        self._statuses = RingReader(status_name(name))

    @property
    def count(self) -> int:
        """Number of entries written so far."""
        return self._entries.count

    @property
    def is_writer_alive(self) -> bool:
        """True while the run's process lives; what it leaves behind can still be read."""
        return self._entries.is_writer_alive

    @property
    def first(self) -> int:
        """The position of the oldest entry that may still be there."""
        return max(0, self.count - self._entries.slots)

    def entry(self, position: int) -> Entry | None:
        """Return an entry by its position from the first, None where it is gone."""
        record = self._entries.read(position)
        return None if record is None else unpack_entry(record)

    def newest_view(self) -> FrameView | None:
        """Return the newest view, None before the first."""
        view: FrameView | None = _newest(self._views)
        return view

    def status(self) -> Status | None:
        """Return the newest status, None before the first."""
        status: Status | None = _newest(self._statuses)
        return status

    def gap(self) -> GapReport | None:
        """Return the newest gap report, None before the first and where nobody writes them."""
        if self._gaps is not None and not self._gaps.is_writer_alive:
            self._gaps.close()
            self._gaps = None
        if self._gaps is None:
            try:
                self._gaps = RingReader(gap_name(self._name))
            except RingError:
                return None
        report: GapReport | None = _newest(self._gaps)
        return report

    def close(self) -> None:
        """Read no more."""
        for ring in (self._entries, self._views, self._statuses, self._gaps):
            if ring is not None:
                ring.close()


def _newest(ring: RingReader) -> Any:
    newest = ring.newest(0)
    return None if newest is None else unpack(newest[1])
