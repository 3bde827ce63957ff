"""Child processes: the one way in which arctrack runs its own code in another process.

multiprocessing's import the program's main module again, hear a terminal's Ctrl-C, and may outlive a parent
that is killed.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from multiprocessing.connection import Connection, Pipe
from threading import Thread
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from arctrack.closing import Closing
from arctrack.end_signals import leave_signals_to_parent
from arctrack.errors import ArctrackError

if TYPE_CHECKING:
    from _typeshed import HasFileno

Question = TypeVar("Question")
Answer = TypeVar("Answer")

AT_A_TIME = 4
"""Number of questions sent to a process at once: the fewer, the more often either waits to be woken."""

CODE = (
    "import os, sys; os.nice({niceness}); sys.path[:] = {path!r}; "
    "from arctrack.child_process import run_child; run_child({descriptor}, {ends_s!r})"
)

_parent: Connection | None = None
"""Connection to the parent, in a child process."""


class ChildProcess(Closing):
    """A subprocess that runs `target(*arguments, connection, *passed)`; the end of its context ends it.

    It does not import this program's main module: a script need not guard it, and a prompt has none. It
    leaves Ctrl-C and the end of a service to this process, and ends however this process ends. What it prints
    goes to stderr. An ArctrackError of `target` is raised here by `receive`.

    `target` is no function of the main module. `passed` are open files, such as ends of pipes: pickled, each
    names its descriptor. `ended` is raised by `receive` if the process ends by itself. `niceness` is above
    this process's, `stderr` as in `subprocess`, `ends_s` the time that it has to end once its parent has, s.
    """

    def __init__(
        self,
        target: Callable[..., None],
        arguments: tuple[Any, ...] = (),
        passed: Sequence[HasFileno] = (),
        *,
        ended: Exception,
        niceness: int = 0,
        stderr: int | None = None,
        ends_s: float = 0.0,
    ) -> None:
        self._ended = ended
        self.connection, its_end = Pipe()
        with its_end:
            descriptor = its_end.fileno()
            code = CODE.format(niceness=niceness, path=sys.path, descriptor=descriptor, ends_s=ends_s)
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                # Held here alone: it closes when this process ends.
                stdin=subprocess.PIPE,
                stderr=stderr,
                pass_fds=[descriptor, *(each.fileno() for each in passed)],
                start_new_session=True,
            )
        self.send((target, arguments, passed))

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """True until it has ended."""
        return self._process.poll() is None

    def send(self, message: object) -> None:
        """Send a message; one that has ended is said to have when it is to answer."""
        with suppress(OSError):
            self.connection.send(message)

    def receive(self) -> Any:
        """Wait for a message and return it; raise what it sends of errors, or that it has ended."""
        try:
            message = self.connection.recv()
        except (EOFError, OSError):
            raise self._ended from None
        if isinstance(message, Exception):
            raise message
        return message

    def wait(self, wait_s: float) -> int:
        """Return its exit code, as in `subprocess`; it is killed where it takes longer to end."""
        try:
            return self._process.wait(wait_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def end(self, wait_s: float) -> int:
        """Close the connection, and wait for its end."""
        self.connection.close()
        code = self.wait(wait_s)
        assert self._process.stdin is not None
        self._process.stdin.close()
        return code

    def close(self) -> None:
        """Kill it."""
        self._process.kill()
        self.end(0.0)


class WorkerProcess(ChildProcess, Generic[Question, Answer]):
    """Child process that answers questions by a function."""

    def __init__(self, answer: Callable[[Question], Answer], ended: Exception) -> None:
        super().__init__(_work, (answer,), ended=ended)
        self._is_ready = False

    def wait_ready(self) -> None:
        """Wait until it has loaded what it needs, or has ended: that is said of its answers."""
        if not self._is_ready:
            with suppress(type(self._ended)):
                self.receive()
            self._is_ready = True

    def ask(self, questions: Sequence[Question]) -> None:
        """Queue questions."""
        self.send(questions)

    def answers(self) -> list[Answer]:
        """Wait for the answers; raise what answering raised, or that it has ended."""
        self.wait_ready()
        answers: list[Answer] = self.receive()
        return answers

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt in it, which ends it."""
        # Before it is ready it holds nothing that would be lost.
        if self._is_ready:
            self._process.send_signal(signal.SIGINT)
        else:
            self._process.kill()


def answered(
    answer: Callable[[Question], Answer],
    processes: Sequence[WorkerProcess[Question, Answer]],
    questions: Iterable[Question],
) -> Iterator[tuple[Question, Answer]]:
    """Yield questions and their answers in the order of the questions; without processes answer them here.

    Each process has some questions at a time, and the next ones before its answers are used.
    """
    if not processes:
        for question in questions:
            yield question, answer(question)
        return
    free = deque(processes)
    asked: deque[tuple[list[Question], WorkerProcess[Question, Answer]]] = deque()
    unasked = iter(questions)
    while batch := list(islice(unasked, AT_A_TIME)):
        done = [] if free else _first(asked, free)
        process = free.popleft()
        process.ask(batch)
        asked.append((batch, process))
        yield from done
    while asked:
        yield from _first(asked, free)


def _first(
    asked: deque[tuple[list[Question], WorkerProcess[Question, Answer]]],
    free: deque[WorkerProcess[Question, Answer]],
) -> list[tuple[Question, Answer]]:
    """Return the first questions of those asked with their answers; their process is free then."""
    questions, process = asked.popleft()
    answers = process.answers()
    free.append(process)
    return list(zip(questions, answers, strict=True))


def is_child() -> bool:
    """Return True in a child process."""
    return _parent is not None


def run_child(descriptor: int, ends_s: float) -> None:
    """Run what the parent sends first over the connection of a descriptor."""
    global _parent
    leave_signals_to_parent()
    Thread(target=_end_with_parent, args=(ends_s,), name="ends with parent", daemon=True).start()
    if sys.stderr is not None:
        os.dup2(2, 1)
    os.set_inheritable(descriptor, False)
    _parent = Connection(descriptor)
    try:
        target, arguments, passed = _parent.recv()
    except (EOFError, OSError):
        return
    try:
        target(*arguments, _parent, *passed)
    except ArctrackError as error:
        with suppress(OSError):
            _parent.send(error)


def _end_with_parent(after_s: float) -> None:
    """Wait until the parent has ended, and end: nobody takes results any more."""
    parent = select.poll()
    parent.register(0, 0)
    parent.poll()
    time.sleep(after_s)
    os._exit(1)


def _work(answer: Callable[[Any], object], parent: Connection) -> None:
    """Answer questions until the parent closes the connection, or interrupts."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with suppress(EOFError, ConnectionResetError, BrokenPipeError, KeyboardInterrupt):
        parent.send(None)
        while True:
            parent.send(_answers(answer, parent.recv()))


def _answers(answer: Callable[[Any], object], questions: Sequence[object]) -> object:
    try:
        return [answer(question) for question in questions]
    except Exception as error:
        error.add_note(traceback.format_exc())
        return error
