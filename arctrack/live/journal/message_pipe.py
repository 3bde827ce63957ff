"""A pipe of whole messages between a run's processes, which another process may take over at either end.

A process that is killed while it reads or writes a stream leaves a part of a message in it, which the next
one takes for a message. Here each is sent and received at once or not at all (unix(7), SOCK_SEQPACKET). The
pipe has no name: none but the processes that are given an end reach it.
"""

import os
import pickle
import socket
from contextlib import suppress
from multiprocessing.connection import wait
from typing import Any


class PipeEnd:
    """One end of a pipe over a non-blocking socket; it blocks only on request.

    Pickled, it is the same descriptor: that of a child process which was passed it.
    """

    def __init__(self, handle: int) -> None:
        self._handle = handle

    def __reduce__(self) -> tuple[Any, ...]:
        return PipeEnd, (self._handle,)

    def __del__(self) -> None:
        os.close(self._handle)

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return self._handle

    def send(self, message: object) -> None:
        """Send a message; OSError where there is no room for it, or nobody has the other end."""
        os.write(self._handle, pickle.dumps(message, pickle.HIGHEST_PROTOCOL))

    def poll(self, wait_s: float | None = 0.0) -> bool:
        """Return True if a message, or the end, is there within a time, s."""
        return bool(wait([self._handle], wait_s))

    def recv(self) -> Any:
        """Wait for a message and return it; EOFError where nobody has the other end."""
        self.poll(None)
        # Upper bound of a message: Linux takes a fifth of that unless net.core.wmem_max says more.
        packed = os.read(self._handle, 2**20)
        if not packed:
            raise EOFError
        return pickle.loads(packed)


class PipeClient:
    """Client at one end of a pipe, with one request at a time; it blocks only on request."""

    def __init__(self, end: PipeEnd) -> None:
        self._end = end
        self._is_pending = False

    def ask(self, request: object) -> None:
        """Send a request, unless the last one is not answered yet."""
        if not self._is_pending:
            with suppress(OSError):
                self._end.send(request)
                self._is_pending = True

    def answer(self, wait_s: float = 0.0) -> Any:
        """Return the answer if it comes within a time, s, otherwise None."""
        if not (self._is_pending and self._end.poll(wait_s)):
            return None
        try:
            answer = self._end.recv()
        except (EOFError, OSError):
            return None
        self._is_pending = False
        return answer


def message_pipe() -> tuple[PipeEnd, PipeEnd]:
    """Return both ends of a new pipe."""
    first, second = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
    return PipeEnd(first.detach()), PipeEnd(second.detach())
