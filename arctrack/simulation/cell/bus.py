"""A bus between parties: real frames, delays, and what goes wrong on the way."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from arctrack.simulation.cell.scheduler import Scheduler

FRAME_S = 0.00027
"""Duration of a frame of 8 bytes at 500 kbit/s, stuffed: 135 bits."""


@dataclass(frozen=True)
class BusFrame:
    """A frame on the bus, who sent it, and when."""

    sender: str
    arbitration_id: int
    data: bytes
    sent_s: float


@dataclass
class BusTrouble:
    """Disturbance of the frames of some senders and identifiers; empty tuples mean all.

    `lost` and `doubled` are shares of frames, `flipped` is the probability of a bit flip. Frames arrive
    `late_s` later, and each by up to `shuffled_s` more, drawn for each, so that they overtake each other.
    """

    senders: tuple[str, ...] = ()
    lost: float = 0.0
    doubled: float = 0.0
    flipped: float = 0.0
    late_s: float = 0.0
    shuffled_s: float = 0.0
    ids: tuple[int, ...] = ()

    def concerns(self, frame: BusFrame) -> bool:
        """Return True if a frame is affected."""
        return (not self.senders or frame.sender in self.senders) and (
            not self.ids or frame.arbitration_id in self.ids
        )


Listener = Callable[[BusFrame], None]


class BusConnection(Protocol):
    """A bus as who sends and listens sees it."""

    def join(self, node: str, listener: Listener) -> None:
        """Deliver what the others send to a node."""

    def send(self, sender: str, arbitration_id: int, data: bytes) -> None:
        """Put a frame on the bus."""


@dataclass
class Bus:
    """Simulated bus that carries each frame to all nodes but its sender.

    `trouble` lists the present disturbances.
    """

    scheduler: Scheduler
    rng: np.random.Generator
    trouble: list[BusTrouble] = field(default_factory=list)
    _listeners: dict[str, Listener] = field(default_factory=dict)
    _free_s: dict[str, float] = field(default_factory=dict)

    def join(self, node: str, listener: Listener) -> None:
        """Deliver what the others send to a node."""
        self._listeners[node] = listener

    def send(self, sender: str, arbitration_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        frame = BusFrame(sender, arbitration_id, data, self.scheduler.now_s)
        # What a sender sends waits for what it sent before.
        arrives_s = max(frame.sent_s + self.rng.exponential(0.0002), self._free_s.get(sender, 0.0)) + FRAME_S
        self._free_s[sender] = arrives_s
        delay_s = arrives_s - frame.sent_s
        copies = 1
        for trouble in self.trouble:
            if not trouble.concerns(frame):
                continue
            if self.rng.random() < trouble.lost:
                return
            copies += self.rng.random() < trouble.doubled
            delay_s += trouble.late_s + self.rng.uniform(0.0, trouble.shuffled_s)
            if trouble.flipped:
                frame = replace(frame, data=self._flipped(frame.data, trouble.flipped))
        for copy in range(copies):
            self.scheduler.at(frame.sent_s + delay_s + copy * FRAME_S, lambda: self._arrive(frame))

    def _arrive(self, frame: BusFrame) -> None:
        for node, listener in self._listeners.items():
            if node != frame.sender:
                listener(frame)

    def _flipped(self, data: bytes, probability: float) -> bytes:
        # Bits of a frame that a flip is drawn for.
        flips = self.rng.random(64) < probability
        if not flips.any():
            return data
        mask = np.packbits(flips).tobytes()
        return bytes(byte ^ flip for byte, flip in zip(data, mask, strict=True))
