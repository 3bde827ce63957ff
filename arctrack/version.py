"""The version of the installed distribution."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def _installed() -> str:
    try:
        return version("arctrack")
    except PackageNotFoundError:
        return "unknown"


__version__ = _installed()
"""The installed version; `unknown` where arctrack runs from a bare tree."""
