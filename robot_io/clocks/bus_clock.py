"""Conversion from an adapter's own clock, which counts from its start, to the wall clock."""

import math

WINDOW_S = 10.0
"""The clocks are compared over one to two of these: in that time they drift apart by a millisecond or two."""


class BusClock:
    """Converter of frame times in seconds since some start to wall-clock times.

    Of the frames of the last seconds the one that was read with the least delay determines the clocks'
    offset. So a frame that waited to be read keeps its own time.
    """

    def __init__(self) -> None:
        self._newest_s = self._since_s = -math.inf
        self._apart_before_s = self._apart_s = math.inf

    def wall_s(self, timestamp_s: float, read_at_s: float) -> float:
        """Return a frame's Unix time, s; `read_at_s` is that of its reading, of which none can be later."""
        # Frames out of order go back by less than a second; a restarted clock by more.
        if timestamp_s < self._newest_s - 1.0:
            self._newest_s = timestamp_s
            self._since_s = read_at_s
            self._apart_before_s = self._apart_s = math.inf
        self._newest_s = max(self._newest_s, timestamp_s)
        window_age_s = read_at_s - self._since_s
        if not 0.0 <= window_age_s < WINDOW_S:
            self._apart_before_s = self._apart_s if 0.0 <= window_age_s < 2.0 * WINDOW_S else math.inf
            self._apart_s, self._since_s = math.inf, read_at_s
        self._apart_s = min(self._apart_s, read_at_s - timestamp_s)
        return timestamp_s + min(self._apart_before_s, self._apart_s)
