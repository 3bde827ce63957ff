"""A process of its own that answers questions, some at a time."""

from __future__ import annotations

import os
import pickle
import select
import subprocess
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from threading import Thread
from typing import Any, BinaryIO, Generic, NamedTuple, TypeVar, cast

from arctrack.closing import Closing
from arctrack.errors import ArctrackError

Question = TypeVar("Question")
Answer = TypeVar("Answer")

AT_A_TIME = 4
"""Number of questions sent to a process at once: the fewer, the more often one waits for the other to wake
it.
"""

CODE = "import sys; sys.path[:] = {path!r}; from arctrack.own_process import serve; serve()"

GROUP_OF_ITS_OWN: dict[str, Any] = {"start_new_session": True}
"""Options that start a process beyond the reach of a terminal's Ctrl-C."""

if sys.platform == "win32":
    GROUP_OF_ITS_OWN = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}


class OwnProcess(Closing, Generic[Question, Answer]):
    """A subprocess that answers requests by a function; the end of its context ends it.

    Unlike one of multiprocessing it does not import this program's main module: a script need not guard it,
    and a prompt has none. It ignores a terminal's Ctrl-C, and ends however this process ends.

    `answer` is pickled. `ended` is the error's text if the process ends by itself. `stderr` is as in
    `subprocess`, by default this process's.
    """

    def __init__(self, answer: Callable[[Question], Answer], ended: str, stderr: int | None = None) -> None:
        self._ended, self._is_ready = ended, False
        self._process: subprocess.Popen[bytes] = subprocess.Popen(
            [sys.executable, "-c", CODE.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            **GROUP_OF_ITS_OWN,
        )
        self._to = cast(BinaryIO, self._process.stdin)
        self._from = cast(BinaryIO, self._process.stdout)
        self._send(answer)

    def wait_ready(self) -> None:
        """Wait until it has loaded what it needs, or has ended: that is said of its answers."""
        if not self._is_ready:
            self._is_ready = True
            with suppress(ArctrackError):
                self._receive()

    def ask(self, questions: Sequence[Question]) -> None:
        """Queue questions."""
        self._send(questions)

    def answers(self, on_word: Callable[[Any], None] | None = None) -> list[Answer]:
        """Wait for the answers; raise what answering raised, or ArctrackError if the process ended.

        `on_word` gets what `tell` sends before them.
        """
        self.wait_ready()
        while isinstance(answers := self._receive(), _Word):
            if on_word is not None:
                on_word(answers.word)
        if isinstance(answers, _WorkerError):
            raise answers.error
        return cast(list[Answer], answers)

    def close(self) -> None:
        """End it, whatever it does: it holds nothing that would be lost."""
        self._process.kill()
        with suppress(OSError):
            self._to.close()
        self._from.close()
        self._process.wait()

    def _send(self, item: object) -> None:
        # If the process has ended, there is no answer: that is when it is said.
        with suppress(OSError):
            pickle.dump(item, self._to, pickle.HIGHEST_PROTOCOL)
            self._to.flush()

    def _receive(self) -> object:
        try:
            return pickle.load(self._from)
        except (EOFError, pickle.UnpicklingError):
            raise ArctrackError(self._ended) from None


def answered(
    answer: Callable[[Question], Answer],
    processes: Sequence[OwnProcess[Question, Answer]],
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
    asked: deque[tuple[list[Question], OwnProcess[Question, Answer]]] = deque()
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
    asked: deque[tuple[list[Question], OwnProcess[Question, Answer]]],
    free: deque[OwnProcess[Question, Answer]],
) -> list[tuple[Question, Answer]]:
    """Return the first questions of those asked with their answers; their process is free then."""
    questions, process = asked.popleft()
    answers = process.answers()
    free.append(process)
    return list(zip(questions, answers, strict=True))


class _WorkerError:
    """Exception raised while answering."""

    def __init__(self, error: Exception) -> None:
        self.error = error


class _Word(NamedTuple):
    """Message sent before an answer."""

    word: object


def tell(word: object) -> None:
    """Send a message to the parent before the answer."""
    _send_back(_BACK[-1], _Word(word))


_BACK: list[BinaryIO] = []
"""Stream of the answers, in a process that gives them."""


def serve() -> None:
    """Answer the questions that come to this process, by the function that comes first."""
    if hasattr(select, "poll"):
        Thread(target=_end_with_asker, daemon=True).start()
    asked = sys.stdin.buffer
    back = os.fdopen(os.dup(1), "wb")
    _BACK.append(back)
    # What prints would speak in between.
    os.dup2(2, 1)
    # Who asks may end at any moment, in the middle of a question as well.
    with suppress(EOFError, pickle.UnpicklingError, BrokenPipeError):
        answer = pickle.load(asked)
        _send_back(back, None)
        while True:
            _send_back(back, _answers(answer, pickle.load(asked)))


def _end_with_asker() -> None:
    """Wait until the parent has ended, and end: nobody takes the answers any more."""
    asker = select.poll()
    asker.register(0, 0)
    asker.poll()
    os._exit(1)


def _answers(answer: Callable[[Any], object], questions: Sequence[object]) -> object:
    try:
        return [answer(question) for question in questions]
    except Exception as error:
        error.add_note(traceback.format_exc())
        return _WorkerError(error)


def _send_back(back: BinaryIO, item: object) -> None:
    pickle.dump(item, back, pickle.HIGHEST_PROTOCOL)
    back.flush()
