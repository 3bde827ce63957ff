"""How long compiling takes yet: what the same work needed before on this machine, and lacks now."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from typing import Any

from numba.extending import is_jitted

from noise_model.compiled.content import find_kernel, is_named
from noise_model.compiled.numba_internals import KernelCache
from noise_model.compiled.packed import find_records, is_found
from noise_model.compiled.store import Record, is_kept, read_records, write_record


class Forecast:
    """The time that some work needs for compiling, by what it needed on this machine before.

    Parameters
    ----------
    work : str
        What is to be done, such as a type of joint to be tracked.
    """

    def __init__(self, work: str) -> None:
        self._work = work
        self._left_s: dict[str, float] | None = None

    def left_s(self) -> float | None:
        """Return how long it takes yet, s; None where this machine has never done this work."""
        if self._left_s is None and is_kept("work", self._work):
            self._left_s = {}
            for kernel, compile_s in self._missing():
                self._left_s[kernel] = self._left_s.get(kernel, 0.0) + compile_s
        return None if self._left_s is None else sum(self._left_s.values())

    def note_compiled(self, kernel: str) -> None:
        """Hear that a kernel is compiled."""
        if self._left_s is not None:
            self._left_s.pop(kernel, None)

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


def kernels_in_use() -> list[Any]:
    """Return the kernels that are compiled for some types in this process."""
    values = [value for module in list(sys.modules.values()) for value in list(vars(module).values())]
    kernels = {id(value): value for value in values if is_jitted(value) and value.overloads}
    return [k for k in kernels.values() if isinstance(k._cache, KernelCache) and is_named(k)]
