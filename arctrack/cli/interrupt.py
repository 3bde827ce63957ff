"""Ctrl-C: what was interrupted, what is kept, and where."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class InterruptedCommandError(Exception):
    """A command that Ctrl-C ended; its text says what was interrupted and what is kept."""


@contextmanager
def interruptible(what: str, kept: str) -> Iterator[None]:
    """Say of what runs within, where Ctrl-C ends it, what it was and what is kept."""
    try:
        yield
    except KeyboardInterrupt:
        raise InterruptedCommandError(f"{what} interrupted; {kept}") from None
