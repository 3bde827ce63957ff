"""The benchmark's work on many scenes at once: drawn, and read by every method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import cv2

from arctrack.cli import console
from arctrack.workers import processes
from validation.bench.methods import Method, method_named
from validation.bench.rivals import METHODS
from validation.bench.scenes import drawn, read_scene, write_scene
from validation.bench.score import FrameScore, scored


def write(out: Path, which: tuple[str, int]) -> None:
    """Draw a scene of a set, by its seed, and write it."""
    write_scene(drawn(*which), out)


def judged(names: Sequence[str], path: Path) -> dict[str, list[FrameScore]]:
    """Return each method's scores of a scene; cv2 has one thread, as all have."""
    cv2.setNumThreads(1)
    scene = read_scene(path)
    return {name: scored(method_of(name), scene, needs_start="Kalman" in name) for name in names}


def method_of(name: str) -> Method:
    """Return a method of the table, or a stranger's."""
    return METHODS[name]() if name in METHODS else method_named(name)


Thing = TypeVar("Thing")
Made = TypeVar("Made")


def all_of(work: Callable[[Thing], Made], things: Sequence[Thing], workers: int, what: str) -> list[Made]:
    """Return what becomes of each thing, in their order, with progress."""
    with console.progress() as bar:
        on_done = console.track(bar, "bench", max(len(things), 1), what)
        with processes(workers) as executor:
            futures = [executor.submit(work, thing) for thing in things]
            results = []
            for n, future in enumerate(futures):
                results.append(future.result())
                on_done(n + 1)
    return results
