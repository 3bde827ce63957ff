"""Which key of a file is wrong: what pydantic found, in one line for people."""

from __future__ import annotations

from collections.abc import Iterable
from types import UnionType
from typing import get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from arctrack.printable import cut, shown
from noise_model.spelling import nearest


def describe(error: ValidationError, model: type[BaseModel]) -> str:
    """Return one line that names the first wrong key, what it holds and what it should, and how many more.

    `model` is what the content was validated against.
    """
    problems = error.errors(include_url=False)
    first = problems[0]
    if not first["loc"]:
        return first["msg"].removeprefix("Value error, ")
    where = place(first["loc"])
    if first["type"] == "missing":
        text = f"{where}: missing{_misspelt(first, model)}"
    elif first["type"] == "finite_number":
        text = f"{held(where, first['input'])}: must be a finite number"
    elif first["type"] == "literal_error":
        text = f"{where} = {shown(first['input'])}: must be {first['ctx']['expected']}"
    else:
        text = f"{held(where, first['input'])}: {first['msg'][:1].lower()}{first['msg'][1:]}"
    more = len(problems) - 1
    return text if not more else f"{text} (and {more} more)"


def _misspelt(missing: ErrorDetails, model: type[BaseModel]) -> str:
    """Return a hint at the key that may stand, misspelt, for a missing one."""
    *tables, name = map(str, missing["loc"])
    for table in tables:
        field = model.model_fields.get(table)
        inner = None if field is None else field.annotation
        if get_origin(inner) is UnionType:
            inner = get_args(inner)[0]
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return ""
        model = inner
    return meant_by(name, (key for key in missing["input"] if key not in model.model_fields))


def meant_by(name: str, keys: Iterable[str]) -> str:
    """Return the question whether one of the unknown keys is a missing one, misspelt."""
    near = nearest(name, keys)
    return "" if near is None else f"; did you misspell it as {cut(near)}?"


def held(key: str, value: object) -> str:
    """Return a key and what it holds, if that is a plain value."""
    return key if isinstance(value, dict | list) else f"{key} = {shown(value)}"


def place(location: tuple[str | int, ...]) -> str:
    """Return a key as a file's reader finds it: `[table] key`, with the place in a list."""
    names = [str(part) for part in location if isinstance(part, str)]
    indices = "".join(f"[{part}]" for part in location if isinstance(part, int))
    if len(names) == 1:
        return (names[0] if names[0] in ("format", "units") else f"[{names[0]}]") + indices
    return f"[{'.'.join(names[:-1])}] {names[-1]}{indices}"
