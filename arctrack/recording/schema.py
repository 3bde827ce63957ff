"""The one statement of each key of a file: what it is, its unit, bounds, default, and where values come from.

A key is a pydantic field that `key` makes. Files to fill in, error lines and reference pages are made of it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from types import UnionType
from typing import Any, ClassVar, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

MAX_NUMBER = 1e15
"""The largest size of a number in a file (its square and its ratios stay finite)."""


class Bounds(NamedTuple):
    """Bounds of a number, None for an open end, and their reason."""

    low: float | None
    high: float | None
    source: str


class Table(BaseModel):
    """A table of a file: strict types, finite numbers, unknown keys kept."""

    extra_keys: ClassVar[type[BaseModel] | None] = None
    """States the keys of which the file needs some alone."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)

    @property
    def known(self) -> dict[str, Any]:
        """The values of its known keys."""
        return {name: getattr(self, name) for name in type(self).model_fields}

    @property
    def names(self) -> set[str]:
        """The names that mean something in it."""
        return {*type(self).model_fields}


def key(
    meaning: str,
    unit: str = "",
    typical: str = "",
    source: str = "",
    *,
    default: Any = ...,
    example: str = "",
    note: str = "",
    bounds: Bounds | None = None,
    min_length: int | None = None,
) -> Any:
    """Return the field of a key.

    `meaning` says what it is, without a full stop, `typical` what it usually is, `source` where a value comes
    from and how to get it, `note` what else is to know. A key without `default` is needed. A file to fill in
    shows it, or `example`, behind a #. `min_length` counts letters or items.
    """
    low, high, bound = Bounds(None, None, "") if bounds is None else bounds
    words = {"unit": unit, "typical": typical, "source": source, "note": note, "example": example}
    return Field(
        default,
        description=meaning,
        ge=low,
        le=high,
        min_length=min_length,
        json_schema_extra={**words, "bound": bound},
    )


def within(bounds: Bounds) -> Any:
    """Return the bounds of an item of a list, for its annotation."""
    return Field(ge=bounds.low, le=bounds.high, json_schema_extra={"bound": bounds.source})


@dataclass(frozen=True)
class Key:
    """A key of a file: the table that holds it, its name and its field."""

    table: str
    name: str
    field: FieldInfo

    @property
    def meaning(self) -> str:
        """Description with its unit, as a sentence; empty where there is none."""
        unit = self.text("unit")
        return f"{self.field.description}{f', {unit}' if unit else ''}." if self.field.description else ""

    @property
    def explanation(self) -> str:
        """Description, usual value, and how to find the value."""
        typical, source = self.text("typical"), self.text("source")
        usual, origin = typical and f"Usual: {typical}.", source and f"From {source}"
        return " ".join(filter(None, (self.meaning, usual, origin, self.text("note"))))

    @property
    def default(self) -> str | None:
        """Its value where none is stated, as a file has it; None for a key that is needed or may lack."""
        value = self.field.default
        if self.field.is_required() or value is None:
            return None
        return str(value).lower() if isinstance(value, bool) else repr(value).replace("'", '"')

    @property
    def bounds(self) -> Bounds:
        """Bounds of the value, or of each item of a list."""
        for info in (self.field, *_items(self.field)):
            low, high = (
                next((getattr(end, name) for end in info.metadata if hasattr(end, name)), None)
                for name in ("ge", "le")
            )
            if low is not None or high is not None:
                return Bounds(low, high, _words(info).get("bound", ""))
        return Bounds(None, None, "")

    def text(self, what: str) -> str:
        """Return its `unit`, `typical`, `source`, `note` or `example`, as `key` took them."""
        words: str = _words(self.field).get(what, "")
        return words


def tables_of(
    model: type[BaseModel], place: str = ""
) -> Iterator[tuple[str, type[BaseModel], tuple[Key, ...]]]:
    """Yield a table and those in it: place, model and own keys; N in a place stands for a free name."""
    stated, inner = [model], []
    if issubclass(model, Table) and model.extra_keys is not None:
        stated.append(model.extra_keys)
    keys = []
    for name, info in ((name, info) for table in stated for name, info in table.model_fields.items()):
        below = table_in(info)
        if below is not None:
            held = f"{name}.N" if get_origin(info.annotation) is dict else name
            inner.append((below, f"{place}.{held}" if place else held))
        elif info.description is not None:
            keys.append(Key(place, name, info))
    if keys:
        yield place, model, tuple(keys)
    for table, name in inner:
        yield from tables_of(table, name)


def keys_of(model: type[BaseModel]) -> Iterator[Key]:
    """Yield the keys of a file, in its order."""
    for _, _, keys in tables_of(model):
        yield from keys


def unknown_in(table: Table, location: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], set[str]]]:
    """Yield the place of each unknown key of a file, and the names known there."""
    yield from (
        ((*location, name), table.names) for name in table.model_extra or {} if name not in table.names
    )
    for name, value in table.known.items():
        inner = (
            {(name, key): held for key, held in value.items()}
            if isinstance(value, dict)
            else {(name,): value}
        )
        for below, held in inner.items():
            if isinstance(held, Table):
                yield from unknown_in(held, (*location, *below))


def meaning_of(info: FieldInfo) -> str:
    """Return the meaning of a key or of a table of stated keys, as a sentence; empty without one."""
    table = table_in(info)
    if table is None:
        return Key("", "", info).meaning
    is_stated = any(field.description for field in table.model_fields.values())
    return table.__doc__ or "" if is_stated else ""


def table_in(info: FieldInfo) -> type[BaseModel] | None:
    """Return the table that a field holds, or holds several of by name; None for a plain value."""
    held = _stated_type(info)
    if get_origin(held) is dict:
        held = get_args(held)[1]
    return held if isinstance(held, type) and issubclass(held, BaseModel) else None


def _stated_type(info: FieldInfo) -> Any:
    held = info.annotation
    return get_args(held)[0] if get_origin(held) in (UnionType, Union) else held


def _items(field: FieldInfo) -> Iterator[FieldInfo]:
    """Yield what is stated of the items of a field's lists."""
    todo = [field.annotation]
    while todo:
        arguments = get_args(todo.pop())
        yield from (item for item in arguments if isinstance(item, FieldInfo))
        todo += arguments


def _words(info: FieldInfo) -> dict[str, Any]:
    extra = info.json_schema_extra
    return extra if isinstance(extra, dict) else {}
