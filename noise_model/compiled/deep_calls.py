"""Settings of Python for quick compilation: stack chunks for deep calls, and rare garbage collection.

Python keeps the frames of its calls in chunks of 16 kB. A call for which a chunk has no room left takes
another one from the operating system, and its return gives that back. numba compiles a kernel within the one
that calls it, hundreds of calls deep. Short calls from where a chunk ended, a million of them, took a fifth
of the CPU time of compiling. Another fifth went to Python's garbage collector: numba makes millions of
objects, and nearly all stay in use.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")

ROOM = 1 << 17
"""Objects the frame asks room for. Its chunk is twice as large, and calls within it use the rest."""

RARELY = (50_000, 4, 4)
"""Thresholds of `gc` while a kernel compiles. Rarer still saves no time, and takes a fifth more memory."""


def call_with_room(function: Callable[..., Result], *arguments: object) -> Result:
    """Return what a function returns that makes many objects, and calls others hundreds of levels deep."""
    before = gc.get_threshold()
    gc.set_threshold(*RARELY)
    try:
        return function(*arguments)
    finally:
        gc.set_threshold(*before)


# Python takes a chunk of the next power of two. What nobody writes to costs no memory.
call_with_room.__code__ = call_with_room.__code__.replace(co_stacksize=ROOM)
