"""Event scheduler with one clock: events in order of time, the same for the same seed."""

import heapq
from collections.abc import Callable

Action = Callable[[], None]


class Scheduler:
    """Event queue by time; `now_s` is the time of the running action."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._heap: list[tuple[float, int, Action]] = []
        self._count = 0

    def at(self, time_s: float, action: Action) -> None:
        """Let something happen at a time, s; at once, where that is over. Of one time, in order of asking."""
        heapq.heappush(self._heap, (max(time_s, self.now_s), self._count, action))
        self._count += 1

    def every(self, period_s: float, action: Action, first_s: float = 0.0) -> None:
        """Let something happen again and again, s."""
        times = iter(range(1, 1 << 62))

        def again() -> None:
            action()
            self.at(first_s + next(times) * period_s, again)

        self.at(first_s, again)

    def run(self, until_s: float) -> None:
        """Do all that is due until a time, s."""
        while self._heap and self._heap[0][0] <= until_s:
            self.now_s, _, action = heapq.heappop(self._heap)
            action()
        self.now_s = until_s
