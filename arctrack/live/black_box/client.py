"""Requests to a run's black box to save what it has."""

from arctrack.live.journal.message_pipe import PipeClient, PipeEnd


class BlackBoxClient:
    """Client of the black box process; never blocks.

    A request made while a recording is being saved is dropped: a queued one would be answered long after.
    """

    def __init__(self, end: PipeEnd) -> None:
        self._client = PipeClient(end)
        self._lines: list[str] = []

    def save(self, reason: str) -> None:
        """Request that the latest frames be saved, unless that is under way."""
        self._collect(0.0)
        self._client.ask({"save": reason})

    def answers(self, wait_s: float = 0.0) -> list[str]:
        """Return a line for each answer that was not returned yet; one may come within a time, s."""
        self._collect(wait_s)
        lines, self._lines = self._lines, []
        return lines

    def _collect(self, wait_s: float) -> None:
        answer = self._client.answer(wait_s)
        if answer is not None:
            result = f"saved {answer['saved']}" if "saved" in answer else answer["error"]
            self._lines.append(f"black box: {result}")
