"""TOML parsed within limits: a file may nest its tables so deep that no program bears it."""

import re
import tomllib
from typing import Any

from arctrack.limits import LIMITS

_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_DEEP_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*\.[ \t]*{_PART}){{{LIMITS.toml_depth}}}")
"""A key of more parts than tables may be deep: a parser takes the square of their number in time."""


def rounded(value: float, digits: int) -> float:
    """Return a number rounded to `digits` significant digits."""
    return float(f"{value:.{digits}g}")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the content of a TOML text; ValueError names the problem and its line."""
    deep = _DEEP_KEY.search(text)
    if deep is not None:
        line = 1 + text.count("\n", 0, deep.start())
        raise ValueError(f"line {line}: a key of more than {LIMITS.toml_depth} parts is nested too deep")
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"is nested too deep: {LIMITS.toml_depth} tables or arrays are the most") from None
    except ValueError as error:
        raise ValueError(f"is no valid TOML: {error}") from None
    level: list[tuple[str, Any]] = list(document.items())
    for _ in range(LIMITS.toml_depth):
        level = [
            (name, inner)
            for name, value in level
            if isinstance(value, dict | list)
            for inner in (value.values() if isinstance(value, dict) else value)
        ]
    if level:
        raise ValueError(
            f"{level[0][0]} is nested too deep: {LIMITS.toml_depth} tables or arrays are the most"
        )
    return document
