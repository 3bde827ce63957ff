"""What numba compiles in this process, told as it happens."""

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
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)


class _Listener(event.Listener):  # type: ignore[misc]
    def __init__(self, on_begin: Callable[[str], None], on_end: Callable[[str], None]) -> None:
        self._on_begin, self._on_end = on_begin, on_end

    def on_start(self, compilation: event.Event) -> None:
        self._on_begin(_name(compilation))

    def on_end(self, compilation: event.Event) -> None:
        self._on_end(_name(compilation))


def _name(compilation: Any) -> str:
    function = compilation.data["dispatcher"].py_func
    return f"{function.__module__}.{function.__qualname__}"
