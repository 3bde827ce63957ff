"""Processes that answer questions: real ones, that answer, fail, are killed, and outlive nobody."""

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from arctrack.errors import ArctrackError
from arctrack.own_process import AT_A_TIME, OwnProcess, answered
from arctrack.workers import processes

ENDED = "r: a process has ended"

needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="asks POSIX who belongs to whom")


def roots(numbers: list[int], count: int) -> list[float]:
    """Return roots that so many processes find."""
    with ExitStack() as opened:
        beside = [opened.enter_context(OwnProcess(math.sqrt, ENDED)) for _ in range(count)]
        return [root for _, root in answered(math.sqrt, beside, numbers)]


def is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # Who has ended stays listed until somebody asks; in a container that may be nobody.
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


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
    with OwnProcess(math.sqrt, ENDED) as process:
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
    with OwnProcess(math.sqrt, ENDED) as process:
        process.wait_ready()
        process.ask([-1])
        with pytest.raises(ValueError, match="math domain error") as raised:
            process.answers()
        assert "in _answers" in raised.value.__notes__[0]
        process.ask([4])
        assert process.answers() == [2.0]


def test_a_process_that_ended_is_one_line() -> None:
    with OwnProcess(os._exit, ENDED) as process:
        process.wait_ready()
        process.ask([9])
        with pytest.raises(ArctrackError, match=f"^{ENDED}$"):
            process.answers()
        process.ask([9])
        with pytest.raises(ArctrackError, match=f"^{ENDED}$"):
            process.answers()


def test_a_process_that_cannot_start_says_so_when_it_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("arctrack.own_process.CODE", "raise SystemExit(1)  # {path}")
    with OwnProcess(math.sqrt, ENDED) as process:
        process.wait_ready()
        with pytest.raises(ArctrackError, match=f"^{ENDED}$"):
            process.answers()


def test_what_prints_is_no_answer(capfd: pytest.CaptureFixture[str]) -> None:
    with OwnProcess(print, ENDED) as process:
        process.wait_ready()
        process.ask(["said"])
        assert process.answers() == [None]
        process.ask(["again"])
        assert process.answers() == [None]
    assert capfd.readouterr().out == ""


@needs_posix
def test_a_terminal_s_ctrl_c_does_not_reach_it() -> None:
    with OwnProcess(os.getpgid, ENDED) as process:
        process.wait_ready()
        process.ask([0])
        assert process.answers() != [os.getpgid(0)]


@needs_posix
def test_it_is_gone_behind_its_context_whatever_it_does() -> None:
    with OwnProcess(os.getpgid, ENDED) as process, OwnProcess(time.sleep, ENDED) as sleeper:
        process.wait_ready()
        process.ask([0])
        (pid,) = process.answers()
        sleeper.ask([3600])
        assert is_there(pid)
    assert not is_there(pid)


OF_THEIR_OWN = """
import os, time
from arctrack.own_process import OwnProcess
processes = [OwnProcess(os.getpgid, "") for _ in range(2)]
for process in processes:
    process.ask([0])
print(*(process.answers()[0] for process in processes), flush=True)
time.sleep(3600)
"""

WORKERS = """
import multiprocessing, time
from arctrack.workers import processes
with processes(2) as executor:
    busy = [executor.submit(time.sleep, 3600) for _ in range(2)]
    print(*(child.pid for child in multiprocessing.active_children()), flush=True)
"""


@needs_posix
@pytest.mark.parametrize("code", [OF_THEIR_OWN, WORKERS])
def test_they_end_with_the_process_that_started_them(code: str) -> None:
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as command:
        assert command.stdout is not None
        pids = [int(pid) for pid in command.stdout.readline().split()]
        assert len(pids) == 2
        assert all(map(is_there, pids))
        command.send_signal(signal.SIGKILL)
    wait_until(lambda: not any(map(is_there, pids)))


UNGUARDED = """
import math
from arctrack.own_process import OwnProcess, answered
print("begins")
with OwnProcess(math.sqrt, "ended") as process:
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


def test_a_worker_has_processes_of_its_own() -> None:
    with processes(1) as executor:
        assert executor.submit(roots, [1, 4, 9], 2).result() == [1.0, 2.0, 3.0]
