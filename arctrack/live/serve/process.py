"""The process of a live run: how it is scheduled, its memory, its garbage, and its watchdog."""

import faulthandler
import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from arctrack.control.cell_file import ProcessChoice
from arctrack.system import choose_priority, choose_processors, lock_memory, processors


def schedule(choice: ProcessChoice) -> tuple[list[str], list[str]]:
    """Schedule this process as a cell file says.

    Returns what was set, and what the machine does not allow with its cure, one line each.
    """
    done: list[str] = []
    refused: list[str] = []

    def attempt(what: str, cure: str, action: Callable[[], None]) -> None:
        try:
            action()
        except OSError as error:
            refused.append(f"[process] {what}: {error.strerror}; {cure}")
        else:
            done.append(f"[process] {what}: set")

    cpus, priority = choice.cpus, choice.priority
    if cpus is not None:
        there = f"this machine lets it choose of {processors()}"
        attempt(f"cpus = {list(cpus)}", there, lambda: choose_processors(cpus))
    if priority is not None:
        attempt(
            f"priority = {priority}",
            "give the user an rtprio in /etc/security/limits.conf",
            lambda: choose_priority(priority),
        )
    if choice.lock_memory:
        attempt("lock_memory = true", "give the user a memlock in /etc/security/limits.conf", lock_memory)
    return done, refused


@contextmanager
def garbage_left() -> Iterator[None]:
    """Collect no garbage meanwhile: what is there stays, and a collection would hold a frame up."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


class Watchdog:
    """Watchdog that ends this process, with a stack trace, once it is not fed for `limit_s`.

    It is a C thread of the interpreter, so it fires even where Python's threads hang. The robot's time-outs
    end what was VALID, and the laser goes off by itself.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._fed_s = float("-inf")

    def __enter__(self) -> "Watchdog":
        self.feed()
        return self

    def __exit__(self, *_exception: object) -> None:
        faulthandler.cancel_dump_traceback_later()

    def feed(self) -> None:
        """Reset the watchdog."""
        now_s = time.monotonic()
        # Each takes a tenth of a millisecond.
        if now_s - self._fed_s > 0.1:
            self._fed_s = now_s
            # The stream of errors itself, whatever Python writes to instead.
            faulthandler.dump_traceback_later(self._limit_s, exit=True, file=2)
