"""Processes of a live run: one that ends is told of and started again, and none outlives the run."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path

import pytest
from test_child_process import is_there, wait_until

from arctrack.errors import ArctrackError
from arctrack.live.journal.message_pipe import PipeEnd, message_pipe
from arctrack.live.serve import supervisor as supervisor_module
from arctrack.live.serve.supervisor import SupervisedProcess, Supervisor

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr(supervisor_module, "FIRST_DELAY_S", 0.01)


def answer(told: Connection, asked: PipeEnd) -> None:
    """Answer each question but "nothing"; trouble is told."""
    told.send([])
    while wait([told, asked.fileno()]) == [asked.fileno()]:
        question = asked.recv()
        if question == "trouble":
            told.send("is in trouble")
            told.send("")
        if question != "nothing":
            asked.send((os.getpid(), question))


def fail(mark: Path, told: Connection) -> None:
    with mark.open("a") as file:
        file.write("tried\n")
    if mark.read_text().count("\n") < 4:
        raise ArctrackError("the port is taken")
    told.send([])
    wait([told])


def test_a_killed_process_is_started_again_on_the_same_pipe() -> None:
    lines: queue.Queue[str] = queue.Queue()
    supervisor = Supervisor(lines.put)
    ours, its = message_pipe()
    process = SupervisedProcess("answers", answer, (), (its,), niceness=3, lost="lost")
    with supervisor.running(process):
        process.wait_ready()
        with supervisor.watching():
            ours.send("one")
            pid, question = ours.recv()
            assert (pid, question) == (process.state.pid, "one")
            assert os.getpriority(os.PRIO_PROCESS, pid) == os.getpriority(os.PRIO_PROCESS, 0) + 3
            ours.send("trouble")
            ours.recv()
            assert lines.get() == "answers: is in trouble"
            assert lines.get() == "answers: works again"

            ours.send("nothing")
            os.kill(pid, signal.SIGKILL)
            assert lines.get() == "answers: its process ended, signal SIGKILL; it is started again"
            assert ours.recv() == "lost"
            assert lines.get() == "answers: runs again"
            state = supervisor.states()["answers"]
            assert (state.is_running, state.ends, state.problem) == (True, 1, "")
            ours.send("two")
            again, question = ours.recv()
            assert question == "two"
            assert again == state.pid != pid
    assert lines.empty()
    assert not Path(f"/proc/{again}").exists()


def test_what_cannot_begin_is_told_once_and_tried_ever_later(tmp_path: Path) -> None:
    lines: queue.Queue[str] = queue.Queue()
    supervisor = Supervisor(lines.put)
    process = SupervisedProcess("page", fail, (tmp_path / "mark",))
    with supervisor.running(process):
        with pytest.raises(ArctrackError, match="the port is taken"):
            process.wait_ready()
        with supervisor.watching():
            assert lines.get() == "page: the port is taken; it is started again"
            assert lines.get() == "page: runs again"
            assert process.state.ends == 3
    assert (tmp_path / "mark").read_text().count("\n") == 4


WORK_FOR_EVER = """
import os, time

def work_for_ever(parent):
    parent.send(os.getpid())
    while True:
        time.sleep(0.1)
"""

PARENT = """
import time
from arctrack.live.serve.supervisor import SupervisedProcess
from work import work_for_ever

process = SupervisedProcess("watch", work_for_ever)
print(process.wait_ready(), flush=True)
time.sleep(600.0)
"""


def test_no_process_outlives_a_run_that_is_killed(tmp_path: Path) -> None:
    """As the watch, which does not look up while it looks at a gap."""
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    (tmp_path / "work.py").write_text(WORK_FOR_EVER)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        pid = int(parent.stdout.readline())
        # Neither a closed terminal nor the end of a service is for it.
        for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGUSR1):
            os.kill(pid, number)
        parent.send_signal(signal.SIGKILL)
        # It holds the pipe as well: that ends with it.
        assert parent.stdout.read() == ""
    wait_until(lambda: not is_there(pid))


def test_a_pipe_that_nobody_reads_makes_nobody_wait() -> None:
    one, other = message_pipe()

    def fill() -> None:
        while True:
            one.send(bytes(10_000))

    with pytest.raises(BlockingIOError):
        fill()
    assert other.recv() == bytes(10_000)


def test_a_kill_tears_no_message() -> None:
    """Whenever a process is killed that sends and receives: what is left in its pipe is whole messages."""
    one, other = message_pipe()
    message = os.urandom(60_000)
    for n in range(60):
        child = os.fork()
        if child == 0:
            try:
                while True:
                    with suppress(BlockingIOError):
                        other.send(message)
                    if other.poll():
                        other.recv()
            finally:
                os._exit(1)
        for _ in range(n % 7):
            with suppress(BlockingIOError):
                one.send(message)
            assert one.recv() == message
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        for end in (one, other):
            while end.poll():
                assert end.recv() == message
