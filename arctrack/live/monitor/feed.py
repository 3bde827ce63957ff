"""Feed of a run's journal to all browsers; each message is made once."""

import asyncio
import json
import math
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from enum import Enum

from arctrack.live.journal.journal import JournalReader
from arctrack.live.journal.records import Entry, FrameView, GapReport, Status
from arctrack.live.monitor.options import MonitorOptions
from arctrack.live.monitor.picture import MonitorPicture, Painter
from arctrack.live.monitor.status import SHOWN_S, FrameRate, OffsetFlow, Point, point_of, status_content
from tracker.arc.level import ArcLevel

MAX_WAITING = 32
"""Largest number of messages that wait for a browser; beyond it the oldest are dropped."""

Message = str | bytes


class MessageKind(Enum):
    """Kind of a message."""

    HELLO = "hello"
    STATUS = "status"
    POINTS = "points"
    PICTURE = "picture"
    HEAT = "heat"


class Outbox:
    """Messages queued for one browser; `dropped` counts those replaced by newer ones."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[MessageKind, Message]] = deque()
        self._filled = asyncio.Event()
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, kind: MessageKind, message: Message) -> None:
        """Let a message wait, in the place of an older one where only the newest counts."""
        before = len(self._waiting)
        # Kinds of which only the newest message counts: an older one that still waits is not sent.
        if kind in (MessageKind.STATUS, MessageKind.PICTURE, MessageKind.HEAT):
            self._waiting = deque(held for held in self._waiting if held[0] is not kind)
        while len(self._waiting) >= MAX_WAITING:
            self._waiting.popleft()
        self.dropped += before - len(self._waiting)
        self._waiting.append((kind, message))
        self._filled.set()

    async def take(self) -> Message:
        """Return the message that waits longest, as soon as there is one."""
        while not self._waiting:
            self._filled.clear()
            await self._filled.wait()
        return self._waiting.popleft()[1]


class Feed:
    """State of a run as the page's process knows it, and the browsers that it is sent to.

    `status` and `gap` are the newest, `arc` is that of the newest view; None before the first.
    """

    def __init__(self, reader: JournalReader, options: MonitorOptions, has_black_box: bool) -> None:
        self._reader, self._options, self._has_black_box = reader, options, has_black_box
        self.status: Status | None = None
        self.gap: GapReport | None = None
        self.arc: ArcLevel | None = None
        self._changed_s = -math.inf
        self._rate, self._offset_flow = FrameRate(), OffsetFlow()
        self._points: deque[Point] = deque()
        self._next = reader.count
        self._picture: MonitorPicture | None = None
        self._heat: bytes | None = None
        self._heated_s = -math.inf
        self._painter = Painter(options.setups)
        self._painting = asyncio.Lock()
        self._executor = ThreadPoolExecutor(1, "painter")
        self._outboxes: set[Outbox] = set()
        self._painted: asyncio.Task[MonitorPicture | None] | None = None

    @property
    def browsers(self) -> int:
        """Number of connected browsers."""
        return len(self._outboxes)

    @property
    def status_age_s(self) -> float:
        """Age of the run's newest status, s; infinite before the first."""
        return time.monotonic() - self._changed_s

    @property
    def is_alive(self) -> bool:
        """True while the run's process lives."""
        return self._reader.is_writer_alive

    @property
    def rate_hz(self) -> float:
        """Frame rate of the tracking; NaN if unknown."""
        return self._rate.hz

    @property
    def offset_age_s(self) -> float:
        """Age of the last offset that the robot may use, s before the status; infinite before the first."""
        return self._offset_flow.age_s

    @property
    def frame_age_s(self) -> float:
        """Age of the newest frame, s; NaN before the first."""
        if self.status is None:
            return math.nan
        return self.status.now_s - self.status.frame_s + self.status_age_s

    async def run(self) -> None:
        """Read the journal without end."""
        for tick in range(2**62):
            # Pictures are made at most as often.
            due_s = time.monotonic() + 0.1
            self._look(tick)
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))

    def join(self, outbox: Outbox) -> None:
        """Add a browser, and send it what is known already."""
        outbox.put(MessageKind.HELLO, self._hello())
        outbox.put(MessageKind.STATUS, self.status_text())
        for kind, message in ((MessageKind.PICTURE, self._picture), (MessageKind.HEAT, self._heat)):
            if message is not None:
                outbox.put(kind, message.message if isinstance(message, MonitorPicture) else message)
        self._outboxes.add(outbox)

    def leave(self, outbox: Outbox) -> None:
        """Remove a browser."""
        self._outboxes.discard(outbox)

    def status_text(self) -> str:
        """Return how the run stands as JSON."""
        content = status_content(
            self._options,
            self.status,
            self.gap,
            self.arc,
            self.rate_hz,
            self.offset_age_s,
            self._points[-1] if self._points else None,
        )
        content |= {
            "age_s": round(min(self.status_age_s, 1e6), 3),
            "is_alive": self.is_alive,
            "browsers": self.browsers,
        }
        return json.dumps(content, allow_nan=False)

    async def picture(self) -> MonitorPicture | None:
        """Return the newest frame's picture, painted where it was not; None before the first frame."""
        async with self._painting:
            view = self._reader.newest_view()
            if view is None or (self._picture is not None and self._picture.position == view.position):
                return self._picture
            entry = self._reader.entry(view.position)
            if entry is None:
                return self._picture
            loop = asyncio.get_running_loop()
            self.arc = arc_of(view)
            self._picture = await loop.run_in_executor(self._executor, self._painter.paint, entry, view)
            self._send(MessageKind.PICTURE, self._picture.message)
            if self._outboxes and time.monotonic() - self._heated_s > 0.5:
                self._heated_s = time.monotonic()
                self._heat = await loop.run_in_executor(self._executor, self._painter.heat, entry, view)
                self._send(MessageKind.HEAT, self._heat)
            return self._picture

    def _look(self, tick: int) -> None:
        """Read what the run has written since the last look."""
        status = self._reader.status()
        if status is not None and (self.status is None or status.now_s != self.status.now_s):
            self.status, self._changed_s = status, time.monotonic()
            self._rate.add(status)
            self._offset_flow.add(status)
        points = self._new_points()
        if points:
            self._points.extend(points)
            while self._points[-1][0] - self._points[0][0] > SHOWN_S:
                self._points.popleft()
            self._send(MessageKind.POINTS, json.dumps({"kind": "points", "points": points}, allow_nan=False))
        if tick % 2 == 0:
            self.gap = self._reader.gap()
            if not self._outboxes:
                view = self._reader.newest_view()
                self.arc = None if view is None else arc_of(view)
            self._send(MessageKind.STATUS, self.status_text())
        if self._outboxes and not self._painting.locked():
            self._painted = asyncio.create_task(self.picture())

    def _new_points(self) -> list[Point]:
        """Return the points of the entries since the last look, in order, but not of all where many came."""
        count = self._reader.count
        positions = range(max(self._next, self._reader.first), count)
        self._next = count
        # Two entries a look: a line of three minutes shows no more.
        step = max(1, -(-len(positions) // 2))
        # Backwards, so that the newest is among them.
        entries: list[Entry | None] = [self._reader.entry(k) for k in reversed(positions[::-step])]
        return [point_of(entry) for entry in entries if entry is not None]

    def _hello(self) -> str:
        content = {
            "kind": "hello",
            "title": self._options.title,
            "has_black_box": self._has_black_box,
            "shown_s": SHOWN_S,
            "points": list(self._points),
        }
        return json.dumps(content, allow_nan=False)

    def _send(self, kind: MessageKind, message: Message) -> None:
        for outbox in self._outboxes:
            outbox.put(kind, message)


def arc_of(view: FrameView) -> ArcLevel | None:
    """Return a view's arc as its track has it, which knows one that the frame was not read with."""
    arc, track = view.arc, view.track
    if arc is None or not math.isfinite(track.arc_level):
        return arc
    return ArcLevel(track.arc_level, track.arc_level_sigma, arc.black_e, track.map_misfit)
