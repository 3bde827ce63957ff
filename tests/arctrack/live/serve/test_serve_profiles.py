"""A robot follows a laser profiler's stream over TCP; it fails closed where the stream stalls or breaks."""

from __future__ import annotations

import os
import signal
import socket
import statistics
import subprocess
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest
import tomlkit
from test_serve_live import PLAN, TRACKER, Ear, _allow_delays, _check_replays, started

from arctrack.live.cameras.profile_message import pack_profile
from arctrack.live.cameras.shared_frames import SharedFramesReader
from arctrack.live.serve.simulated import GROUP, INTERFACE, SimulatedCell, write_simulated_cell
from arctrack.recording import read_setup_file
from noise_model.instrument.profiler import Profiler
from robot_io import SeamOffset

ENDS_S, SILENT_S = 2.0, 4.0
"""Time after which a stalled stream's last profile is too old, twice the gate's limit, and of the stall."""

SURE = 0.99
"""Confidence of an offset: the probability that it errs by less than the setup's tolerance of the seam."""


def sure(ear: Ear) -> list[SeamOffset]:
    """Return the valid offsets that the tracker is sure of."""
    return [offset for offset in ear.valid() if offset.confidence >= SURE]


class Sender:
    """A sensor's program: the simulated camera's profiles over TCP, until they are held or cut."""

    def __init__(self, name: str, profiler: Profiler) -> None:
        self._profiler, self._frames = profiler, SharedFramesReader(name)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._server.getsockname()[1]}"
        self.is_held = self.is_over = False
        self.connections = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.is_over = True
        self._server.close()
        self._thread.join(10.0)
        self._frames.close()

    def _run(self) -> None:
        self._server.settimeout(0.2)
        while not self.is_over:
            with suppress(OSError):
                connection, _ = self._server.accept()
                self.connections += 1
                with connection:
                    self._send(connection)

    def _send(self, connection: socket.socket) -> None:
        while not self.is_over:
            frame = None if self.is_held else self._frames.newest()
            if frame is None:
                time.sleep(0.002)
                connection.setblocking(False)
                with suppress(BlockingIOError):
                    if connection.recv(1) == b"":
                        return
                connection.setblocking(True)
                continue
            z_mm = self._profiler.z_mm(frame.image_dn[0])
            time_ns = round(1e9 * frame.timestamp_s)
            connection.sendall(pack_profile(frame.index, time_ns, z_mm, frame.image_dn[1]))


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
def test_a_robot_follows_profiles_over_tcp_and_gets_nothing_of_a_stalled_stream(
    multicast: dict[str, Any], tmp_path: Path
) -> None:
    mcap_reader = pytest.importorskip("mcap.reader")
    plan = replace(PLAN, joint="v_groove", profiles=True)
    name = f"profiles-{os.getpid()}"
    cell = write_simulated_cell(tmp_path / "cell", plan, INTERFACE, GROUP, name)
    _allow_delays(cell)
    setup = read_setup_file(cell.with_name("setup.toml")).setup
    profiler = setup.profiler
    assert profiler is not None
    with (
        SimulatedCell(plan, name) as robot,
        can.Bus(**(multicast | robot.bus_options), ignore_config=True) as bus,
    ):
        sender = Sender(name, profiler)
        document = tomlkit.parse(cell.read_text())
        document["camera"].update({"kind": "profile_tcp", "name": sender.address})
        document["mcap"]["folder"] = "runs"
        cell.write_text(tomlkit.dumps(document))
        ear = Ear(bus)
        process: subprocess.Popen = started(TRACKER, str(cell), str(robot.bus_options["port"]))
        try:
            ear.listen(lambda: len(ear.valid()) >= 20)
            ear.listen(ear.is_usable)
            # A busy machine drops profiles, so that the fit settles later, as its confidence says. It delays
            # poses, too: of a robot that weaves a single offset is then off by more than its sigma.
            ear.listen(lambda: len(sure(ear)) >= 20)
            displaced_mm = statistics.median(offset.offset_y_mm for offset in sure(ear)[-20:])
            assert displaced_mm == pytest.approx(plan.displaced_mm, abs=setup.tolerance.seam_mm)

            sender.is_held, held_s = True, time.monotonic()
            ear.listen(lambda: time.monotonic() > held_s + ENDS_S)
            before = len(ear.valid())
            ear.listen(lambda: time.monotonic() > held_s + SILENT_S)
            assert len(ear.valid()) == before
            assert not ear.is_usable()
            # It was looked at, began, and was connected to anew.
            connections = sender.connections
            ear.listen(lambda: sender.connections > connections)
            sender.is_held = False
            ear.listen(lambda: len(ear.valid()) >= before + 20)
            ear.listen(ear.is_usable)

            process.send_signal(signal.SIGUSR1)
            boxes = cell.parent / "black_box"
            ear.listen(lambda: any(boxes.glob("*_asked_by_SIGUSR1")))
            process.send_signal(signal.SIGTERM)
            ear.listen(lambda: process.poll() is not None)
            assert process.returncode == 0
            assert process.stdout is not None
            assert process.stdout.read().splitlines()[-1] == "after ready: loaded [], compiled 0"
        finally:
            process.kill()
            process.communicate()
            sender.close()
        samples = robot.stop()
    # It began 3 mm beside the seam, and was taken there.
    assert min(off_mm for _, off_mm in samples) < 0.1
    (saved,) = boxes.glob("*_asked_by_SIGUSR1")
    _check_replays(saved)
    (run,) = (cell.parent / "runs").glob("*.mcap")
    with run.open("rb") as file:
        topics = {channel.topic for _, channel, _ in mcap_reader.make_reader(file).iter_messages()}
    assert {"/profile", "/camera/image"} <= topics
