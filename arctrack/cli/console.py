"""What all commands say in the same way: warnings, progress, tables."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from arctrack.cli.lines import write_line
from arctrack.printable import printable

if TYPE_CHECKING:
    from tracker.warm_up import WarmUp

SPOKEN_EVERY_S = 5.0
"""So often a line says how far it is where no bar can be shown."""

COMPILED = "functions"
"""The unit of what is compiled."""

PLAIN_WIDTH = 160
"""Columns of a table that goes to a file or a pipe, where nobody knows a width."""


class _Tables(Console):
    """The console for results; it ends the process like `say` where their reader has gone."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def tables() -> Console:
    """Return the console for results, on stdout."""
    console = _Tables(highlight=False)
    return console if console.is_terminal else _Tables(highlight=False, width=PLAIN_WIDTH)


def say(*lines: str) -> None:
    """Print lines of the result on stdout; what came from a file or a folder's name is made fit to print.

    At once: whoever waits for a live run to be ready may read a pipe, which is written to once much is said.
    """
    for line in lines:
        write_line(printable(line), sys.stdout)


def warn(messages: Iterable[str]) -> None:
    """Print warnings on stderr, one line each."""
    for message in messages:
        write_line(warning_line(message), sys.stderr)


def warning_line(message: str) -> str:
    """Return a warning as it is printed."""
    return f"arctrack: warning: {printable(message)}"


def complain(problems: Iterable[str]) -> None:
    """Print errors on stderr, one line each; what several say alike is said once."""
    for problem in dict.fromkeys(problems):
        write_line(f"arctrack: error: {printable(problem)}", sys.stderr)


class SpokenProgress(Progress):
    """Progress bars on stderr; where that is no terminal, a plain line every some seconds instead."""

    def __init__(self, *columns: ProgressColumn) -> None:
        console = Console(stderr=True)
        super().__init__(*columns, console=console, disable=not console.is_terminal)
        self._is_over = threading.Event()
        self._speaker: threading.Thread | None = None

    def start(self) -> None:
        """Begin to show how far it is."""
        super().start()
        if self.disable and self._speaker is None:
            self._is_over.clear()
            self._speaker = threading.Thread(target=self._speak, daemon=True)
            self._speaker.start()

    def stop(self) -> None:
        """Show no more."""
        super().stop()
        self._is_over.set()
        if self._speaker is not None:
            self._speaker.join()
            self._speaker = None

    def _speak(self) -> None:
        while not self._is_over.wait(SPOKEN_EVERY_S):
            waiting = [task for task in self.tasks if not task.finished]
            # What has not begun is told only while nothing has.
            for task in [task for task in waiting if task.completed] or waiting[:1]:
                print(f"arctrack: {printable(how_far(task))}", file=sys.stderr, flush=True)


def how_far(task: Task) -> str:
    """Return in words what is done, how far, and how long it has taken."""
    elapsed_s = task.elapsed or 0.0
    if task.total is None:
        return f"{task.description}, {elapsed_s:.0f} s"
    if task.total == 1.0:
        return f"{task.description}, {100.0 * task.completed:.0f} %, {elapsed_s:.0f} s"
    return f"{task.description}, {task.completed:.0f} of {task.total:.0f}, {elapsed_s:.0f} s"


def progress() -> SpokenProgress:
    """Return progress bars with rate and time left, on stderr; each task names what it counts, its `unit`."""
    return SpokenProgress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TimeElapsedColumn(),
    )


def track(bar: Progress, name: str, total: int, unit: str = "frames") -> Callable[[int], None]:
    """Add a bar over frames, or other units, and return the function that moves it to a number of them."""
    task = bar.add_task(name, total=total, unit=unit)

    def on_frame(done: int) -> None:
        _remove_compiling(bar)
        bar.update(task, completed=done)

    return on_frame


def steps(bar: Progress) -> Callable[[str, str], Callable[[int, int], None]]:
    """Return the function that adds a bar for a step of work, by what is done and what is counted."""

    def begin(what: str, unit: str) -> Callable[[int, int], None]:
        task = bar.add_task(what, total=None, unit=unit)

        def tell(done: int, total: int) -> None:
            _remove_compiling(bar)
            bar.update(task, completed=done, total=total)

        return tell

    return begin


def _remove_compiling(bar: Progress) -> None:
    """Remove the bar of what is compiled: that is done before anything else is counted."""
    for task in bar.tasks:
        if task.fields["unit"] == COMPILED:
            bar.remove_task(task.id)


def compiling(bar: Progress, name: str) -> Callable[[str, int, float, float | None], None]:
    """Return the function that shows what is compiled before the first frame, and how long it takes yet."""
    tasks: list[TaskID] = []

    def on_compiled(function: str, n_before: int, elapsed_s: float, left_s: float | None = None) -> None:
        # A bar that was removed is over, but what comes late is compiled all the same.
        if not tasks or tasks[-1] not in bar.task_ids:
            tasks.append(bar.add_task(f"{name}: compiling", total=None, unit=COMPILED))
        if not function.startswith("numba."):
            until_ready = "the first time on this machine" if left_s is None else f"about {left_s:.0f} s left"
            bar.update(tasks[-1], description=f"{name}: compiling {function} ({until_ready})")
        bar.update(tasks[-1], completed=n_before + 1)

    return on_compiled


def say_compiled(name: str, warm_up: WarmUp) -> None:
    """Say on stderr what a warm-up compiled, where it had to."""
    if warm_up.compiled:
        from noise_model.compiled.store import kernels_are_kept

        took = f"compiled {warm_up.compiled} functions in {warm_up.elapsed_s:.0f} s"
        kept = "the next run finds them on disk"
        not_kept = "no folder could keep them; set NUMBA_CACHE_DIR to one that only you may write"
        print(f"arctrack: {name}: {took}; {kept if kernels_are_kept() else not_kept}", file=sys.stderr)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{'–' if speed is None else f'{speed:.1f}'} {task.fields['unit']}/s")
