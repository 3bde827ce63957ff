"""Sockets of a port: datagrams, a listening stream, or a stream that arctrack opens; one robot at a time."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Protocol

from robot_io.ports.report import Dialect, PortCorrection, PortError, PortReport
from robot_io.ports.session import SILENT_S

MAX_BYTES, MAX_DATAGRAMS = 65_536, 64
"""Largest read; a datagram has no more. Largest number of datagrams read at once."""

CONNECT_S, RETRY_S = 0.5, 1.0
"""Time that a robot may take to accept, and time between attempts."""

Address = tuple[str, int]
MakeDialect = Callable[[], Dialect]


class Line(Protocol):
    """The robot's end of a port.

    `connections` counts the robots that came, each another session. `problem` is a line for people, empty
    while all is well.
    """

    connections: int
    problem: str

    def waits(self) -> list[socket.socket]:
        """Return what is to be waited for."""

    def reports(self) -> Iterator[PortReport]:
        """Yield the reports that have come."""

    def answer(self, report: PortReport, correction: PortCorrection) -> None:
        """Send the answer to a report that came last."""

    def close(self) -> None:
        """Leave the network."""


class DatagramLine:
    """UDP: the first robot that speaks sensibly has the port until it is silent for `SILENT_S`."""

    def __init__(self, address: Address, make_dialect: MakeDialect) -> None:
        self._make_dialect = make_dialect
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._robot: Address | None = None
        self._dialect: Dialect = make_dialect()
        self._heard_at_s = 0.0
        self.connections, self.problem = 0, "no robot has spoken yet"
        _bind(self._socket, address)

    def waits(self) -> list[socket.socket]:
        """Return the socket."""
        return [self._socket]

    def reports(self) -> Iterator[PortReport]:
        """Yield the reports that wait; damaged datagrams, and those of a second robot, are dropped."""
        with suppress(OSError):
            for _ in range(MAX_DATAGRAMS):
                data, sender = self._socket.recvfrom(MAX_BYTES)
                now_s = time.monotonic()
                is_other = sender != self._robot
                if is_other and self._robot is not None and now_s - self._heard_at_s <= SILENT_S:
                    self.problem = f"{sender[0]}:{sender[1]} speaks too; the port is {self._robot[0]}'s"
                    continue
                dialect = self._make_dialect() if is_other else self._dialect
                try:
                    reports, _ = dialect.hear(data)
                except PortError as error:
                    self.problem = f"{sender[0]}:{sender[1]}: {error}"
                    continue
                if is_other:
                    self._robot, self._dialect = sender, dialect
                    self.connections += 1
                self._heard_at_s, self.problem = now_s, ""
                yield from reports

    def answer(self, report: PortReport, correction: PortCorrection) -> None:
        """Send a datagram; one that the network does not take is lost, as any may be."""
        data = self._dialect.answer(report, correction)
        if data and self._robot is not None:
            with suppress(OSError):
                self._socket.sendto(data, self._robot)

    def close(self) -> None:
        """Leave the network."""
        self._socket.close()


class StreamLine:
    """TCP: a robot that connects, or with `connects` one that arctrack connects to.

    A stream that says what it must not, or that takes no answer at once, is closed: what waited in it would
    come too late.
    """

    def __init__(self, address: Address, make_dialect: MakeDialect, connects: bool = False) -> None:
        self._address, self._make_dialect = address, make_dialect
        self._stream: socket.socket | None = None
        self._listener: socket.socket | None = None
        self._tried_at_s, self._heard_at_s = -RETRY_S, 0.0
        self.connections, self.problem = 0, "no robot is connected"
        if not connects:
            self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.setblocking(False)
            _bind(self._listener, address)
            self._listener.listen(1)

    def waits(self) -> list[socket.socket]:
        """Return the robot's stream and what it connects to; without a robot try to reach it."""
        if self._stream is None and self._listener is None and time.monotonic() - self._tried_at_s >= RETRY_S:
            try:
                self._begin(socket.create_connection(self._address, CONNECT_S))
            except OSError as error:
                self.problem = f"{self._address[0]}:{self._address[1]}: {error.strerror or error}"
            self._tried_at_s = time.monotonic()
        return [each for each in (self._listener, self._stream) if each is not None]

    def reports(self) -> Iterator[PortReport]:
        """Yield the reports that wait; a second robot is turned away while the first one speaks."""
        # Silence of a stream after which it is closed: the robot was switched off, or the cable is out.
        if self._stream is not None and time.monotonic() - self._heard_at_s > 2.0:
            self._end("the robot says nothing")
        if self._listener is not None:
            with suppress(OSError):
                stream, _ = self._listener.accept()
                if self._stream is None:
                    self._begin(stream)
                else:
                    stream.close()
        if self._stream is None:
            return
        try:
            data = self._stream.recv(MAX_BYTES)
            if not data:
                raise PortError("the robot has closed the connection")
            reports, reply = self._dialect.hear(data)
            self._send(reply)
        except BlockingIOError:
            return
        except (OSError, PortError) as error:
            self._end(str(error))
            return
        if reports:
            self._heard_at_s, self.problem = time.monotonic(), ""
        yield from reports

    def answer(self, report: PortReport, correction: PortCorrection) -> None:
        """Send an answer, or close the stream."""
        if self._stream is None:
            return
        try:
            self._send(self._dialect.answer(report, correction))
        except (OSError, PortError) as error:
            self._end(str(error))

    def close(self) -> None:
        """Leave the network."""
        self._end("")
        if self._listener is not None:
            self._listener.close()

    def _begin(self, stream: socket.socket) -> None:
        stream.setblocking(False)
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._stream, self._dialect, self._heard_at_s = stream, self._make_dialect(), time.monotonic()
        self.connections += 1
        self.problem = "the robot says nothing yet"
        self._send(self._dialect.greeting())

    def _end(self, problem: str) -> None:
        if self._stream is not None:
            self._stream.close()
        self._stream, self.problem = None, problem

    def _send(self, data: bytes) -> None:
        assert self._stream is not None
        if data and self._stream.send(data) < len(data):
            raise PortError("the robot does not take its answers")


def _bind(bound: socket.socket, address: Address) -> None:
    try:
        bound.bind(address)
    except OSError as error:
        bound.close()
        raise PortError(f"cannot listen at {address[0]}:{address[1]} ({error.strerror})") from None
