"""A port: a robot's line on one side, frames to and from the tracker on the other."""

import select
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import can

from robot_io.ports.egm.dialect import EgmDialect
from robot_io.ports.lines import Address, DatagramLine, Line, StreamLine
from robot_io.ports.report import PortError
from robot_io.ports.rsi.dialect import RsiDialect
from robot_io.ports.rtde.dialect import RtdeDialect
from robot_io.ports.session import CanFrame, RobotSession
from robot_io.ports.tcp_json.dialect import JsonDialect


class TrackerEnd(Protocol):
    """Pipe to the tracker: frames with the wall-clock time of their sending, s."""

    def fileno(self) -> int:
        """Return the descriptor to wait for."""

    def poll(self) -> bool:
        """Return True if a frame is there."""

    def recv(self) -> tuple[int, bytes, float]:
        """Return the next frame."""

    def send(self, message: object) -> None:
        """Send a frame; OSError where there is no room for it."""


@dataclass(frozen=True)
class PortKind:
    """A protocol: how its line is opened, and the network port that its vendor has for it."""

    open_line: Callable[[Address, int | None], Line]
    network_port: int


PORTS = {
    "tcp_json": PortKind(lambda address, _: StreamLine(address, JsonDialect), 7310),
    "egm": PortKind(lambda address, word: DatagramLine(address, lambda: EgmDialect(word)), 6511),
    "rsi": PortKind(lambda address, _: DatagramLine(address, RsiDialect), 49_152),
    "rtde": PortKind(lambda address, _: StreamLine(address, RtdeDialect, connects=True), 30_004),
}
"""Protocols by the name that `[bus] interface` gives them."""


def address_of(interface: str, channel: str) -> Address:
    """Return host and port of a channel, HOST or HOST:PORT; PortError where it is neither."""
    host, colon, number = channel.partition(":")
    port = number if colon else str(PORTS[interface].network_port)
    if not host or not (port.isascii() and port.isdigit() and int(port) <= 65_535):
        example = f"0.0.0.0:{PORTS[interface].network_port}"
        raise PortError(f"channel = {channel!r}: must be HOST or HOST:PORT, such as {example}")
    return host, int(port)


class RobotPort:
    """A port at work: `turn` moves what has come, `close` leaves the network."""

    def __init__(self, line: Line, tracker: TrackerEnd) -> None:
        self.line = line
        self._tracker, self._session = tracker, RobotSession()
        self._connections = 0

    def turn(self, others: tuple[Any, ...] = (), wait_s: float = 0.1) -> list[Any]:
        """Wait for the robot, the tracker or `others`, take what came, and return which of `others` it is."""
        waits = [*self.line.waits(), self._tracker, *others]
        ready, _, _ = select.select(waits, [], [], wait_s)
        while self._tracker.poll():
            arbitration_id, data, sent_at_s = self._tracker.recv()
            frame = can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False)
            self._session.hear(frame, time.monotonic(), max(0.0, time.time() - sent_at_s))
        for report in self.line.reports():
            now_s = time.monotonic()
            if self.line.connections != self._connections:
                self._connections = self.line.connections
                self._session.begin()
            frames = self._session.take(report, now_s)
            if frames is None:
                continue
            correction = self._session.correction(report, now_s)
            # The answer first: a robot may wait for it.
            if correction is not None:
                self.line.answer(report, correction)
            for frame_sent in frames:
                self._send(frame_sent)
        return [each for each in others if each in ready]

    def close(self) -> None:
        """Leave the network."""
        self.line.close()

    def _send(self, frame: CanFrame) -> None:
        try:
            self._tracker.send((*frame, time.time()))
        except OSError:
            # The tracker does not read: what is lost now it will miss by its own time-outs.
            return
