"""Child processes: real ones, that answer, fail, are killed, and outlive nobody."""

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from arctrack.child_process import AT_A_TIME, ChildProcess, WorkerProcess, answered
from arctrack.errors import ArctrackError
from arctrack.workers import processes

ENDED = ArctrackError("r: a process has ended")


def roots(numbers: list[int], count: int) -> list[float]:
    """Return roots that so many processes find."""
    with ExitStack() as opened:
        beside = [opened.enter_context(WorkerProcess(math.sqrt, ENDED)) for _ in range(count)]
        return [root for _, root in answered(math.sqrt, beside, numbers)]


def is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # Who has ended stays listed until somebody asks; in a container that may be nobody.
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def children(pid: int) -> list[int]:
    """Return the child processes of a process, whichever of its threads started them."""
    threads = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for thread in threads for child in thread.read_text().split()]


def wait_until(said: Callable[[], bool]) -> None:
    """Wait for what comes soon; what never does fails here, on a busy machine too."""
    for _ in range(600):
        if said():
            return
        time.sleep(0.1)
    pytest.fail("waited a minute in vain")


@pytest.mark.parametrize("count", [0, 1, 3])
def test_answers_come_in_the_order_of_the_questions(count: int) -> None:
    numbers = list(range(20))
    assert roots(numbers, count) == [math.sqrt(number) for number in numbers]
    assert roots(numbers[:2], count) == [0.0, 1.0]
    assert roots([], count) == []


def test_a_process_works_while_its_last_answers_are_used() -> None:
    with WorkerProcess(math.sqrt, ENDED) as process:
        asked: list[int] = []

        def questions() -> Iterator[int]:
            for number in range(3 * AT_A_TIME):
                asked.append(number)
                yield number

        answers = answered(math.sqrt, [process], questions())
        assert next(answers) == (0, 0.0)
        assert len(asked) == 2 * AT_A_TIME
        assert list(answers) == [(n, math.sqrt(n)) for n in asked[1:]]


def test_what_answering_raises_is_raised_here_and_says_where() -> None:
    with WorkerProcess(math.sqrt, ENDED) as process:
        process.wait_ready()
        process.ask([-1])
        with pytest.raises(ValueError, match="math domain error") as raised:
            process.answers()
        assert "in _answers" in raised.value.__notes__[0]
        process.ask([4])
        assert process.answers() == [2.0]


def test_a_process_that_ended_is_one_line() -> None:
    with WorkerProcess(os._exit, ENDED) as process:
        process.wait_ready()
        process.ask([9])
        with pytest.raises(ArctrackError, match=f"^{ENDED}$"):
            process.answers()
        process.ask([9])
        with pytest.raises(ArctrackError, match=f"^{ENDED}$"):
            process.answers()


def test_a_process_that_cannot_start_says_so_when_it_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arctrack.child_process.CODE", "raise SystemExit(1)")
    with WorkerProcess(math.sqrt, ENDED) as process:
        process.wait_ready()
        with pytest.raises(ArctrackError, match=f"^{ENDED}$"):
            process.answers()


def test_what_prints_is_no_answer(capfd: pytest.CaptureFixture[str]) -> None:
    with WorkerProcess(print, ENDED) as process:
        process.wait_ready()
        process.ask(["said"])
        assert process.answers() == [None]
        process.ask(["again"])
        assert process.answers() == [None]
    assert capfd.readouterr().out == ""


def test_a_terminal_s_ctrl_c_does_not_reach_it() -> None:
    with WorkerProcess(os.getpgid, ENDED) as process:
        process.wait_ready()
        process.ask([0])
        assert process.answers() != [os.getpgid(0)]


def test_it_is_gone_behind_its_context_whatever_it_does() -> None:
    with WorkerProcess(os.getpgid, ENDED) as process, WorkerProcess(time.sleep, ENDED) as sleeper:
        process.wait_ready()
        process.ask([0])
        (pid,) = process.answers()
        sleeper.ask([3600])
        assert is_there(pid)
    assert not is_there(pid)


WORKING = """
import time
from arctrack.child_process import WorkerProcess
processes = [WorkerProcess(time.sleep, Exception()) for _ in range(2)]
for process in processes:
    process.ask([3600])
time.sleep(3600)
"""

WORKERS = """
import time
from arctrack.workers import processes
with processes(2) as executor:
    busy = [executor.submit(time.sleep, 3600) for _ in range(2)]
    time.sleep(3600)
"""


@pytest.mark.parametrize("code", [WORKING, WORKERS])
def test_they_end_with_the_process_that_started_them(code: str) -> None:
    with subprocess.Popen([sys.executable, "-c", code]) as command:
        wait_until(lambda: len(children(command.pid)) == 2)
        pids = children(command.pid)
        command.kill()
    wait_until(lambda: not any(map(is_there, pids)))


UNGUARDED = """
import math
from arctrack.child_process import WorkerProcess, answered
print("begins")
with WorkerProcess(math.sqrt, Exception()) as process:
    print([root for _, root in answered(math.sqrt, [process], [1, 4])])
"""


@pytest.mark.parametrize("is_typed", [True, False])
def test_a_main_module_need_be_neither_there_nor_guarded(tmp_path: Path, is_typed: bool) -> None:
    """As at Python's prompt, and in a script that does everything as it is imported."""
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    done = subprocess.run(
        [sys.executable, "-" if is_typed else str(script)],
        input=UNGUARDED if is_typed else None,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == ["begins", "[1.0, 2.0]"]


def fail(parent: Connection) -> None:
    raise ArctrackError("there is no camera")


def give_state(parent: Connection) -> None:
    parent.send((os.nice(0), os.getppid(), os.getpgid(0)))
    parent.recv()


def give_state_of_a_child(parent: Connection) -> None:
    with ChildProcess(give_state, ended=ENDED, niceness=3) as process:
        parent.send((process.receive(), os.getpid(), process.pid))
        parent.recv()


def test_a_process_is_lower_in_priority_than_its_parent_and_in_a_group_of_its_own() -> None:
    with ChildProcess(give_state_of_a_child, ended=ENDED, niceness=4) as process:
        state, pid, child = process.receive()
        assert state == (os.nice(0) + 7, pid, child)
        assert pid == process.pid
        assert process.is_alive
    assert not process.is_alive
    wait_until(lambda: not is_there(child))


def test_an_error_of_a_user_s_is_raised_here_and_any_end_is_one_line() -> None:
    with ChildProcess(fail, ended=ENDED) as process:
        with pytest.raises(ArctrackError, match="there is no camera"):
            process.receive()
        with pytest.raises(ArctrackError, match=f"^{ENDED}$"):
            process.receive()
        assert process.end(60.0) == 0


def kill_once(mark: Path) -> None:
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_process_that_is_killed_fails_its_task_alone(tmp_path: Path) -> None:
    with processes(1) as executor:
        killed, *others = [executor.submit(kill_once, tmp_path / "mark") for _ in range(3)]
        assert isinstance(killed.exception(), BrokenExecutor)
        assert [other.result() for other in others] == [None, None]


INTERRUPTED = """
import os, signal, sys, time
from pathlib import Path
from arctrack.workers import processes
from work import work
signal.signal(signal.SIGINT, signal.default_int_handler)
marks = [Path(sys.argv[1]), Path(sys.argv[2])]
try:
    with processes(2) as executor:
        futures = [executor.submit(work, mark) for mark in (*marks, *marks)]
        while not all(mark.exists() for mark in marks):
            time.sleep(0.01)
        # To all of the group, as a terminal does.
        os.killpg(0, signal.SIGINT)
        time.sleep(60.0)
except KeyboardInterrupt:
    print(*(mark.read_text() for mark in marks), sum(future.cancelled() for future in futures))
"""

WORK = """
import time
def work(mark):
    mark.touch()
    try:
        time.sleep(3600)
    finally:
        mark.write_text("closed")
"""


@pytest.mark.slow
def test_ctrl_c_lets_tasks_close_their_files_and_none_begin(tmp_path: Path) -> None:
    (tmp_path / "work.py").write_text(WORK)
    (tmp_path / "script.py").write_text(INTERRUPTED)
    command = [sys.executable, tmp_path / "script.py", tmp_path / "a", tmp_path / "b"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, start_new_session=True)
    assert done.stdout == "closed closed 2\n"
    assert done.stderr == ""


@pytest.mark.slow
def test_a_worker_has_processes_of_its_own() -> None:
    with processes(1) as executor:
        assert executor.submit(roots, [1, 4, 9], 2).result() == [1.0, 2.0, 3.0]
