"""Lines to a terminal, a pipe or a file."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from queue import Full, Queue
from threading import Thread
from typing import TextIO

MAX_WAITING = 64
"""Lines that wait for a held terminal or a full pipe; those that come later are dropped."""


def write_line(line: str, stream: TextIO) -> None:
    """Write a line at once; where nobody reads any more, this one and all that come are dropped."""
    try:
        print(line, file=stream, flush=True)
    except OSError as error:
        # Errors where a pipe's reader has ended, or a terminal was closed.
        if error.errno not in (errno.EPIPE, errno.EIO):
            raise
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


class LineQueue:
    """Lines that a thread of its own writes to a file descriptor: `put` never waits.

    A terminal that is held by Ctrl-S, or a full pipe, stops who writes to it. The thread writes without
    Python's buffers, whose locks would stop the end of the process as well.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._waiting: Queue[str | None] = Queue(MAX_WAITING)
        self._thread = Thread(target=self._write, name="arctrack lines", daemon=True)

    def put(self, line: str) -> None:
        """Let a line be written."""
        with suppress(Full):
            self._waiting.put_nowait(line)

    @contextmanager
    def started(self) -> Iterator[None]:
        """Write meanwhile; in the end what is held up is left."""
        self._thread.start()
        try:
            yield
        finally:
            with suppress(Full):
                self._waiting.put_nowait(None)
                # Longest wait in the end for lines that are not written yet, s.
                self._thread.join(1.0)

    def _write(self) -> None:
        while (line := self._waiting.get()) is not None:
            unwritten = f"{line}\n".encode(errors="backslashreplace")
            # Where nobody reads any more, or a log's disk is full, the line is lost.
            with suppress(OSError):
                while unwritten:
                    unwritten = unwritten[os.write(self._descriptor, unwritten) :]
