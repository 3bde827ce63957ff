"""The clock of a device that stamps its frames, on the host's."""

import math
from collections import deque

WINDOW_S = 5.0
"""Over so long the least delay is sought, s: clocks that differ by 50 ppm part by 0.25 ms meanwhile."""


class DeviceClock:
    """Map from a device's time stamps to the host's clock, by the least delayed frames.

    A frame arrives at t = s + o + d: s its stamp, o the offset of the clocks, d >= 0 how long it was on its
    way. The least of t - s over a window is o and the shortest way: the usual filter of the smallest delay
    (Mills 2010, Computer Network Time Synchronization, sec. 3.6). Of n exponential delays beyond the shortest
    with mean m the least one has mean and standard deviation m / n.

    `sigma_s` is 1 sigma of the offset from variable delays; infinite before the second stamp. It does not
    include the shortest transit time itself, nor drift within the window.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque()
        self.sigma_s = math.inf

    def host_s(self, stamp_s: float, arrived_s: float) -> float:
        """Take a stamp and when it arrived, s, and return the stamp on the host's clock, s."""
        apart_s = arrived_s - stamp_s
        self._seen.append((arrived_s, apart_s))
        while arrived_s - self._seen[0][0] > WINDOW_S:
            self._seen.popleft()
        min_s = min(apart for _, apart in self._seen)
        if len(self._seen) > 1:
            excess_s = sum(apart - min_s for _, apart in self._seen) / (len(self._seen) - 1)
            self.sigma_s = excess_s / len(self._seen)
        return stamp_s + min_s
