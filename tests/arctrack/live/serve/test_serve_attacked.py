"""A live run whose other processes are killed, whose terminal is closed, whose output nobody reads."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import textwrap
import time
import urllib.error
import urllib.request
from pathlib import Path

import can
import pytest
from made import playing_cell, replace_in
from test_serve_live import PLAN, Ear

from arctrack.live.serve.simulated import GROUP, INTERFACE, SimulatedCell, write_simulated_cell
from arctrack.recording import read_recording
from robot_io import Validity

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("compiled"),
    pytest.mark.skipif(sys.platform == "win32", reason="POSIX terminals"),
]

SERVE = """
    import sys
    from arctrack.control.cell_file import read_cell_file
    from arctrack.cli.serve import serve_cell_file
    serve_cell_file(read_cell_file(sys.argv[1]), port=int(sys.argv[2]), hop_limit=0)
"""


class InTerminal:
    """A process with a terminal of its own, as a login has it."""

    def __init__(self, script: str, *words: str) -> None:
        self._screen, terminal = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(script), *words],
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            start_new_session=True,
            preexec_fn=self._log_in,
        )
        os.close(terminal)
        os.set_blocking(self._screen, False)
        self._shown = b""

    @staticmethod
    def _log_in() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
        # The tests may run under nohup.
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

    @property
    def shown(self) -> str:
        """What it has printed so far."""
        try:
            while piece := os.read(self._screen, 65536):
                self._shown += piece
        except OSError:
            pass
        return " ".join(self._shown.decode().split())

    def close(self) -> None:
        """Close the terminal, as the end of an ssh connection does."""
        os.close(self._screen)


def told_by(page: str, name: str) -> str:
    """Return what a page says; nothing while it is not there."""
    try:
        with urllib.request.urlopen(page + name, timeout=5.0) as answer:
            return str(answer.read().decode())
    except (OSError, urllib.error.URLError):
        return ""


def processes_of(page: str) -> dict:
    return json.loads(told_by(page, "status.json") or "{}").get("processes", {})


def is_there(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for(is_so, what: str) -> None:
    until_s = time.monotonic() + 120.0
    while not is_so():
        assert time.monotonic() < until_s, what
        time.sleep(0.05)


def test_killed_neighbours_are_started_again_and_a_closed_terminal_ends_the_run(multicast, tmp_path: Path):
    name = f"attacked-{os.getpid()}"
    cell = write_simulated_cell(tmp_path / "cell", PLAN, INTERFACE, GROUP, name)
    replace_in(cell, "# port = 8765", "port = 0")
    boxes = cell.parent / "black_box"
    run = None
    try:
        with (
            SimulatedCell(PLAN, name) as robot,
            can.Bus(**(multicast | robot.bus_options), ignore_config=True) as bus,
        ):
            ear = Ear(bus)
            run = InTerminal(SERVE, str(cell), str(robot.bus_options["port"]))
            # A terminal that nobody reads holds the bar, and with it what comes before the loop.
            ear.listen(lambda: bool(run.shown) and ear.is_usable())
            page = next(word for word in run.shown.split() if word.startswith("http://"))
            ear.listen(lambda: set(processes_of(page)) == {"lag", "find", "watch", "black box", "page"})
            for victim in ("lag", "find", "watch", "black box", "page"):
                before = len(ear.offsets())
                os.kill(processes_of(page)[victim]["pid"], signal.SIGKILL)
                ear.listen(lambda victim=victim: f"{victim}: runs again" in run.shown)
                assert f"{victim}: its process ended, signal SIGKILL; it is started again" in run.shown
                ear.listen(lambda victim=victim: processes_of(page).get(victim, {}).get("running"))
                assert processes_of(page)[victim]["ended"] == 1
                assert f'arctrack_process_ends_total{{process="{victim}"}} 1.0' in told_by(page, "metrics")
                ear.listen(lambda n=before: Validity.VALID in [sent.validity for sent in ear.offsets()[n:]])
            run.process.send_signal(signal.SIGUSR1)
            ear.listen(lambda: any(boxes.glob("*_asked_by_SIGUSR1/recording.toml")))
            pids = [process["pid"] for process in processes_of(page).values()]

            run.close()
            ear.listen(lambda: run.process.poll() is not None)
            heard = len(ear.messages)
            ear.listen(lambda: len(ear.messages) > heard + 5)
        assert run.process.returncode == 0
        assert ear.offsets()[-1].validity is Validity.REFUSED
        (saved,) = boxes.glob("*_terminal_closed")
        assert read_recording(saved).rows
        assert not any(map(is_there, pids))
    finally:
        if run is not None:
            run.process.kill()
            run.process.wait()


def test_a_run_goes_on_where_nobody_reads_what_it_prints(simulated: Path, tmp_path: Path) -> None:
    cell = playing_cell(tmp_path / "cell", simulated)
    script = "import sys; from arctrack.cli import main; main()"
    command = [sys.executable, "-c", script, "serve", str(cell)]
    reading, writing = os.pipe()
    os.close(reading)
    with subprocess.Popen(command, stdout=writing, stderr=subprocess.PIPE, text=True) as run:
        os.close(writing)
        _, said = run.communicate()
    assert run.returncode == 0, said
    assert "Traceback" not in said
