"""Client of a live run's black box that requests recordings."""

import asyncio

from arctrack.live.journal.message_pipe import PipeEnd

PATIENCE_S = 60.0
"""Time-out of the black box's answer, s: it writes what it holds."""


class Saver:
    """Client of the black box, one request at a time; without a connection there is no black box."""

    def __init__(self, connection: PipeEnd | None) -> None:
        self._connection = connection
        self._asking = asyncio.Lock()

    @property
    def is_there(self) -> bool:
        """True if there is a black box."""
        return self._connection is not None

    async def save(self, reason: str) -> dict[str, str]:
        """Return the black box' answer: `saved`, a path, or `error`, why there is none."""
        async with self._asking:
            return await asyncio.get_running_loop().run_in_executor(None, self._ask, reason)

    def _ask(self, reason: str) -> dict[str, str]:
        if self._connection is None:
            return {"error": "this run keeps no black box"}
        try:
            while self._connection.poll():
                # An answer that nobody waited for any more.
                self._connection.recv()
            self._connection.send({"save": reason})
            if not self._connection.poll(PATIENCE_S):
                return {"error": f"the black box has not answered for {PATIENCE_S:.0f} s"}
            answer: dict[str, str] = self._connection.recv()
        except (EOFError, OSError):
            return {"error": "the black box has ended"}
        return answer
