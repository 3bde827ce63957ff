"""Compiling by two processes, where two cores are free and much is to be compiled.

The process that tracks loads what they keep on disk. It holds no compiler's memory then.
"""

from __future__ import annotations

import multiprocessing
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from queue import Empty, SimpleQueue
from threading import Thread

from arctrack.own_process import OwnProcess, tell
from arctrack.workers import cores_each
from noise_model.compiled.compiler_events import compiler_events, pass_on
from noise_model.compiled.forecast import running_forecast
from noise_model.compiled.store import kernels_are_stored
from noise_model.setup import Setup
from tracker.warm_up import compile_arc, compile_stripe

Part = Callable[[], None]
"""Compiles a part of what some work needs; it is pickled."""

STALLED_S = 120.0
"""A process that has begun or ended no kernel for so long, s, hangs: one takes 2 s, on a slow machine 20."""


@contextmanager
def compiled_by_two(setup: Setup) -> Iterator[None]:
    """Let two processes compile what a warm-up for a setup lacks: the arc's light, and all else."""
    with compiled_by([partial(compile_stripe, setup), partial(compile_arc, setup)]):
        yield


@contextmanager
def compiled_by(parts: Sequence[Part]) -> Iterator[None]:
    """Let a process for each part compile what the work within lacks, once it turns out to lack much.

    What they leave out, for whatever reason, is compiled here.
    """
    # One of several processes on many recordings shares the cores with the others.
    is_alone = multiprocessing.parent_process() is None
    if not is_alone or cores_each(1, None) < len(parts) or not kernels_are_stored():
        yield
        return
    is_decided = False

    def on_begin(_kernel: str) -> None:
        nonlocal is_decided
        forecast = running_forecast()
        if forecast is None or is_decided:
            return
        is_decided = True
        if forecast.lacks_much():
            with forecast.shared_by(len(parts)) as on_end_of_one:
                _compile(parts, on_end_of_one)

    with compiler_events(on_begin, lambda _kernel: None):
        yield


def _compile(parts: Sequence[Part], on_end_of_one: Callable[[], None]) -> None:
    """Wait until processes have compiled the parts, and report meanwhile what they compile."""
    words: SimpleQueue[tuple[bool, str] | None] = SimpleQueue()
    with suppress(OSError, Empty), ExitStack() as opened:
        for part in parts:
            # What they warn of is found here again.
            process = OwnProcess[Part, None](_run, "", stderr=subprocess.DEVNULL)
            opened.enter_context(process).ask([part])
            Thread(target=_listen, args=(process, words), daemon=True).start()
        at_work = len(parts)
        while at_work:
            word = words.get(timeout=STALLED_S)
            if word is None:
                at_work -= 1
                on_end_of_one()
            else:
                pass_on(*word)


def _listen(process: OwnProcess[Part, None], words: SimpleQueue[tuple[bool, str] | None]) -> None:
    """Put what a process says into a queue, and None once it has done its part, or ended without."""
    # What fails there fails here again, where it is told.
    with suppress(Exception):
        process.answers(words.put)
    words.put(None)


def _run(part: Part) -> None:
    """Compile a part, and report what begins (True) and what ends."""
    with compiler_events(lambda kernel: tell((True, kernel)), lambda kernel: tell((False, kernel))):
        part()
