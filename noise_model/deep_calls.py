"""Room for calls that go deep, taken once: else Python takes and gives back memory at some calls, each time.

Python keeps the frames of its calls in chunks of 16 kB. A call for which a chunk has no room left takes
another one from the operating system, and its return gives that back. numba compiles a kernel within the one
that calls it, hundreds of calls deep. Short calls from where a chunk ended, a million of them, took a fifth
of the CPU time of compiling.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")

ROOM = 1 << 17
"""How many objects the frame asks room for. Its chunk is twice as large, and calls within it use the rest."""


def call_with_room(function: Callable[..., Result], *arguments: object) -> Result:
    """Return what a function returns that calls others, which call others, hundreds of levels deep."""
    return function(*arguments)


# Python takes a chunk of the next power of two. What nobody writes to costs no memory.
call_with_room.__code__ = call_with_room.__code__.replace(co_stacksize=ROOM)
