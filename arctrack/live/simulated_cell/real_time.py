"""A scheduler and a bus in real time, for the parties that the deterministic cell has."""

import heapq
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import can

from arctrack.simulation.cell.bus import BusFrame, Listener
from arctrack.simulation.cell.scheduler import Scheduler

LONGEST_WAIT_S = 0.02
"""Period of checking whether to go on, s."""


class RealTimeScheduler(Scheduler):
    """Does what is due once it is due; its time counts from `began_s` of the machine's monotonic clock."""

    def __init__(self) -> None:
        super().__init__()
        self.began_s = time.monotonic()

    def run_while(self, goes_on: Callable[[], bool], wait: Callable[[float], None]) -> None:
        """Run while `goes_on`; `wait` waits for at most a time, s, and reads the bus."""
        while goes_on():
            self.now_s = time.monotonic() - self.began_s
            while self._heap and self._heap[0][0] <= self.now_s:
                _, _, action = heapq.heappop(self._heap)
                action()
                self.now_s = time.monotonic() - self.began_s
            until_s = self._heap[0][0] - self.now_s if self._heap else LONGEST_WAIT_S
            wait(min(max(until_s, 0.0), LONGEST_WAIT_S))


@dataclass
class RealBus:
    """One node's frames over python-can; echoes of its own frames are dropped.

    `unsent` counts the frames that the bus did not take.
    """

    can_bus: can.BusABC
    scheduler: RealTimeScheduler
    unsent: int = 0
    _listener: Listener | None = None
    _sent: deque[tuple[int, bytes]] = field(default_factory=lambda: deque(maxlen=512))

    def join(self, node: str, listener: Listener) -> None:
        """Deliver what others send to the node."""
        self._listener = listener

    def send(self, sender: str, arbitration_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        try:
            self.can_bus.send(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))
        except can.CanError:
            self.unsent += 1
            return
        self._sent.append((arbitration_id, bytes(data)))

    def listen(self, wait_s: float) -> None:
        """Read what comes within a time, s, at most one frame after it."""
        message = self.can_bus.recv(wait_s)
        if message is None or message.is_error_frame or self._listener is None:
            return
        key = (message.arbitration_id, bytes(message.data))
        if key in self._sent:
            self._sent.remove(key)
            return
        self.scheduler.now_s = time.monotonic() - self.scheduler.began_s
        self._listener(BusFrame("other", *key, self.scheduler.now_s))
