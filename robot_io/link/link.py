"""The bus itself: any python-can interface, protected messages out, accepted messages in, all logged.

Nothing waits to be sent: a message goes out at once or not at all, so that no old one comes before a new one.
"""

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import Event, Lock
from typing import Any

import can

from robot_io.clocks.bus_clock import BusClock
from robot_io.link.bus_log import UNIX_TIME_FROM_S
from robot_io.link.inbox import LIVE, Inbox, Received, Trusted
from robot_io.link.reconnecting import LinkFault, NoFrame, ReconnectingBus
from robot_io.link.steady_log import SteadyLog
from robot_io.protocol.messages import BusMessage, Source
from robot_io.protocol.protect import Protector

_CURES = {
    "kvaser": "install Kvaser's CANlib, and check the channel's number",
    "socketcan": "bring it up (ip link set CHANNEL up type can bitrate 500000)",
    "slcan": "check the serial port and its permissions, and that pyserial is installed (python-can[serial])",
    "udp_multicast": (
        "give a multicast address such as 239.74.163.2, and install msgpack (python-can[multicast])"
    ),
}
_LOOK_UP_S = 0.02
"""Period at which a waiting reader checks whether the link was closed: a bus does not wake it."""

_FAILURES = (can.CanError, OSError, ImportError, ValueError, TypeError, NotImplementedError)


class LinkError(ValueError):
    """The bus cannot be opened, or failed while in use."""


class Link:
    """A place on the bus. `close` it, or use it as a context manager.

    Everything that goes over the bus is logged, foreign frames included. One thread may send while another
    receives. A third may `close` it, which ends what `receive` yields.

    Once it is open, what fails is counted in `faults` and dropped: a frame that cannot be read, a full queue,
    a frame that nobody takes in time, a log on a disk that is full. A bus that went away is opened again.

    Parameters
    ----------
    interface : str
        python-can's interface: `virtual`, `udp_multicast`, `socketcan`, `slcan` …
    channel : str
        python-can's channel.
    bitrate_bit_s : int, optional
        The bit rate, bit/s, for interfaces that set it themselves.
    log_paths : sequence of Path
        Logs to write: `.blf`, `.asc`, `.log`.
    source : Source
        Where what is sent comes from. Who trusts live frames alone takes no others.
    trusted : Trusted
        Whose frames are accepted.
    open_bus : callable, optional
        How the bus is opened where it is none of python-can's, such as a robot's port.
    **bus_options
        Further options of python-can's interface.

    Raises
    ------
    LinkError
        If the bus cannot be opened.
    BusLogError
        If a log cannot be opened.
    """

    def __init__(
        self,
        interface: str = "virtual",
        channel: str = "arctrack",
        *,
        bitrate_bit_s: int | None = None,
        log_paths: Sequence[Path] = (),
        source: Source = Source.LIVE,
        trusted: Trusted = LIVE,
        open_bus: Callable[[], can.BusABC] | None = None,
        **bus_options: Any,
    ) -> None:
        self.interface = interface
        self.channel = channel
        self.inbox = Inbox(trusted)
        self._protector = Protector(source)
        self._lock = Lock()
        self._receiving = Lock()
        self._closed = Event()
        self._clock = BusClock()
        self._was_empty_at_s = time.monotonic()
        self._echoes: deque[tuple[int, bytes]] = deque(maxlen=256)
        if bitrate_bit_s is not None:
            bus_options["bitrate"] = bitrate_bit_s
        if interface == "virtual":
            bus_options.setdefault("preserve_timestamps", True)
        with ExitStack() as opened:
            # First the bus: where there is none, no log that is there is begun anew.
            self._bus = ReconnectingBus(
                f"CAN {interface}:{channel}", open_bus or (lambda: self._open(bus_options))
            )
            opened.callback(self._bus.close)
            self._logs: list[SteadyLog] = []
            for path in log_paths:
                self._logs.append(SteadyLog(path, self._bus.faults))
                opened.callback(self._logs[-1].close)
            self._opened = opened.pop_all()

    def __enter__(self) -> "Link":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def faults(self) -> Counter[LinkFault]:
        """Counts of faults on the bus."""
        return self._bus.faults

    def close(self) -> None:
        """Leave the bus and finish the logs."""
        self._closed.set()
        with self._receiving:
            self._opened.close()

    def send(self, message: BusMessage, timestamp_s: float | None = None) -> bool:
        """Protect a message, send it and log it.

        Parameters
        ----------
        message : BusMessage
            The message.
        timestamp_s : float, optional
            The time that the log, and the `virtual` bus, gives the frame, s; by default the wall clock. A
            replay gives the recording's time.

        Returns
        -------
        bool
            True if it went out in time; otherwise it is dropped.

        Raises
        ------
        CodecError
            If a signal cannot carry its value; nothing is sent.
        LinkError
            If the link is closed.
        BusLogError
            If a log cannot hold that time; nothing is sent.
        """
        if self._closed.is_set():
            raise self._error("send", ValueError("the link is closed"))
        sent_at_s = time.time() if timestamp_s is None else timestamp_s
        for log in self._logs:
            log.require(sent_at_s)
        arbitration_id, payload = self._protector.protect(message)
        frame = can.Message(
            timestamp=sent_at_s,
            arbitration_id=arbitration_id,
            is_extended_id=False,
            data=payload,
            is_rx=False,
        )
        # Multicast hands a sender its own frames back.
        if self.interface == "udp_multicast":
            with self._lock:
                self._echoes.append((arbitration_id, payload))
        if not self._bus.send(frame):
            return False
        self._log(frame)
        return True

    def receive(self, timeout_s: float | None = None) -> Iterator[Received]:
        """Yield accepted messages until none has come for some time.

        A message that is not ours, fails E2E or cannot be decoded is logged and counted in `inbox.skipped`.
        `Received.max_age_s` says how long before its reading it came at most.

        Parameters
        ----------
        timeout_s : float, optional
            How long to wait for the next message, s. 0 yields what waits; None waits until the link is
            closed.

        Yields
        ------
        Received
            Its time is the wall clock's, s, also where an adapter counts from its start. On `virtual` it is
            the sender's.

        Raises
        ------
        LinkError
            If the link is closed before it begins.
        """
        if self._closed.is_set():
            raise self._error("receive", ValueError("the link is closed"))
        deadline_s = _deadline_s(timeout_s)
        while True:
            remaining_s = math.inf if deadline_s is None else max(0.0, deadline_s - time.monotonic())
            with self._receiving:
                if self._closed.is_set():
                    return
                received = self._next(min(remaining_s, _LOOK_UP_S))
            if received is NoFrame.QUIET and remaining_s <= _LOOK_UP_S:
                return
            if isinstance(received, Received):
                yield received
                deadline_s = _deadline_s(timeout_s)

    def _next(self, timeout_s: float) -> Received | NoFrame | None:
        """Return the next message, logged; None for a frame that is no message."""
        # What waits is read first: where nothing does, what comes then has not waited.
        frame = self._bus.receive(0.0)
        if frame is NoFrame.QUIET:
            self._was_empty_at_s = time.monotonic()
            with self._lock:
                for log in self._logs:
                    log.keep()
            frame = self._bus.receive(timeout_s)
        if isinstance(frame, NoFrame):
            return frame
        if self._is_echo(frame):
            return None
        max_age_s = self._set_time(frame)
        self._log(frame)
        return self.inbox.receive(frame, max_age_s)

    def _open(self, bus_options: dict[str, Any]) -> can.BusABC:
        try:
            # Configuration files of the machine must not change what was asked for here.
            if self.interface == "slcan":
                from robot_io.link.slcan import SlcanBus

                return SlcanBus(self.channel, **bus_options)
            return can.Bus(interface=self.interface, channel=self.channel, ignore_config=True, **bus_options)
        except (*_FAILURES, NameError) as error:
            # Without its vendor's library an interface of python-can may miss names of its own.
            raise self._error("open", error) from error

    def _set_time(self, frame: can.Message) -> float:
        """Give a received frame its time, and return how long before now it came at most, s.

        The time is a recording's on `virtual`, the wall clock's on any other bus.
        """
        if self.interface == "virtual":
            return 0.0
        now_s = time.time()
        if not frame.timestamp:
            # There is no time at all: it came after nothing was there.
            frame.timestamp = now_s - (time.monotonic() - self._was_empty_at_s)
        elif frame.timestamp < UNIX_TIME_FROM_S:
            # Some adapters count from their start.
            frame.timestamp = self._clock.wall_s(frame.timestamp, now_s)
        return max(0.0, now_s - frame.timestamp)

    def _log(self, frame: can.Message) -> None:
        with self._lock:
            for log in self._logs:
                log.write(frame)

    def _is_echo(self, frame: can.Message) -> bool:
        key = (frame.arbitration_id, bytes(frame.data))
        with self._lock:
            if key not in self._echoes:
                return False
            self._echoes.remove(key)
        return True

    def _error(self, doing: str, error: Exception) -> LinkError:
        reason = " ".join(str(error).split()) or type(error).__name__
        cure = _CURES.get(self.interface, "check the interface's name and channel in python-can's list")
        cure = cure.replace("CHANNEL", self.channel)
        return LinkError(f"CAN {self.interface}:{self.channel}: cannot {doing} ({reason}); {cure}")


def _deadline_s(timeout_s: float | None) -> float | None:
    return None if timeout_s is None else time.monotonic() + timeout_s
