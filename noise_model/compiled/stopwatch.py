"""CPU time that a kernel takes to compile, without those that are compiled for it meanwhile."""

from __future__ import annotations

from time import thread_time

from numba.core import event


class _Stopwatch(event.Listener):  # type: ignore[misc]
    """Timer of each compilation; numba's own functions within a kernel count as the kernel's."""

    def __init__(self) -> None:
        # When each began that runs now, and how long the kernels within it took, s.
        self._running: list[list[float]] = []
        self.last_s = 0.0

    def on_start(self, _event: event.Event) -> None:
        self._running.append([thread_time(), 0.0])

    def on_end(self, event: event.Event) -> None:
        began_s, others_s = self._running.pop()
        elapsed_s = thread_time() - began_s
        self.last_s = elapsed_s - others_s
        if self._running:
            is_numbas = event.data["dispatcher"].py_func.__module__.startswith("numba.")
            self._running[-1][1] += others_s if is_numbas else elapsed_s


_STOPWATCH = _Stopwatch()
event.register("numba:compile", _STOPWATCH)


def last_compile_s() -> float:
    """Return the CPU time that what was compiled last took, s."""
    return _STOPWATCH.last_s
