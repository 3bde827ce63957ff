"""Listeners to numba's compilations in this process, or in another one for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


@contextmanager
def compiler_events(on_begin: Callable[[str], None], on_end: Callable[[str], None]) -> Iterator[None]:
    """Pass on the name of each function compiled within the block, at its begin and end."""
    listener = _Listener(on_begin, on_end)
    event.register("numba:compile", listener)
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)
        event.unregister("numba:compile", listener)


def pass_on(is_begin: bool, name: str) -> None:
    """Report a function that another process compiles for this one, at its begin or end."""
    for listener in tuple(_LISTENERS):
        (listener.begin if is_begin else listener.end)(name)


class _Listener(event.Listener):  # type: ignore[misc]
    def __init__(self, on_begin: Callable[[str], None], on_end: Callable[[str], None]) -> None:
        self.begin, self.end = on_begin, on_end

    def on_start(self, compilation: event.Event) -> None:
        self.begin(_name(compilation))

    def on_end(self, compilation: event.Event) -> None:
        self.end(_name(compilation))


_LISTENERS: list[_Listener] = []


def _name(compilation: Any) -> str:
    function = compilation.data["dispatcher"].py_func
    return f"{function.__module__}.{function.__qualname__}"
