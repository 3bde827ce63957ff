"""Outbox of a browser: short, and the newest messages only. A slow browser blocks nobody."""

import asyncio
from collections import deque
from enum import Enum

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


COUNTS_ALONE = frozenset({MessageKind.STATUS, MessageKind.PICTURE, MessageKind.HEAT})
"""Kinds of which only the newest message counts: an older one that still waits is not sent."""


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
        if kind in COUNTS_ALONE:
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
