"""A bus that stays: what fails is counted and dropped, and an adapter that went away is opened again."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from enum import Enum

import can

LOST_AFTER_S = 0.2
"""Duration of failures alone after which the bus is lost: ten periods of a status."""

BACK_OFF_S = (0.1, 0.2, 0.5, 1.0, 2.0)
"""The waits before each attempt to open it again; the last one over and over."""

_LOG = logging.getLogger(__name__)


class LinkFault(Enum):
    """Fault of a bus that does not end the run.

    Attributes
    ----------
    UNREADABLE
        Something came that is no frame.
    UNSENT
        A frame did not go out in time.
    ERROR_FRAME
        The bus' hardware told of an error.
    BUS_OFF
        The adapter's controller left the bus.
    LOST
        The bus was gone, and is opened again.
    UNLOGGED
        A frame is in no log: the disk did not take it.
    """

    UNREADABLE = "unreadable"
    UNSENT = "unsent"
    ERROR_FRAME = "error_frame"
    BUS_OFF = "bus_off"
    LOST = "lost"
    UNLOGGED = "unlogged"


class NoFrame(Enum):
    """Placeholder of a frame where none is received."""

    QUIET = "nothing came in time"
    UNREADABLE = "something came that is no frame"


class ReconnectingBus:
    """A python-can bus that never raises once it is open.

    `open_bus` opens it; what it raises the first time goes to the caller. `faults` counts what went wrong.
    """

    def __init__(self, name: str, open_bus: Callable[[], can.BusABC]) -> None:
        self.faults: Counter[LinkFault] = Counter()
        self._name = name
        self._open_bus = open_bus
        self._bus: can.BusABC | None = open_bus()
        self._fails_since_s: float | None = None
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._reopening: threading.Thread | None = None

    @property
    def is_lost(self) -> bool:
        """True if there is no bus at present."""
        return self._bus is None

    def send(self, frame: can.Message) -> bool:
        """Send a frame, and return whether it went out in time."""
        bus = self._bus
        if bus is not None:
            try:
                # At 125 kbit/s a frame takes 1.1 ms; the next offset comes in 20 ms.
                bus.send(frame, 0.01)
            except Exception as error:  # an interface raises what its driver does
                self._say(LinkFault.UNSENT, error)
            else:
                return True
        self.faults[LinkFault.UNSENT] += 1
        return False

    def receive(self, timeout_s: float) -> can.Message | NoFrame:
        """Return the next frame."""
        bus = self._bus
        if bus is None:
            time.sleep(timeout_s)
            return NoFrame.QUIET
        try:
            frame = bus.recv(timeout_s)
        except Exception as error:  # a parser raises what the line makes it raise
            self._say(LinkFault.UNREADABLE, error)
            self.faults[LinkFault.UNREADABLE] += 1
            now_s = time.monotonic()
            if self._fails_since_s is None:
                self._fails_since_s = now_s
            elif now_s - self._fails_since_s > LOST_AFTER_S:
                self._lose(bus)
            # A bus that is gone says so at once, again and again.
            time.sleep(0.001)
            return NoFrame.UNREADABLE
        self._fails_since_s = None
        if frame is None:
            return NoFrame.QUIET
        if frame.is_error_frame:
            self.faults[LinkFault.ERROR_FRAME] += 1
            # SocketCAN's bit for a controller that is off the bus.
            if frame.arbitration_id & 0x40:
                self.faults[LinkFault.BUS_OFF] += 1
                self._lose(bus)
        return frame

    def close(self) -> None:
        """Leave the bus."""
        self._closed.set()
        with self._lock:
            bus, self._bus = self._bus, None
        if bus is not None:
            _shut_down(bus)
        if self._reopening is not None:
            self._reopening.join(BACK_OFF_S[-1])

    def _lose(self, bus: can.BusABC) -> None:
        with self._lock:
            if self._bus is not bus:
                return
            self._bus, self._fails_since_s = None, None
        self.faults[LinkFault.LOST] += 1
        _LOG.warning("%s: lost; it is opened again", self._name)
        _shut_down(bus)
        self._reopening = threading.Thread(target=self._reopen, name=f"reopen {self._name}", daemon=True)
        self._reopening.start()

    def _reopen(self) -> None:
        attempt = 0
        while not self._closed.wait(BACK_OFF_S[min(attempt, len(BACK_OFF_S) - 1)]):
            attempt += 1
            try:
                bus = self._open_bus()
            except Exception as error:  # whatever it is, it is tried again
                _LOG.info("%s: not open yet: %s", self._name, error)
                continue
            with self._lock:
                if not self._closed.is_set():
                    self._bus = bus
            if self._closed.is_set():
                _shut_down(bus)
                return
            _LOG.warning("%s: open again after %d attempts", self._name, attempt)
            return

    def _say(self, fault: LinkFault, error: Exception) -> None:
        # Once: a bus that fails fails a thousand times a minute.
        if not self.faults[fault]:
            _LOG.warning("%s: %s: %s", self._name, fault.value, error)


def _shut_down(bus: can.BusABC) -> None:
    with suppress(Exception):  # it is gone, or goes
        bus.shutdown()
