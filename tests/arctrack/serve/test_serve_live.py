"""The closed loop as processes on a real bus: a simulated cell, and the tracker that serves it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import can
import pytest

from arctrack.cameras.shared_frames import SharedFramesReader
from arctrack.cell.weld.closed_loop import LoopPlan
from arctrack.serve.simulated import write_simulated_cell
from robot_io import (
    ANY_SOURCE,
    Command,
    GateLimits,
    Inbox,
    OffsetUse,
    SeamOffset,
    TrackerCommand,
    Validity,
)

PLAN = LoopPlan(joint="lap", length_mm=1000.0, rate_hz=10.0, size_px=(160, 120))

CELL = """
    import sys
    from arctrack.cell.live.serve import serve_cell
    from arctrack.cell.weld.closed_loop import LoopPlan
    plan = LoopPlan(joint="lap", length_mm=1000.0, rate_hz=10.0, size_px=(160, 120))
    serve_cell(
        plan, "udp_multicast", "239.74.163.2", sys.argv[1], lambda robot: robot.now_s < 120.0,
        lambda: print("ready", flush=True), port=int(sys.argv[2]), hop_limit=0,
    )
"""
TRACKER = """
    import sys
    from arctrack.cell_file import read_cell_file
    from arctrack.cli.serve import serve_cell_file
    serve_cell_file(read_cell_file(sys.argv[1]), port=int(sys.argv[2]), hop_limit=0)
"""


class Ear:
    """What a robot hears on the bus."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus, self.inbox, self.use = bus, Inbox(ANY_SOURCE), OffsetUse()
        self.messages: list = []

    def listen(self, is_so, seconds: float = 60.0) -> None:
        """Listen until something is so."""
        until_s = time.monotonic() + seconds
        while not is_so():
            assert time.monotonic() < until_s, self.messages[-20:]
            frame = self.bus.recv(0.05)
            received = None if frame is None else self.inbox.receive(frame)
            if received is not None:
                self.messages.append(received.message)
                self.use.on_message(received, time.monotonic())

    def is_usable(self) -> bool:
        return self.use.offset(time.monotonic()) is not None

    def offsets(self) -> list[SeamOffset]:
        return [message for message in self.messages if isinstance(message, SeamOffset)]


def started(script: str, *words: str) -> subprocess.Popen:
    command = [sys.executable, "-c", textwrap.dedent(script), *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_a_robot_follows_offsets_of_another_process_until_that_ends_or_is_killed(multicast, tmp_path: Path):
    name, port = f"serve-{os.getpid()}", str(multicast["port"])
    cell = write_simulated_cell(tmp_path / "cell", PLAN, "udp_multicast", "239.74.163.2", name)
    processes = [started(CELL, name, port)]
    try:
        assert processes[0].stdout.readline() == "ready\n"
        with can.Bus(**multicast, ignore_config=True) as bus, SharedFramesReader(name) as camera:
            ear = Ear(bus)
            processes.append(started(TRACKER, str(cell), port))
            ear.listen(lambda: sum(o.validity is Validity.VALID for o in ear.offsets()) >= 20)
            assert ear.is_usable()
            armed = next(
                n
                for n, message in enumerate(ear.messages)
                if isinstance(message, TrackerCommand) and message.command is Command.TRACK
            )
            before = [m.validity for m in ear.messages[:armed] if isinstance(m, SeamOffset)]
            assert set(before) == {Validity.REFUSED}
            limits = GateLimits()
            valid = [offset for offset in ear.offsets() if offset.validity is Validity.VALID]
            assert max(abs(offset.offset_y_mm) for offset in valid) <= limits.range_y_mm
            assert max(abs(offset.offset_z_mm) for offset in valid) <= limits.range_z_mm
            assert valid[-1].offset_y_mm == pytest.approx(PLAN.displaced_mm, abs=0.3)

            processes[1].send_signal(signal.SIGTERM)
            ear.listen(lambda: processes[1].poll() is not None)
            assert processes[1].returncode == 0
            ready, said = processes[1].stdout.read().splitlines()[:2]
            assert ready.startswith(f"ready: shared_memory {name}, bus udp_multicast:239.74.163.2")
            assert said.startswith("frames: ")
            # What the robot says next came after all of that.
            heard = len(ear.messages)
            ear.listen(lambda: sum(isinstance(m, TrackerCommand) for m in ear.messages[heard:]) >= 2)
            assert ear.offsets()[-1].validity is Validity.REFUSED
            assert not ear.is_usable()

            processes.append(started(TRACKER, str(cell), port))
            ear.listen(ear.is_usable)
            processes[2].kill()
            ear.listen(lambda: not ear.is_usable())
            # Nobody keeps the laser on.
            dark = []
            ear.listen(lambda: dark or _is_dark(camera, dark))
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def _is_dark(camera: SharedFramesReader, dark: list) -> bool:
    frame = camera.newest()
    if frame is not None and not frame.laser_on:
        dark.append(frame)
    return bool(dark)
