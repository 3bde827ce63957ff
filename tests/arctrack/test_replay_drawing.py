"""A replay's pictures drawn by processes of their own: the same bytes, and nothing lost however they end."""

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import av
import pytest
from made import results_of, without_progress
from typer.testing import CliRunner

from arctrack.child_process import WorkerProcess
from arctrack.cli import app
from arctrack.recording import read_recording
from arctrack.recording.results import (
    BUS_LOG,
    FINISHED_JSON,
    OVERLAY_VIDEO,
    OVERVIEW_PICTURE,
    REPLAY_MCAP,
    REPLAY_PAGE,
    SUMMARY_JSON,
)
from arctrack.replay.pages import drawing
from arctrack.replay.pages.drawing import process_count
from arctrack.replay.pages.view import Drawn, ToDraw
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.workers import cores_each

RUNNER = CliRunner(env={"COLUMNS": "120", "TERM": "dumb", "NO_COLOR": "1"})


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[WorkerProcess[ToDraw, Drawn]]:
    """Let a process be worth a frame, and return those that were started."""
    processes: list[WorkerProcess[ToDraw, Drawn]] = []

    def start(*arguments: object) -> WorkerProcess[ToDraw, Drawn]:
        processes.append(WorkerProcess(*arguments))
        return processes[-1]

    monkeypatch.setattr(drawing, "FRAMES_WORTH_A_PROCESS", 1)
    monkeypatch.setattr(drawing, "WorkerProcess", start)
    return processes


def pictures_in(video: Path) -> int:
    with av.open(str(video)) as opened:
        return sum(1 for _ in opened.decode(video=0))


@pytest.mark.parametrize(
    ("cores", "frames", "count"),
    [
        *((1, 10_000, 0), (2, 10_000, 1), (3, 10_000, 2), (64, 10_000, 3)),
        *((64, 17, 0), (64, 169, 0), (64, 170, 1), (64, 340, 2)),
    ],
)
def test_a_process_takes_a_core_and_frames_that_are_worth_it(cores: int, frames: int, count: int) -> None:
    assert process_count(cores, frames) == count


def test_recordings_at_once_share_the_cores() -> None:
    alone = cores_each(1, None)
    assert alone >= 1
    assert cores_each(alone, None) == cores_each(10 * alone, None) == 1
    assert cores_each(1, "tcp://127.0.0.1:1") == 1
    for workers in range(1, alone + 1):
        assert workers * cores_each(workers, None) <= alone


@pytest.mark.slow
def test_processes_draw_what_one_draws_byte_for_byte(
    flawed_recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    started: list[WorkerProcess[ToDraw, Drawn]],
) -> None:
    # The page shows how long each step took.
    monkeypatch.setattr("arctrack.control.frame_tracking.time", SimpleNamespace(perf_counter_ns=lambda: 0))
    monkeypatch.setattr(
        "arctrack.replay.replay.time", SimpleNamespace(monotonic=iter(range(10_000)).__next__)
    )
    has_mcap = importlib.util.find_spec("mcap") is not None
    options = ReplayOptions(exports=(REPLAY_MCAP,) if has_mcap else ())
    drawn: dict[int, list[int]] = {1: [], 4: []}
    for cores, heard in drawn.items():
        recording = read_recording(flawed_recording)
        replay_recording(recording, tmp_path / f"{cores}", options, on_drawn=heard.append, cores=cores)
    assert len(started) == 3
    assert drawn[1] == drawn[4] == list(range(1, 15))
    for name in (OVERLAY_VIDEO, OVERVIEW_PICTURE, REPLAY_PAGE, *options.exports):
        alone, three = ((tmp_path / f"{cores}" / name).read_bytes() for cores in drawn)
        assert alone == three, name


def test_no_process_is_started_where_nothing_is_drawn(
    simulated: Path, tmp_path: Path, started: list[WorkerProcess[ToDraw, Drawn]]
) -> None:
    replay_recording(read_recording(simulated), tmp_path, ReplayOptions(pictures=False), cores=4)
    assert started == []
    assert not (tmp_path / OVERLAY_VIDEO).exists()


@pytest.mark.slow
def test_a_drawing_process_that_is_killed_is_one_line_and_what_was_tracked_is_there(
    simulated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    started: list[WorkerProcess[ToDraw, Drawn]],
) -> None:
    ask = WorkerProcess.ask

    def ask_and_kill(process: WorkerProcess[ToDraw, Drawn], questions: list[ToDraw]) -> None:
        # Before it is asked: afterwards it might answer in time.
        if questions[0].seen.track.frame == 8:
            process._process.send_signal(signal.SIGKILL if os.name == "posix" else signal.SIGTERM)
        ask(process, questions)

    monkeypatch.setattr(WorkerProcess, "ask", ask_and_kill)
    monkeypatch.setattr("arctrack.workers.cores_each", lambda *_: 3)
    result = RUNNER.invoke(app, ["replay", str(simulated), "--out", str(tmp_path)])
    assert result.exit_code == 2, result.output
    assert without_progress(result.stderr) == [
        f"arctrack: error: {tmp_path}: a process that drew pictures has ended, for want of memory perhaps; "
        "what was tracked and sent is there, --no-pictures draws nothing"
    ]
    assert len(results_of(tmp_path)) == 14
    assert all((tmp_path / name).exists() for name in (SUMMARY_JSON, BUS_LOG))
    assert not (tmp_path / FINISHED_JSON).exists()
    assert pictures_in(tmp_path / OVERLAY_VIDEO) == 8
    assert all(process._process.poll() is not None for process in started)


INTERRUPTED = """
import os, signal, sys
import arctrack.cli.console
import arctrack.workers
from arctrack.child_process import WorkerProcess
from arctrack.replay.pages import drawing

# What a shell starts in the background ignores SIGINT, and so would its children.
signal.signal(signal.SIGINT, signal.default_int_handler)
moment, pids = sys.argv.pop(), []

def interrupt_at(this):
    if this == moment:
        print(*pids, flush=True)
        # To all of the group, as a terminal does.
        os.killpg(0, signal.SIGINT)

class Watched(WorkerProcess):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        pids.append(self._process.pid)
    def wait_ready(self):
        interrupt_at("loading")
        super().wait_ready()
    def ask(self, questions):
        super().ask(questions)
        if questions[0].seen.track.frame == 12:
            interrupt_at("drawing")

drawing.WorkerProcess, drawing.FRAMES_WORTH_A_PROCESS = Watched, 1
arctrack.workers.cores_each = lambda *_: 3
arctrack.cli.console.SPOKEN_EVERY_S = 0.001
from arctrack.cli import main
main()
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
@pytest.mark.parametrize("moment", ["loading", "drawing"])
def test_ctrl_c_ends_all_of_them_and_leaves_what_is_written(
    compiled: None, simulated: Path, tmp_path: Path, moment: str
) -> None:
    command = [sys.executable, "-c", INTERRUPTED, "replay", str(simulated), "--out", str(tmp_path), moment]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, start_new_session=True, timeout=240
    )
    assert done.returncode == 130, done.stderr
    assert without_progress(done.stderr) == [
        f"arctrack: v: replay interrupted; rows so far are in {tmp_path / 'results.csv'}, what was sent in "
        f"{tmp_path / BUS_LOG}"
    ]
    pids = [int(pid) for pid in done.stdout.split()]
    assert len(pids) == 2
    for pid in pids:
        # Ended and waited for, so that its number is free.
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    if moment == "drawing":
        assert len(results_of(tmp_path)) == 14
        assert pictures_in(tmp_path / OVERLAY_VIDEO) == 4
        assert not (tmp_path / REPLAY_PAGE).exists()
