"""What all commands say in the same way: warnings, progress, tables."""

from __future__ import annotations

import sys
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

from arctrack.printable import printable

if TYPE_CHECKING:
    from tracker.warm_up import WarmUp

PLAIN_WIDTH = 160
"""Columns of a table that goes to a file or a pipe, where nobody knows a width."""


def tables() -> Console:
    """Return the console for results, on stdout."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)


def say(*lines: str) -> None:
    """Print lines of the result on stdout; what came from a file or a folder's name is made fit to print."""
    for line in lines:
        print(printable(line))


def warn(messages: Iterable[str]) -> None:
    """Print warnings on stderr, one line each."""
    for message in messages:
        print(f"arctrack: warning: {printable(message)}", file=sys.stderr)


def complain(problems: Iterable[str]) -> None:
    """Print errors on stderr, one line each; what several say alike is said once."""
    for problem in dict.fromkeys(problems):
        print(f"arctrack: error: {printable(problem)}", file=sys.stderr)


def progress() -> Progress:
    """Return a progress bar over frames with rate and time left, on stderr; silent where nobody watches."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TimeElapsedColumn(),
        console=console,
        disable=not console.is_terminal,
    )


def track(bar: Progress, name: str, frames: int) -> Callable[[int], None]:
    """Add a bar over frames and return the function that moves it to a number of them."""
    task = bar.add_task(name, total=frames)
    return lambda done: bar.update(task, completed=done)


def compiling(bar: Progress, name: str) -> Callable[[str, int, float], None]:
    """Return the function that shows what is compiled before the first frame, and how long it has taken."""
    tasks: list[TaskID] = []

    def on_compiled(function: str, n_before: int, elapsed_s: float) -> None:
        if not tasks:
            tasks.append(bar.add_task(f"{name}: compiling", total=None))
        what = f"{name}: compiling {function} ({elapsed_s:.0f} s; the first time takes some 80 s)"
        bar.update(tasks[0], description=what, completed=n_before + 1)

    return on_compiled


def say_compiled(name: str, warm_up: WarmUp) -> None:
    """Say on stderr what a warm-up compiled, where it had to."""
    if warm_up.compiled:
        took = f"compiled {warm_up.compiled} functions in {warm_up.elapsed_s:.0f} s"
        print(f"arctrack: {name}: {took}; the next run finds them on disk", file=sys.stderr)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("– frames/s" if speed is None else f"{speed:.1f} frames/s")
