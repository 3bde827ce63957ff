"""Compiling by two processes, where two cores are free and much is to be compiled.

The process that tracks loads what they keep on disk. It holds no compiler's memory then.
"""

from __future__ import annotations

import multiprocessing
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection, wait

from arctrack.child_process import ChildProcess, is_child
from arctrack.errors import ArctrackError
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
    is_alone = not is_child() and multiprocessing.parent_process() is None
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
    with suppress(OSError), ExitStack() as opened:
        # What they warn of, and what fails in them, is found here again.
        ended, quiet = ArctrackError(""), subprocess.DEVNULL
        started = [
            opened.enter_context(ChildProcess(_run, (part,), ended=ended, stderr=quiet)) for part in parts
        ]
        at_work = {process.connection: process for process in started}
        while at_work and (ready := wait(at_work, STALLED_S)):
            for connection in ready:
                assert isinstance(connection, Connection)
                try:
                    pass_on(*at_work[connection].receive())
                except ArctrackError:
                    del at_work[connection]
                    on_end_of_one()


def _run(part: Part, parent: Connection) -> None:
    """Compile a part, and report what begins (True) and what ends."""
    with compiler_events(
        lambda kernel: parent.send((True, kernel)), lambda kernel: parent.send((False, kernel))
    ):
        part()
