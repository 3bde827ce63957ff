"""A vendor's robot as a process on a real socket: `peer.py INTERFACE PORT`.

Lines on stdin are what it does next: track, disarm, silent, speak, garbage, reconnect. It prints "usable" and
"unusable" when what it is told changes, and "answered N" after each hundred answers.
"""

from __future__ import annotations

import os
import select
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from vendor_robots import ROBOTS, Said, UrRobot

GONE_S = 0.15
"""An answer that counts counts so long."""


class Peer:
    def __init__(self, interface: str, port: int) -> None:
        self.interface, self.address = interface, ("127.0.0.1", port)
        self.listener = socket.create_server(self.address) if interface == "rtde" else None
        self.connect()

    def connect(self) -> None:
        """Connect where someone listens; the robot goes on without."""
        self.robot, self.stream = ROBOTS[self.interface](), None
        if self.interface in ("egm", "rsi"):
            self.stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.stream.connect(self.address)
        elif self.listener is None:
            with suppress(ConnectionRefusedError):
                self.stream = socket.create_connection(self.address)
                self.stream.sendall(self.robot.hello)
        elif select.select([self.listener], [], [], 0.0)[0]:
            self.stream, _ = self.listener.accept()

    def send(self, data: bytes) -> None:
        if self.stream is not None:
            with suppress(ConnectionError):
                self.stream.sendall(data)

    def answers(self):
        if self.stream is None:
            self.connect()
        if self.stream is None or not select.select([self.stream], [], [], 0.0)[0]:
            return []
        try:
            data = self.stream.recv(65536)
        except ConnectionError:
            data = b""
        if not data:
            if self.interface not in ("egm", "rsi"):
                self.stream.close()
                self.connect()
            return []
        if isinstance(self.robot, UrRobot):
            reply, answers = self.robot.hear(data)
            self.send(reply)
            return answers
        return self.robot.read(data)

    @property
    def speaks(self) -> bool:
        return not isinstance(self.robot, UrRobot) or self.robot.started


def main(interface: str, port: int) -> None:
    peer, said, state = Peer(interface, port), Said(), "speak"
    was_usable, usable_s, n_answers = False, 0.0, 0
    while True:
        if select.select([0], [], [], peer.robot.cycle_s)[0]:
            # A select of the stream of lines would not see what Python has read of it already.
            for word in os.read(0, 4096).decode().split():
                if word in ("track", "disarm"):
                    said.command = 4 if word == "track" else 0
                elif word == "reconnect":
                    if peer.stream is not None:
                        peer.stream.close()
                    peer.connect()
                else:
                    state = word
        now_s = time.monotonic()
        said.time_s = round(now_s, 3)
        if peer.speaks and state != "silent":
            peer.send(peer.robot.report(said) if state == "speak" else os.urandom(200))
        for *_, counts in peer.answers():
            n_answers += 1
            usable_s = now_s if counts else usable_s if interface == "egm" else 0.0
            if n_answers % 100 == 0:
                print("answered", n_answers, flush=True)
        is_usable = now_s - usable_s < GONE_S
        if is_usable != was_usable:
            was_usable = is_usable
            print("usable" if is_usable else "unusable", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
