"""A process that works for a live run: what it does touches neither the loop nor its time."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from arctrack.errors import ArctrackError
from arctrack.live.journal.message_pipe import PipeEnd
from arctrack.live.journal.records import ProcessState
from arctrack.safe_points import leave_signals_to_parent
from arctrack.workers import end_with_parent

ENDS_S = 2.0
"""Time that a process may take to end, unless it writes something."""

FIRST_DELAY_S, MAX_DELAY_S = 1.0, 60.0
"""A process that ended is started again after so long; the time doubles with each end up to the second, s.

The second is also how long a process must have lived for its next delay to be the first one again.
"""

ERROR = "error: "
"""Prefix of the first message of a process that cannot do its work."""

SPAWN = multiprocessing.get_context("spawn")
"""A fork would have the loop's own threads, locked memory and real-time priority."""


class SideProcess:
    """A restartable subprocess of a run.

    Over its own connection it reports once that it is ready, with what its users need to know, or ERROR and
    the reason. Later it may report a problem, and "" once that is gone. It ends when the connection is
    closed.

    `target` takes `arguments` (those at its next start), then its end of the connection, then `pipes`. The
    pipes' ends stay open here too, so that a restart goes unnoticed at their other ends. `lost` is answered
    into the pipes for a process that ended with an open request. `ends_s` is the time it may take to end.
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
        return ProcessState(self._process.pid or 0, self._is_ready, self._ends, self._problem)

    def wait_ready(self) -> Any:
        """Wait until it is ready, and return what it said; ArctrackError with its reason where it cannot."""
        try:
            said = self._told.recv()
        except (EOFError, OSError):
            said = f"{ERROR}the process of the {self.name} ended by itself"
        if isinstance(said, str) and said.startswith(ERROR):
            self._failure = said.removeprefix(ERROR)
            raise ArctrackError(self._failure)
        self._is_ready = True
        return said

    def end(self, last_word: object = None) -> list[str]:
        """Let it end, with a last word to it where it waits for one, and return what it still said."""
        lines: list[str] = []
        if last_word is not None:
            with suppress(EOFError, OSError):
                self._told.send(last_word)
                while self._told.poll(self._ends_s):
                    lines += self._hear(self._told.recv())
        self._told.close()
        self._process.join(self._ends_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._is_ready = False
        return lines

    def waits(self) -> tuple[list[Any], float]:
        """Return what is to be waited for until the next look, and until which monotonic time, s."""
        if self._due_s < float("inf"):
            return [], self._due_s
        return [self._process.sentinel, *([] if self._told.closed else [self._told])], float("inf")

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
            while not self._told.closed and self._told.poll():
                lines += self._hear(self._told.recv())
        except (EOFError, OSError):
            self._told.close()
        code = self._process.exitcode
        if code is not None:
            how = f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"
            lines += self._start_later(self._failure or f"its process ended, {how}")
        return lines

    def _start(self) -> None:
        self._told, its_end = SPAWN.Pipe()
        self._process = SPAWN.Process(
            target=_begin,
            args=(self._ends_s, self._target, *self.arguments, its_end, *self._pipes),
            name=f"arctrack {self.name}",
            daemon=True,
        )
        self._failure, self._due_s, self._started_s = "", float("inf"), time.monotonic()
        try:
            self._process.start()
        finally:
            its_end.close()
        # From its first instruction on: what it loads would be in the loop's way as well.
        with suppress(ProcessLookupError):
            os.setpriority(os.PRIO_PROCESS, self.state.pid, self._niceness)

    def _hear(self, said: object) -> list[str]:
        """Take a message of the process, and return the lines to report."""
        if self._is_ready:
            before, self._problem = self._problem, str(said)
            return [] if self._problem == before else [f"{self.name}: {self._problem or 'works again'}"]
        if isinstance(said, str) and said.startswith(ERROR):
            self._failure = said.removeprefix(ERROR)
            return []
        self._is_ready, self._problem = True, ""
        return [f"{self.name}: runs again{f', {said}' if said else ''}"]

    def _start_later(self, problem: str) -> list[str]:
        """Note why it does not run, and when it is started again."""
        self._told.close()
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


def _begin(ends_s: float, target: Callable[..., None], *arguments: Any) -> None:
    """Run a process: Ctrl-C and the end of a service are meant for the loop, which ends it."""
    leave_signals_to_parent()
    end_with_parent(ends_s)
    target(*arguments)


@contextmanager
def ended(process: SideProcess, last_word: object = None) -> Iterator[SideProcess]:
    """End a process in the end."""
    try:
        yield process
    finally:
        process.end(last_word)
