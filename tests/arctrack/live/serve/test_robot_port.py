"""Ports as processes: a robot of each make in another process, over a real socket."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from arctrack.control.cell_file import BusChoice, ProcessChoice
from arctrack.control.controller import Controller
from arctrack.control.job import Job
from arctrack.control.robot_messages import TRUSTED
from arctrack.errors import ArctrackError
from arctrack.live.serve.robot_port import port_process
from arctrack.live.serve.supervisor import SupervisedProcess, Supervisor
from robot_io import BusMessage, Link, RobotPosePosition, TrackerCommand
from robot_io.ports.session import SILENT_S
from tracker.state import Track

PEER = Path(__file__).parents[3] / "robot_io" / "ports" / "peer.py"


def free_port(interface: str) -> int:
    kind = socket.SOCK_DGRAM if interface in ("egm", "rsi") else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Tracker:
    """A tracker behind a port: the real controller, a track at each frame, no camera."""

    def __init__(self, link: Link) -> None:
        self.link, self.controller = link, Controller({1: Job("lap")})
        self.messages: list[BusMessage] = []
        self.tracked_s = 0.0

    def step(self) -> None:
        said: list[BusMessage] = []
        for received in self.link.receive(0.005):
            self.messages.append(received.message)
            said += self.controller.on_message(received, time.monotonic())
            if len(self.messages) % 20 == 0:
                break
        now_s = time.monotonic()
        if now_s - self.tracked_s >= 0.02:
            self.tracked_s = now_s
            track = Track(
                0,
                now_s - 0.01,
                0,
                offset_y_mm=0.5,
                offset_z_mm=-0.2,
                offset_sigma_y_mm=0.02,
                offset_sigma_z_mm=0.02,
                offset_confidence=0.9,
            )
            said += self.controller.on_track(track, now_s)
        for message in (*said, *self.controller.poll(now_s)):
            self.link.send(message)


class VendorPeer:
    """The robot's process."""

    def __init__(self, interface: str, port: int) -> None:
        self.process = subprocess.Popen(
            [sys.executable, PEER, interface, str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self.lines: list[str] = []

    def do(self, word: str) -> None:
        self.process.stdin.write(f"{word}\n".encode())
        self.process.stdin.flush()

    def hear(self) -> None:
        while select.select([self.process.stdout], [], [], 0.0)[0]:
            data = os.read(self.process.stdout.fileno(), 4096)
            if not data:
                return
            self.lines += data.decode().splitlines()

    @property
    def is_usable(self) -> bool:
        return next((line == "usable" for line in reversed(self.lines) if line.endswith("usable")), False)

    @property
    def n_answered(self) -> int:
        return sum(line.startswith("answered") for line in self.lines)

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


def until(is_so, *steps) -> None:
    until_s = time.monotonic() + 60.0
    while not is_so():
        assert time.monotonic() < until_s
        for step in steps:
            step()
        time.sleep(0.001)


class Cell:
    """A port, a tracker behind it, and the robots that came to it."""

    def __init__(self, interface: str, link: Link, number: int) -> None:
        self.interface, self.number, self.tracker = interface, number, Tracker(link)
        self.begin_robot()

    def begin_robot(self) -> None:
        self.peer = VendorPeer(self.interface, self.number)

    def until(self, is_so) -> None:
        until(is_so, self.tracker.step, self.peer.hear)

    def lead(self) -> None:
        """Armed, the robot is led."""
        self.peer.do("disarm")
        heard = len(self.tracker.messages)
        self.until(lambda: sum(isinstance(m, TrackerCommand) for m in self.tracker.messages[heard:]) > 2)
        self.peer.do("track")
        self.until(lambda: self.peer.is_usable)

    def check_needs_arming(self) -> None:
        """Nothing counts while the tracker hears the robot again, until it is armed."""
        heard = len(self.tracker.messages)
        self.until(lambda: sum(isinstance(m, RobotPosePosition) for m in self.tracker.messages[heard:]) > 60)
        assert not self.peer.is_usable
        self.lead()


@contextmanager
def running_port(interface: str, said: list[str]) -> Iterator[tuple[SupervisedProcess, Cell]]:
    number = free_port(interface)
    bus, supervisor = BusChoice(interface, f"127.0.0.1:{number}", 500_000), Supervisor(said.append)
    process, open_bus = port_process(bus, ProcessChoice())
    with supervisor.running(process):
        process.wait_ready()
        link = Link(interface, bus.channel, trusted=TRUSTED, open_bus=open_bus)
        with supervisor.watching(), link:
            cell = Cell(interface, link, number)
            try:
                yield process, cell
            finally:
                cell.peer.kill()


@pytest.mark.slow
@pytest.mark.parametrize("interface", ["tcp_json", "egm", "rsi", "rtde"])
def test_a_robot_in_another_process_is_led_and_left_alone_after_each_fault(interface: str) -> None:
    with running_port(interface, []) as (_, cell):
        cell.lead()
        # A tracker that stops ends what counts; RSI and the streams are answered all the same.
        until(lambda: not cell.peer.is_usable, cell.peer.hear)
        answered = cell.peer.n_answered
        if interface != "egm":
            until(lambda: cell.peer.n_answered > answered, cell.peer.hear)
        cell.until(lambda: cell.peer.is_usable)

        # Killed in the midst of a weld, and another one begins at once with TRACK.
        cell.peer.kill()
        cell.begin_robot()
        cell.peer.do("track")
        cell.check_needs_arming()

        cell.peer.do("garbage")
        begun_s = time.monotonic()
        cell.until(lambda: time.monotonic() > begun_s + SILENT_S + 0.1 and not cell.peer.is_usable)
        cell.peer.do("speak")
        cell.check_needs_arming()

        if interface == "tcp_json":
            # A robot that was switched off never closes its stream: the next one gets its place.
            silent = cell.peer
            silent.do("silent")
            cell.begin_robot()
            cell.peer.do("track")
            cell.check_needs_arming()
            silent.kill()

        cell.peer.do("reconnect")
        cell.until(lambda: not cell.peer.is_usable)
        cell.check_needs_arming()


@pytest.mark.slow
def test_a_port_that_is_killed_begins_again_and_knows_nothing_of_its_robot() -> None:
    said: list[str] = []
    with running_port("tcp_json", said) as (process, cell):
        cell.lead()
        os.kill(process.state.pid, signal.SIGKILL)
        cell.until(lambda: not cell.peer.is_usable)
        cell.check_needs_arming()
    assert "port: its process ended, signal SIGKILL; it is started again" in said


def test_a_port_that_is_taken_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        bus = BusChoice("tcp_json", f"127.0.0.1:{taken.getsockname()[1]}", 500_000)
        process, _ = port_process(bus, ProcessChoice())
        with pytest.raises(
            ArctrackError, match=r"\[bus\] channel: cannot listen at 127\.0\.0\.1:\d+ \(Address"
        ):
            process.wait_ready()
        process.end()
