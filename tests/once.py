"""What is dear and several tests need is made once in a run of pytest, by whichever worker is first."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numba.core.event as numba_events


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
def compiling_in_turn(lock: Path) -> Iterator[None]:
    """Let one process at a time compile: what another needs next, it finds on disk.

    numba says that it compiles before it looks for a function on disk, and that it has done so after it has
    kept the function there.
    """
    with lock.open("w") as file, numba_events.install_listener("numba:compiler_lock", _Turn(file.fileno())):
        yield


class _Turn(numba_events.Listener):
    """Holds the lock of a file from the outermost start of an event to its end."""

    def __init__(self, file: int) -> None:
        self._file = file
        self._depth = 0

    def on_start(self, event: numba_events.Event) -> None:
        self._depth += 1
        if self._depth == 1:
            fcntl.flock(self._file, fcntl.LOCK_EX)

    def on_end(self, event: numba_events.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            fcntl.flock(self._file, fcntl.LOCK_UN)
