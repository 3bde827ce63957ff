"""What is dear and several tests need is made once in a run of pytest, by whichever worker is first."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numba.core.event as numba_events
import pytest

from noise_model.compiled.numba_internals import KernelCache


def once(shared: Path, name: str, make: Callable[[Path], None]) -> Path:
    """Return the folder `name` of `shared`, which `make` fills the first time; others wait meanwhile.

    What fails leaves nothing behind: the next one that needs it tries again.
    """
    made, unfinished = shared / name, shared / f"{name}.unfinished"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            shutil.rmtree(unfinished, ignore_errors=True)
            unfinished.mkdir()
            make(unfinished)
            unfinished.rename(made)
    return made


@contextmanager
def compiling_in_turn(folder: Path) -> Iterator[None]:
    """Let one process at a time compile a kernel: another that needs it waits, and finds it on disk.

    Meanwhile others compile other kernels. Kernels call each other in one direction only: so no two processes
    wait for each other. A kernel's lock is held from where it is not on disk until it is kept there.
    """
    folder.mkdir(exist_ok=True)
    load, save = KernelCache.load_overload, KernelCache.save_overload
    held: dict[KernelCache, TextIO] = {}

    def load_in_turn(cache: KernelCache, signature: Any, context: Any) -> Any:
        found = load(cache, signature, context)
        if found is None and cache not in held:
            held[cache] = (folder / cache.name).open("w")
            fcntl.flock(held[cache], fcntl.LOCK_EX)
            found = load(cache, signature, context)
            if found is not None:
                held.pop(cache).close()
        return found

    def save_in_turn(cache: KernelCache, signature: Any, compiled: Any) -> None:
        save(cache, signature, compiled)
        if cache in held:
            held.pop(cache).close()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(KernelCache, "load_overload", load_in_turn)
        patch.setattr(KernelCache, "save_overload", save_in_turn)
        with numba_events.install_listener("numba:compiler_lock", _Release(held)):
            yield


class _Release(numba_events.Listener):
    """Releases what is held of kernels that could not be compiled, once a process compiles nothing more."""

    def __init__(self, held: dict[KernelCache, TextIO]) -> None:
        self._held = held
        self._depth = 0

    def on_start(self, event: numba_events.Event) -> None:
        self._depth += 1

    def on_end(self, event: numba_events.Event) -> None:
        self._depth -= 1
        while self._depth == 0 and self._held:
            self._held.popitem()[1].close()
