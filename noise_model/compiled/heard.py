"""What numba compiles in this process, or another one for it, told as it happens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


@contextmanager
def heard(on_begin: Callable[[str], None], on_end: Callable[[str], None]) -> Iterator[None]:
    """Tell the name of each function that is compiled meanwhile, as it begins and as it ends."""
    listener = _Listener(on_begin, on_end)
    event.register("numba:compile", listener)
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)
        event.unregister("numba:compile", listener)


def pass_on(is_begin: bool, name: str) -> None:
    """Tell of a function that another process compiles for this one, as it begins or ends."""
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
