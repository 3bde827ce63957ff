"""A bus between nodes: real frames, and how long they take."""

from collections.abc import Callable
from dataclasses import dataclass, field
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


Listener = Callable[[BusFrame], None]


class BusConnection(Protocol):
    """A bus as who sends and listens sees it."""

    def join(self, node: str, listener: Listener) -> None:
        """Deliver what the others send to a node."""

    def send(self, sender: str, arbitration_id: int, data: bytes) -> None:
        """Put a frame on the bus."""


@dataclass
class Bus:
    """Simulated bus that carries each frame to all nodes but its sender."""

    scheduler: Scheduler
    rng: np.random.Generator
    _listeners: dict[str, Listener] = field(default_factory=dict, init=False)
    _free_s: dict[str, float] = field(default_factory=dict, init=False)

    def join(self, node: str, listener: Listener) -> None:
        """Deliver what the others send to a node."""
        self._listeners[node] = listener

    def send(self, sender: str, arbitration_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        frame = BusFrame(sender, arbitration_id, data, self.scheduler.now_s)
        # What a sender sends waits for what it sent before.
        arrives_s = max(frame.sent_s + self.rng.exponential(0.0002), self._free_s.get(sender, 0.0)) + FRAME_S
        self._free_s[sender] = arrives_s
        self._deliver(frame, arrives_s - frame.sent_s)

    def _deliver(self, frame: BusFrame, delay_s: float) -> None:
        def arrive() -> None:
            for node, listener in self._listeners.items():
                if node != frame.sender:
                    listener(frame)

        self.scheduler.at(frame.sent_s + delay_s, arrive)
