"""The process whose steps latency.py times. It knows public names alone, so that other revisions run it too.

    python latency_worker.py CASE STARTED_S

CASE is a folder of `latency_cases.draw_case`, STARTED_S the monotonic clock when the process was asked for.
The first line of output says how long the process took to be ready, and how long its first frames took. Then
each line of input, a situation and the number of a stretch, is answered by a line with the times of a block.
"""

from __future__ import annotations

import copy
import gc
import itertools
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

APPROACH, STRETCHES, STRETCH = 48, 4, 25
"""So many frames show the seam once, along the whole way, then so many stretches of so many frames."""

PERIOD_S, SPIN_S = 0.005, 0.0005
"""A frame comes every so often. The loop sleeps until so shortly before, then spins, as a live run's does."""

EXPOSURE_S, CURRENT_A = 0.005, 100.0

COLD_MB = 64
"""So much other memory is written to between two steps, where caches are to be cold."""

UNCOUNTED = 3
"""The first steps of a block are not counted: another revision's block may have been before it."""

TRACK, COLD, SEARCH = "track", "cold", "search"


def main() -> None:
    folder, started_s = Path(sys.argv[1]), float(sys.argv[2])
    from arctrack import Tracker, read_setup_file

    times_s = [started_s, time.monotonic()]
    tracker = Tracker(read_setup_file(folder / "recording.toml").setup)
    times_s.append(time.monotonic())
    compiled = tracker.warm_up().compiled
    times_s.append(time.monotonic())
    worker = Worker(tracker, folder)
    spent_s = [later - earlier for earlier, later in itertools.pairwise(times_s)]
    first_ms = [worker.timed(n)[0] for n in range(2)]
    say({"spent_s": spent_s, "compiled": compiled, "first_ms": first_ms})
    for n, line in enumerate(sys.stdin):
        if n == 0:
            worker.settle()
        situation, stretch = json.loads(line)
        say(worker.block(situation, stretch))


def say(answer: dict[str, Any]) -> None:
    print(json.dumps(answer), flush=True)


class Worker:
    """A tracker that is ready, and a case's frames."""

    def __init__(self, tracker: Any, folder: Path) -> None:
        import numpy as np

        self.tracker, self.fresh = tracker, copy.deepcopy(tracker.state)
        self.images, self.poses = (np.load(folder / f"{name}.npy") for name in ("images", "poses"))
        self.other = np.zeros(COLD_MB * 1_000_000 // 8)
        self.taken = 0

    def timed(self, n: int) -> tuple[float, float, bool]:
        """Track a frame; return wall and CPU time of the step, ms, and whether its track is valid."""
        from arctrack import Frame, Pose

        frame = Frame(self.taken, PERIOD_S * self.taken, self.images[n], EXPOSURE_S, CURRENT_A)
        pose = Pose(self.poses[n])
        self.taken += 1
        wall_s, cpu_s = time.perf_counter(), time.thread_time()
        track = self.tracker.step(frame, pose)
        cpu_s = time.thread_time() - cpu_s
        return 1e3 * (time.perf_counter() - wall_s), 1e3 * cpu_s, bool(track.valid)

    def settle(self) -> None:
        """See the seam along the whole way once, then collect no more garbage, as a live run does not."""
        for n in range(APPROACH):
            self.timed(n)
        gc.collect()
        gc.freeze()
        gc.disable()

    def block(self, situation: str, stretch: int) -> dict[str, list[float]]:
        """Take a stretch to and fro, a frame a tick; return wall and CPU times, ms, and which are valid."""
        known = self.tracker.state
        before: Callable[[], None] | None = {SEARCH: self._forget, COLD: self._write_to_others}.get(situation)
        rows, tick_s = [], time.perf_counter()
        first = APPROACH + stretch * STRETCH
        for n in [*range(STRETCH), *range(STRETCH - 1, -1, -1)]:
            if before is not None:
                before()
            tick_s = wait_for_tick(tick_s + PERIOD_S)
            rows.append(self.timed(first + n))
        if situation == SEARCH:
            self.tracker.state = known
        columns = map(list, zip(*rows[UNCOUNTED:], strict=True))
        return dict(zip(("wall_ms", "cpu_ms", "valid"), columns, strict=True))

    def _forget(self) -> None:
        self.tracker.state = copy.deepcopy(self.fresh)

    def _write_to_others(self) -> None:
        self.other += 1.0


def wait_for_tick(tick_s: float) -> float:
    """Wait for a tick of the clock, or for the next if it is past; return the tick's time, s."""
    late_s = time.perf_counter() - tick_s
    if late_s > 0.0:
        tick_s += PERIOD_S * math.ceil(late_s / PERIOD_S)
    time.sleep(max(tick_s - time.perf_counter() - SPIN_S, 0.0))
    while time.perf_counter() < tick_s:
        pass
    return tick_s


if __name__ == "__main__":
    main()
