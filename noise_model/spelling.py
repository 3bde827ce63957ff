"""Suggestion for an unknown name: which of the known ones was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that is nearest to one, None if none is near."""
    plain = {_plain(candidate): candidate for candidate in known}
    # `difflib`'s ratio from which on two names are near to each other: 1 if they are the same.
    near = difflib.get_close_matches(_plain(name), plain, n=1, cutoff=0.6)
    return plain[near[0]] if near else None


def cure_for(name: str, known: Iterable[str]) -> str:
    """Return the cure of an unknown name: `did you mean 'x'?`, or the names that there are."""
    names = tuple(known)
    near = nearest(name, names)
    return f"there are {', '.join(names)}" if near is None else f"did you mean {near!r}?"


def _plain(name: str) -> str:
    return "_".join(name.lower().replace("-", " ").split())
