"""Messages on wrong keys of a file: what pydantic found, in one line for people."""

from collections.abc import Iterable
from pathlib import Path

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from arctrack.errors import ArctrackError, in_file
from arctrack.printable import cut, shown
from arctrack.recording.schema import Key, meaning_of, table_in
from noise_model.spelling import nearest


def wrong_keys(path: Path, error: ValueError, model: type[BaseModel]) -> ArctrackError:
    """Return the error of a file whose content is no `model`."""
    return in_file(path, describe(error, model) if isinstance(error, ValidationError) else str(error))


def describe(error: ValidationError, model: type[BaseModel]) -> str:
    """Return one line that names the first wrong key, what it holds and what it should, and how many more.

    `model` is what the content was validated against. What it says of a key is the cure.
    """
    problems = error.errors(include_url=False)
    first = problems[0]
    if not first["loc"]:
        return first["msg"].removeprefix("Value error, ")
    location, field, table = _key_at(first["loc"], model)
    is_plain = field is not None and table_in(field) is None
    where = str(location[0]) if is_plain and len(location) == 1 else place(location)
    cure = ""
    if first["type"] == "missing":
        # A tuple that is too short lacks a number.
        names = first["input"] if isinstance(first["input"], dict) else ()
        hint = meant_by(str(location[-1]), (name for name in names if name not in table.model_fields))
        text = f"{where}: missing{hint}"
        meaning = "" if hint or field is None else meaning_of(field).removesuffix(".")
        cure = meaning and f"; state it: {meaning[:1].lower()}{meaning[1:]}"
    elif first["type"] == "literal_error":
        text = f"{where} = {shown(first['input'])}: must be {first['ctx']['expected']}"
    else:
        message = "must be a finite number" if first["type"] == "finite_number" else first["msg"]
        text = f"{held(where, first['input'])}: {message[:1].lower()}{message[1:]}"
        usual = "" if field is None else Key("", "", field).text("typical")
        cure = usual and f"; usual: {usual}"
    more = len(problems) - 1
    return f"{text}{f' (and {more} more)' if more else ''}{cure}"


def _key_at(
    location: tuple[str | int, ...], table: type[BaseModel]
) -> tuple[tuple[str | int, ...], FieldInfo | None, type[BaseModel]]:
    """Return a key's place without the types that pydantic tried, its field, and the table that holds it."""
    for n, name in enumerate(location):
        # An item of a list, and a table's free name, are no field.
        field = table.model_fields.get(str(name))
        inner = None if field is None else table_in(field)
        if field is not None and (inner is None or n == len(location) - 1):
            items = (item for item in location[n + 1 :] if isinstance(item, int))
            return (*location[: n + 1], *items), field, table
        table = inner or table
    return location, None, table


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
        return f"[{names[0]}]{indices}"
    return f"[{'.'.join(names[:-1])}] {names[-1]}{indices}"
