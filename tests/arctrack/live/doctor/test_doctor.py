"""`arctrack doctor` on this machine: its clock, memory and disk, a real bus, shared frames, a recording."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st
from made import playing_cell
from typer.testing import CliRunner

from arctrack.cli import app
from arctrack.control.cell_file import CellFile, ProcessChoice, read_cell_file
from arctrack.control.cell_file.choices import BusChoice
from arctrack.control.cell_file.new import write_new_cell
from arctrack.live.cameras.shared_frames import SharedFramesWriter
from arctrack.live.doctor.bus import bus_findings, interface_findings, robot_finding
from arctrack.live.doctor.camera import CameraReading, camera_findings
from arctrack.live.doctor.clocks import clock_findings, clock_source_finding, wake_ups
from arctrack.live.doctor.finding import DoctorFinding, FindingState
from arctrack.live.doctor.host import (
    disk_finding,
    governor_finding,
    memory_lock_finding,
    own_memory_lock_finding,
    own_receive_buffer_finding,
    receive_buffer_finding,
    scheduler_findings,
    shared_memory_finding,
)
from robot_io import Link, RobotSync
from tracker.state import Frame


def cell_with(folder: Path, **tables: dict[str, object]) -> CellFile:
    """Return a new cell whose tables have other values."""
    path, _ = write_new_cell(folder, "v_groove", "mild_steel")
    document = tomlkit.parse(path.read_text())
    for name, values in tables.items():
        document[name].update(values)
    path.write_text(tomlkit.dumps(document))
    return read_cell_file(path)


def states(findings: Iterator[DoctorFinding | CameraReading]) -> dict[str, FindingState]:
    return {finding.name: finding.state for finding in findings if isinstance(finding, DoctorFinding)}


def test_this_machines_clock_memory_and_disk_are_told(tmp_path: Path) -> None:
    assert states(clock_findings())["monotonic clock"] is FindingState.OK
    assert shared_memory_finding(0).state is FindingState.OK
    assert shared_memory_finding(2**60).state is FindingState.FAILED
    assert disk_finding(tmp_path / "not" / "there").state in (FindingState.OK, FindingState.WARNING)
    assert re.search(r"a run maps \d{2,} MB", own_memory_lock_finding(0, is_asked=False).text)


@pytest.mark.parametrize(
    ("source", "state"),
    [("tsc", FindingState.OK), ("arch_sys_counter", FindingState.OK), ("hpet", FindingState.WARNING)],
)
def test_a_slow_clock_is_warned_of(source: str, state: FindingState) -> None:
    assert clock_source_finding(source).state is state


@given(st.integers(1, 2**26), st.integers(1, 2**26))
def test_a_receive_buffer_holds_an_image(limit: int, image_bytes: int) -> None:
    said = receive_buffer_finding(limit, image_bytes)
    assert (said.state is FindingState.OK) == (limit >= image_bytes)
    # What the cure sets is enough.
    assert (
        said.state is FindingState.OK
        or receive_buffer_finding(int(said.cure.split("=")[1]), image_bytes).cure == ""
    )


def test_this_machines_receive_buffer_is_told() -> None:
    assert own_receive_buffer_finding(1).state is FindingState.OK
    assert own_receive_buffer_finding(2**40).state is FindingState.WARNING


def test_a_governor_that_saves_power_is_warned_of() -> None:
    assert governor_finding([]).state is FindingState.OK
    assert governor_finding(["performance"]).state is FindingState.OK
    assert governor_finding(["performance", "powersave"]).state is FindingState.WARNING


@given(st.integers(0, 2**40), st.integers(1, 2**40), st.booleans(), st.booleans())
def test_memory_is_locked_where_the_limit_or_the_right_to_exceed_it_allows(
    limit: int, needed: int, may_exceed: bool, is_asked: bool
) -> None:
    said = memory_lock_finding(limit, may_exceed, needed, is_asked)
    assert (said.state is FindingState.OK) == (may_exceed or limit >= needed)
    assert (said.state is FindingState.FAILED) == (is_asked and not may_exceed and limit < needed)
    assert memory_lock_finding(None, False, needed, is_asked).state is FindingState.OK


def test_processors_that_are_not_there_fail_and_scheduling_is_given_back() -> None:
    before = os.sched_getaffinity(0), os.sched_getscheduler(0)
    assert states(scheduler_findings(ProcessChoice(cpus=(4095,))))["[process] cpus"] is FindingState.FAILED
    late = wake_ups(ProcessChoice(priority=1, cpus=(min(before[0]),)), 5)
    assert 0.0 <= late.p50_ms <= late.max_ms
    assert (os.sched_getaffinity(0), os.sched_getscheduler(0)) == before


@pytest.mark.slow
def test_what_was_never_compiled_is_named_and_what_fails_is_the_exit_code(tmp_path: Path) -> None:
    cell = cell_with(tmp_path / "cell", process={"cpus": [4095]}).path
    nothing = str(tmp_path / "empty")
    environment = {**os.environ, "NUMBA_CACHE_DIR": nothing, "ARCTRACK_PACKS": nothing}
    words = [sys.executable, "-c", "import arctrack.cli; arctrack.cli.main()", "doctor", str(cell)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1, done.stderr
    assert re.search(r"^failed   \[process\] cpus: ", done.stdout, re.M)
    assert re.search(r"^warning  job 1: \S+ is not compiled .*; arctrack warm ", done.stdout, re.M)
    assert re.search(r"^warning  latency: not known", done.stdout, re.M)


@contextmanager
def robot_on(options: dict[str, int], channel: str) -> Iterator[None]:
    """Let a robot send its time on a bus that processes share."""
    is_over = threading.Event()

    def talk() -> None:
        with Link("udp_multicast", channel, **options) as link:
            sequence = 0
            while not is_over.wait(0.02):
                link.send(RobotSync(sequence % 200, 0, None))
                sequence += 1

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


@pytest.mark.slow
def test_a_robot_is_heard_on_a_real_bus(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        options = {"port": int(free.getsockname()[1]), "hop_limit": 0}
    channel = "239.74.163.2"
    cell = cell_with(tmp_path / "cell", bus={"interface": "udp_multicast", "channel": channel})
    with robot_on(options, channel):
        said = {finding.name: finding for finding in bus_findings(cell, **options)}
    assert said["bus"].state is FindingState.OK
    assert re.match(r"in 1 s RobotSync \d+", said["robot"].text)
    silent = {finding.name: finding for finding in bus_findings(cell, **options)}
    assert silent["robot"].state is FindingState.WARNING
    assert silent["robot"].text == "heard nothing in 1 s"


@pytest.mark.slow
def test_a_robots_port_is_opened_and_what_its_robot_says_is_told(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as controller:
        channel = f"127.0.0.1:{controller.getsockname()[1]}"
        cell = cell_with(tmp_path / "cell", bus={"interface": "rtde", "channel": channel})

        def refuse() -> None:
            robot, _ = controller.accept()
            with robot:
                assert robot.recv(64) == b"\0\5V\0\2"
                robot.sendall(b"\0\4V\0")

        thread = threading.Thread(target=refuse)
        thread.start()
        findings = [(f.name, f.state, f.text) for f in bus_findings(cell)]
        thread.join()
    assert findings[:2] == [
        ("bus", FindingState.OK, f"rtde:{channel} opens"),
        ("robot", FindingState.WARNING, "heard nothing in 1 s"),
    ]
    assert any("port: the controller refuses version 2" in text for _, _, text in findings[2:])


def test_frames_that_are_no_messages_are_told_from_silence() -> None:
    assert "e2e_error 3" in robot_finding({}, {"e2e_error": 3}).text
    assert robot_finding({"RobotStatus": 1}, {"foreign": 9}).state is FindingState.OK


@pytest.mark.parametrize(
    ("bus", "name", "state"),
    [
        ({"interface": "virtual"}, "bus", FindingState.WARNING),
        ({"interface": "slcan", "channel": "/dev/no-such-port"}, "serial port", FindingState.FAILED),
        ({"interface": "nosuch"}, "bus", FindingState.FAILED),
    ],
)
def test_a_bus_that_reaches_no_robot_is_said(
    tmp_path: Path, bus: dict[str, object], name: str, state: FindingState
) -> None:
    assert states(bus_findings(cell_with(tmp_path / "cell", bus=bus)))[name] is state


@pytest.mark.skipif(shutil.which("ip") is None, reason="iproute2 is not installed")
def test_an_interface_that_is_no_can_controller_is_told_by_ip(tmp_path: Path) -> None:
    cell = cell_with(tmp_path / "a", bus={"interface": "socketcan", "channel": "lo"})
    assert states(bus_findings(cell))["bit rate"] is FindingState.WARNING
    cell = cell_with(tmp_path / "b", bus={"interface": "socketcan", "channel": "can9"})
    assert states(bus_findings(cell))["interface"] is FindingState.FAILED


@pytest.mark.parametrize(
    ("told", "name", "state"),
    [
        ({}, "controller", FindingState.OK),
        ({"state": "ERROR-PASSIVE"}, "controller", FindingState.WARNING),
        ({"state": "BUS-OFF"}, "controller", FindingState.FAILED),
        ({"bittiming": {"bitrate": 250_000}}, "bit rate", FindingState.FAILED),
        ({"restart_ms": 0}, "restart", FindingState.WARNING),
    ],
)
def test_what_ip_tells_of_a_controller_is_judged(
    told: dict[str, object], name: str, state: FindingState
) -> None:
    sound = {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 500_000}}
    link = {"flags": ["NOARP", "UP"], "linkinfo": {"info_kind": "can", "info_data": {**sound, **told}}}
    said = states(iter(interface_findings(link, BusChoice("socketcan", "can0", 500_000))))
    assert said.pop(name) is state
    assert set(said.values()) == {FindingState.OK}


@pytest.mark.slow
def test_shared_frames_are_watched(tmp_path: Path) -> None:
    name = f"doctor-{os.getpid()}"
    cell = cell_with(tmp_path / "cell", camera={"kind": "shared_memory", "name": name, "frame_rate_hz": 50.0})
    assert states(camera_findings(cell)) == {"camera": FindingState.FAILED}
    camera = cell.setup.setup.camera
    image = np.zeros((camera.height, camera.width), np.uint8)
    is_over = threading.Event()
    with SharedFramesWriter(name, camera.height, camera.width) as writer:

        def publish() -> None:
            index = 0
            while not is_over.wait(0.1):
                writer.publish(Frame(index, 0.0, image, 0.005, 100.0))
                index += 1

        thread = threading.Thread(target=publish)
        thread.start()
        said = list(camera_findings(cell))
        is_over.set()
        thread.join()
    (watched,) = (seen for seen in said if isinstance(seen, CameraReading))
    assert 3 <= watched.frames <= 11
    assert watched.unreadable == 0
    # Ten a second come where fifty are stated.
    assert states(iter(said))["frames"] is FindingState.WARNING


@pytest.mark.slow
def test_a_cell_is_examined_whole(simulated: Path, tmp_path: Path) -> None:
    cell = playing_cell(tmp_path / "cell", simulated)
    assert CliRunner().invoke(app, ["warm", str(cell)]).exit_code == 0
    done = CliRunner().invoke(app, ["doctor", str(cell)])
    assert done.exit_code == 0, done.output
    for line in (
        r"^ok       job 1: first job: all that a step may need is compiled$",
        r"^ok       job 1: a step takes p50 .*; a search p50 ",
        r"^ok       job 1: 100 % of frames drawn of the setup itself are tracked$",
        r"^ok       camera: recording ",
        r"^warning  bus: virtual:.* goes to nobody",
        r"^\w+ +latency: [\d.]+ ms, [\d.]+ ms at most; \[gate\] capture_age_s lets out 200 ms",
        r"^ +step of the tracker +[\d.]+ +[\d.]+ ",
        r"^ok \d+, warning \d+, failed 0$",
    ):
        assert re.search(line, done.stdout, re.M), (line, done.stdout)
