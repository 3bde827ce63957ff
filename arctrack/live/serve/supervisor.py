"""Supervisor of a live run's processes: one that ends is reported, and restarted.

It is a thread, which sleeps until a process ends or sends something. It begins before the loop's own thread
gets its priority and its processors, so what it starts inherits neither.
"""

import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, Pipe, wait
from threading import Lock, Thread
from typing import Any

from arctrack.child_process import ChildProcess
from arctrack.errors import ArctrackError
from arctrack.live.journal.message_pipe import PipeEnd
from arctrack.live.journal.records import ProcessState

Tell = Callable[[str], None]
"""Callback with a line for people."""

ENDS_S = 2.0
"""Time that a process may take to end, unless it writes something."""

FIRST_DELAY_S, MAX_DELAY_S = 1.0, 60.0
"""Delay before a process that ended is started again, s; it doubles with each end, up to the second.

The second is also how long a process must have lived for its next delay to be the first one again.
"""


class SupervisedProcess:
    """A child process of a run that can be restarted.

    Over its connection it reports once that it is ready, with what its users need to know, or raises
    ArctrackError with the reason why not. Later it may report a problem, and "" once that is gone. It ends
    when the connection is closed.

    `target` takes `arguments` (those at its next start), then its connection, then `pipes`. The pipes' ends
    stay open here too, so that a restart goes unnoticed at their other ends. `lost` is answered into the
    pipes for a process that ended with an open request. `ends_s` is the time it may take to end.
    """

    def __init__(
        self,
        name: str,
        target: Callable[..., None],
        arguments: tuple[Any, ...] = (),
        pipes: tuple[PipeEnd, ...] = (),
        niceness: int = 0,
        lost: object = None,
        ends_s: float = ENDS_S,
    ) -> None:
        self.name, self.arguments = name, arguments
        self._target, self._pipes, self._niceness = target, pipes, niceness
        self._lost, self._ends_s = lost, ends_s
        self._is_ready, self._ends, self._problem = False, 0, ""
        self._failure, self._delay_s, self._due_s = "", FIRST_DELAY_S, float("inf")
        self._start()

    @property
    def state(self) -> ProcessState:
        """State of the process."""
        return ProcessState(self._child.pid, self._is_ready, self._ends, self._problem)

    def wait_ready(self) -> Any:
        """Wait until it is ready, and return what it said; ArctrackError with its reason where it cannot."""
        try:
            said = self._child.receive()
        except ArctrackError as error:
            self._failure = str(error)
            raise
        self._is_ready = True
        return said

    def end(self, last_word: object = None) -> list[str]:
        """Let it end, with a last word to it where it waits for one, and return what it still said."""
        lines: list[str] = []
        if last_word is not None:
            with suppress(EOFError, OSError):
                self._child.connection.send(last_word)
                while self._child.connection.poll(self._ends_s):
                    lines += self._hear(self._child.connection.recv())
        self._child.end(self._ends_s)
        self._is_ready = False
        return lines

    def waits(self) -> tuple[list[Connection], float]:
        """Return what is to be waited for until the next look, and until which monotonic time, s."""
        return ([] if self._child.connection.closed else [self._child.connection]), self._due_s

    def look(self) -> list[str]:
        """Read its messages, restart it where it is time to, and return a line for each event."""
        if self._due_s < float("inf"):
            if time.monotonic() < self._due_s:
                return []
            try:
                self._start()
            except OSError as error:
                return self._start_later(f"cannot be started: {error.strerror}")
        lines: list[str] = []
        try:
            while self._child.connection.poll():
                lines += self._hear(self._child.connection.recv())
        except (EOFError, OSError):
            code = self._child.end(self._ends_s)
            how = f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"
            lines += self._start_later(self._failure or f"its process ended, {how}")
        return lines

    def _start(self) -> None:
        self._failure, self._due_s, self._started_s = "", float("inf"), time.monotonic()
        self._child = ChildProcess(
            self._target,
            self.arguments,
            self._pipes,
            niceness=self._niceness,
            ends_s=self._ends_s,
            ended=ArctrackError(f"the process of the {self.name} ended by itself"),
        )

    def _hear(self, said: object) -> list[str]:
        """Take a message of the process, and return the lines to report."""
        if isinstance(said, ArctrackError):
            self._failure = str(said)
            return []
        if self._is_ready:
            before, self._problem = self._problem, str(said)
            return [] if self._problem == before else [f"{self.name}: {self._problem or 'works again'}"]
        self._is_ready, self._problem = True, ""
        return [f"{self.name}: runs again{f', {said}' if said else ''}"]

    def _start_later(self, problem: str) -> list[str]:
        """Note why it does not run, and when it is started again."""
        if self._lost is not None:
            for pipe in self._pipes:
                with suppress(EOFError, OSError):
                    while pipe.poll():
                        pipe.recv()
                    pipe.send(self._lost)
        now_s = time.monotonic()
        lasted = now_s - self._started_s > MAX_DELAY_S
        self._delay_s = FIRST_DELAY_S if lasted or not self._ends else min(2.0 * self._delay_s, MAX_DELAY_S)
        self._due_s = now_s + self._delay_s
        self._ends += 1
        before, self._problem = self._problem, problem
        was_ready, self._is_ready = self._is_ready, False
        is_told = was_ready or problem != before
        return [f"{self.name}: {problem}; it is started again"] if is_told else []


class Supervisor:
    """Supervisor of processes within `watching`; it calls `tell` from a thread of its own."""

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._processes: list[SupervisedProcess] = []
        self._lock = Lock()
        self._wakes, self._wake = Pipe(duplex=False)
        self._thread = Thread(target=self._watch, name="arctrack supervisor", daemon=True)
        self._is_over = False

    @contextmanager
    def running(self, process: SupervisedProcess, last_word: object = None) -> Iterator[SupervisedProcess]:
        """Watch over a process meanwhile, and end it in the end."""
        with self._lock:
            self._processes.append(process)
        try:
            yield process
        finally:
            with self._lock:
                self._processes.remove(process)
            for line in process.end(last_word):
                self._tell(line)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Start again what ends meanwhile."""
        self._thread.start()
        try:
            yield
        finally:
            self._is_over = True
            self._wake.send_bytes(b"-")
            self._thread.join()

    def states(self) -> Mapping[str, ProcessState]:
        """Return how each process stands, by its name."""
        return {process.name: process.state for process in tuple(self._processes)}

    def _watch(self) -> None:
        while not self._is_over:
            with self._lock:
                waits = [process.waits() for process in self._processes]
            due_s = min((due for _, due in waits), default=float("inf"))
            patience_s = None if due_s == float("inf") else max(0.0, due_s - time.monotonic())
            wait([self._wakes, *(end for ends, _ in waits for end in ends)], patience_s)
            with self._lock:
                lines = [] if self._is_over else [line for each in self._processes for line in each.look()]
            # A disk that is full, under a log, is no reason to watch no more.
            with suppress(OSError):
                for line in lines:
                    self._tell(line)
