"""What a service manager is told, over a real datagram socket."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import closing
from types import SimpleNamespace

import pytest
from made import playing_cell

from arctrack.live.serve import notify
from arctrack.live.serve.notify import Notifier


@pytest.fixture(params=["file", "abstract"])
def manager(request, tmp_path):
    path = f"{tmp_path}/notify" if request.param == "file" else f"@arctrack-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(path if request.param == "file" else "\0" + path[1:])
        listening.settimeout(5.0)
        yield path, listening


def test_systemd_hears_ready_watchdog_and_stopping(manager, monkeypatch) -> None:
    path, listening = manager
    monkeypatch.setattr(notify, "time", SimpleNamespace(monotonic=iter([7.0, 7.019, 7.021]).__next__))
    stated = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "40000", "WATCHDOG_PID": str(os.getpid())}
    with closing(Notifier(stated)) as notifier:
        notifier.ready("ready: a camera")
        assert listening.recv(100) == b"READY=1\nSTATUS=ready: a camera"
        notifier.goes_on()
        notifier.goes_on()
        assert listening.recv(100) == b"WATCHDOG=1"
        notifier.goes_on()
        notifier.stopping()
    assert [listening.recv(100), listening.recv(100)] == [b"WATCHDOG=1", b"STOPPING=1"]


def test_another_process_watchdog_is_not_fed(manager) -> None:
    path, listening = manager
    with closing(Notifier({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"})) as notifier:
        notifier.goes_on()
        notifier.stopping()
    assert listening.recv(100) == b"STOPPING=1"


def test_nothing_is_sent_where_nobody_listens(tmp_path) -> None:
    for environment in ({}, {"NOTIFY_SOCKET": str(tmp_path / "gone")}):
        with closing(Notifier(environment)) as notifier:
            notifier.ready("ready")
            notifier.goes_on()
            notifier.stopping()


@pytest.mark.slow
@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("manager", ["abstract"], indirect=True)
def test_a_live_run_tells_that_it_is_ready_goes_on_and_ends(manager, simulated, tmp_path) -> None:
    path, listening = manager
    cell = playing_cell(tmp_path / "cell", simulated)
    environment = {**os.environ, "NOTIFY_SOCKET": path, "WATCHDOG_USEC": "200000"}
    environment.pop("WATCHDOG_PID", None)
    words = [sys.executable, "-c", "import arctrack.cli; arctrack.cli.main()", "serve", str(cell)]
    listening.settimeout(600.0)
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, env=environment) as run:
        told = [listening.recv(1000).decode()]
        while told[-1] != "STOPPING=1":
            told.append(listening.recv(1000).decode())
    assert run.returncode == 0
    ready, *fed, _ = told
    assert ready.startswith(f"READY=1\nSTATUS=ready: recording {simulated}")
    assert set(fed) == {"WATCHDOG=1"}
