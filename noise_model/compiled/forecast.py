"""Remaining time of compilation: by what the same work needed before, and lacks now."""

from __future__ import annotations

import pickle
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any

from numba.extending import is_jitted

from noise_model.compiled.content import find_kernel, is_named
from noise_model.compiled.numba_internals import KernelCache
from noise_model.compiled.packed import compile_costs, find_records, is_found, pack_serves
from noise_model.compiled.store import Record, is_stored, read_records, write_record

MUCH_S = 10.0
"""CPU time of compilation from which two processes are faster: they take 3 s to start and to load."""


class Forecast:
    """Progress of some work's compilation, such as of a joint type, and the remaining time.

    It is known from what the work needed before on this machine. Where it was never done here, the last
    release states the machine code's size of each kernel, and the pace so far gives the time.
    """

    def __init__(self, work: str) -> None:
        self._work = work
        # What each kernel costs that must be compiled: s, or bytes of machine code where `_began_s` is known.
        self._costs: dict[str, float] | None = None
        self._left: dict[str, float] = {}
        self._began_s: float | None = None
        self._is_known = False
        self._processes = 1

    def left_s(self) -> float | None:
        """Return the remaining time, s; None where it is unknown."""
        costs, missing = self._looked_up(), sum(self._left.values())
        if self._began_s is None:
            return missing / self._processes if self._is_known else None
        done = sum(costs.values()) - missing
        return missing * (time.perf_counter() - self._began_s) / done if done else None

    def lacks_much(self) -> bool:
        """Return True if compiling takes so long that it is worth the start of processes for it.

        Where this machine does not know, it lacks much if nothing was compiled here before, and nothing came
        with arctrack.
        """
        self._looked_up()
        if self._is_known:
            return sum(self._left.values()) >= MUCH_S
        return not is_stored("work", "") and not pack_serves()

    @contextmanager
    def shared_by(self, processes: int) -> Iterator[Callable[[], None]]:
        """Count with `processes` that compile at once; yield the callback for the end of one."""
        self._processes = processes

        def on_end() -> None:
            self._processes = max(1, self._processes - 1)

        try:
            yield on_end
        finally:
            self._processes = 1

    def counts(self) -> tuple[int, int] | None:
        """Return the numbers of kernels compiled and in all; None where they are unknown."""
        costs = self._looked_up()
        return (len(costs) - len(self._left), len(costs)) if costs else None

    def _looked_up(self) -> dict[str, float]:
        """Return the costs, those that this machine knows if it does."""
        if self._costs is None:
            self._costs, self._is_known = {}, is_stored("work", self._work)
            if self._is_known:
                for kernel, compile_s in self._missing():
                    self._costs[kernel] = self._costs.get(kernel, 0.0) + compile_s
            elif costs := compile_costs(self._work):
                # Of another work that was done here: what is kept of a kernel serves this one too.
                self._costs = {kernel: cost for kernel, cost in costs.items() if not is_stored(kernel, "")}
                self._began_s = time.perf_counter()
            self._left = dict(self._costs)
        return self._costs

    @contextmanager
    def running(self) -> Iterator[None]:
        """Be the forecast of what this process compiles, meanwhile."""
        _RUNNING.append(self)
        try:
            yield
        finally:
            _RUNNING.remove(self)

    def note_compiled(self, kernel: str) -> None:
        """Note that a kernel is compiled."""
        self._left.pop(kernel, None)

    def keep(self) -> None:
        """Keep which kernels this process has used, for which types, and how long each took to compile."""
        noted = []
        for kernel in kernels_in_use():
            for arguments, result in kernel.overloads.items():
                key = kernel._cache._key(arguments, result.target_context)
                compile_s = [record.compile_s for record in find_records(kernel._cache.name, key)][:1]
                # Each by itself: an update may move the class of an argument.
                asked = pickle.dumps((kernel.py_func.__module__, kernel.py_func.__qualname__, arguments))
                noted.append((asked, sum(compile_s)))
        write_record("work", self._work, Record((), 0.0, pickle.dumps(noted)))

    def _missing(self) -> Iterator[tuple[str, float]]:
        """Yield the kernels that must be compiled, and how long each took before, s."""
        for record in read_records("work", self._work):
            for asked, compile_s in pickle.loads(record.body):
                with suppress(Exception):
                    module, name, arguments = pickle.loads(asked)
                    import_module(module)
                    kernel = find_kernel(module, name)
                    if not is_found(kernel._cache.name, kernel._cache._key(arguments, kernel.targetctx)):
                        yield kernel._cache.name, compile_s


_RUNNING: list[Forecast] = []


def running_forecast() -> Forecast | None:
    """Return the forecast of what this process compiles now, None where there is none."""
    return _RUNNING[-1] if _RUNNING else None


def kernels_in_use() -> list[Any]:
    """Return the kernels that are compiled for some types in this process."""
    values = [value for module in list(sys.modules.values()) for value in list(vars(module).values())]
    kernels = {id(value): value for value in values if is_jitted(value) and value.overloads}
    return [k for k in kernels.values() if isinstance(k._cache, KernelCache) and is_named(k)]
