"""Supervisor of a live run's processes: one that ends is reported, and restarted.

It is a thread, which sleeps until a process ends or sends something. It begins before the loop's own thread
gets its priority and its processors, so what it starts inherits neither.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import wait
from threading import Lock, Thread

from arctrack.live.journal.records import ProcessState
from arctrack.live.serve.side_process import SPAWN, SideProcess

Tell = Callable[[str], None]
"""Callback with a line for people."""


class Supervisor:
    """Supervisor of processes within `watching`; it calls `tell` from a thread of its own."""

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._processes: list[SideProcess] = []
        self._lock = Lock()
        self._wakes, self._wake = SPAWN.Pipe(duplex=False)
        self._thread = Thread(target=self._watch, name="arctrack supervisor", daemon=True)
        self._is_over = False

    @contextmanager
    def running(self, process: SideProcess, last_word: object = None) -> Iterator[SideProcess]:
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
