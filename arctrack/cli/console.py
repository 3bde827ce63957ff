"""Output common to all commands: warnings, progress, tables."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from datetime import timedelta
from typing import TYPE_CHECKING, Any

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
)
from rich.text import Text

from arctrack.cli.lines import write_line
from arctrack.printable import printable

if TYPE_CHECKING:
    from tracker.warm_up import WarmUp

SPOKEN_EVERY_S = 5.0
"""Period of the lines of progress where no bar can be shown."""


class _Tables(Console):
    """The console for results; it ends the process like `say` where their reader has gone."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def tables() -> Console:
    """Return the console for results, on stdout."""
    console = _Tables(highlight=False)
    # Columns of a table that goes to a file or a pipe, where nobody knows a width.
    return console if console.is_terminal else _Tables(highlight=False, width=160)


def say(*lines: str) -> None:
    """Print lines of the result on stdout; text from a file or a folder's name is made printable.

    It is flushed at once: whoever waits for a live run to be ready may read a pipe, which is written to only
    when its buffer is full.
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
    """Print errors on stderr, one line each; equal ones are printed once."""
    for problem in dict.fromkeys(problems):
        write_line(f"arctrack: error: {printable(problem)}", sys.stderr)


class SpokenProgress(Progress):
    """Progress bars on stderr; where that is no terminal, a plain line every some seconds instead.

    The first of them is there at once. It says how much is compiled, and goes when something else is counted.
    """

    def __init__(self, *columns: ProgressColumn) -> None:
        console = Console(stderr=True)
        super().__init__(*columns, console=console, disable=not console.is_terminal)
        self._is_over = threading.Event()
        self._running = ExitStack()
        self._ready: TaskID | None = None
        self._prefix = ""
        self._compiled: set[str] = set()

    def start(self) -> None:
        """Start the display of the progress and of compilations."""
        super().start()
        self._show("getting ready")
        if self.disable:
            speaker = threading.Thread(target=self._speak, daemon=True)
            speaker.start()
            self._running.callback(speaker.join)
            self._running.callback(self._is_over.set)
        from noise_model.compiled.compiler_events import compiler_events

        self._running.enter_context(compiler_events(self._on_begin, self._on_end))

    def stop(self) -> None:
        """Show no more."""
        self._remove_ready()
        self._running.close()
        super().stop()

    def get_ready(self, name: str) -> None:
        """Announce what follows, such as a joint."""
        self._prefix = f"{name}: "
        self._compiled.clear()
        self._remove_ready()
        self._show("getting ready")

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Change a bar, from now on in sight; once it moves, all is ready."""
        super().update(task_id, visible=True, **changes)
        self.start_task(task_id)
        self._remove_ready()

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Move a bar; all is ready then."""
        super().advance(task_id, advance)
        self._remove_ready()

    def _show(self, what: str, done: int = 0, needed: int | None = None, left_s: float | None = None) -> None:
        text = f"{self._prefix}{what}"
        if self._ready is None:
            self._ready = self.add_task(text, total=None, unit="functions")
        super().update(self._ready, description=text, completed=done, total=needed, left_s=left_s)

    def _remove_ready(self) -> None:
        if self._ready is not None:
            self.remove_task(self._ready)
            self._ready = None

    def _on_begin(self, _function: str) -> None:
        from noise_model.compiled.forecast import running_forecast

        forecast = running_forecast()
        done, needed = (forecast and forecast.counts()) or (len(self._compiled), None)
        self._show("compiling", done, needed, None if forecast is None else forecast.left_s())

    def _on_end(self, function: str) -> None:
        # numba's own functions are of the one that calls them.
        if not function.startswith("numba."):
            self._compiled.add(function)

    def _speak(self) -> None:
        while not self._is_over.wait(SPOKEN_EVERY_S):
            waiting = [task for task in self.tasks if not task.finished]
            # What has not begun is told only while nothing has.
            for task in [task for task in waiting if task.completed] or waiting[:1]:
                print(f"arctrack: {printable(how_far(task))}", file=sys.stderr, flush=True)


def how_far(task: Task) -> str:
    """Return a task in words: its progress, its time so far, and about the time left."""
    done, unit = [task.description], task.fields.get("unit", "")
    if task.total == 1.0:
        done.append(f"{100.0 * task.completed:.0f} %")
    elif task.total is not None:
        done.append(f"{task.completed:.0f} of {task.total:.0f} {unit}".rstrip())
    elif task.completed:
        done.append(f"{task.completed:.0f} {unit}")
    done.append(f"{task.elapsed or 0.0:.0f} s")
    left_s = _left_s(task)
    return ", ".join(done if left_s is None else [*done, f"about {left_s:.0f} s left"])


def _left_s(task: Task) -> float | None:
    """Return the remaining time, s, by earlier runs on this machine, else by the pace so far."""
    before_s: float | None = task.fields.get("left_s")
    return task.time_remaining if before_s is None else before_s


def progress() -> SpokenProgress:
    """Return progress bars with rate and time left, on stderr; each task names what it counts, its `unit`."""
    return SpokenProgress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TextColumn("ETA"),
        _Left(),
        TimeElapsedColumn(),
    )


def track(bar: Progress, name: str, total: int, unit: str = "frames") -> Callable[[int], None]:
    """Return the function that moves a bar over frames, or other units, to a number of them."""
    task = bar.add_task(name, start=False, visible=False, total=total, unit=unit)

    def on_frame(done: int) -> None:
        bar.update(task, completed=done)

    return on_frame


def steps(bar: Progress) -> Callable[[str, str], Callable[[int, int], None]]:
    """Return the function that adds a bar for a step of work, by what is done and what is counted."""

    def begin(what: str, unit: str) -> Callable[[int, int], None]:
        task = bar.add_task(what, start=False, visible=False, total=None, unit=unit)

        def tell(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        return tell

    return begin


def say_compiled(name: str, warm_up: WarmUp) -> None:
    """Print on stderr what a warm-up compiled, where it had to."""
    if warm_up.compiled:
        took = f"compiled {warm_up.compiled} functions in {warm_up.elapsed_s:.0f} s"
        kept = "the next run finds them on disk"
        not_kept = "no folder could keep them; set NUMBA_CACHE_DIR to one that only you may write"
        from noise_model.compiled.store import kernels_are_stored

        print(f"arctrack: {name}: {took}; {kept if kernels_are_stored() else not_kept}", file=sys.stderr)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{'–' if speed is None else f'{speed:.1f}'} {task.fields['unit']}/s")


class _Left(ProgressColumn):
    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        left_s = _left_s(task)
        known = "-:--:--" if left_s is None else str(timedelta(seconds=math.ceil(left_s)))
        return Text(known, style="progress.remaining")
