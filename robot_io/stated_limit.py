"""A limit as a field of a record, with what it is and where its value comes from."""

from __future__ import annotations

from dataclasses import field
from typing import TypeVar

Value = TypeVar("Value", float, bool)


def stated(value: Value, unit: str, role: str, source: str) -> Value:
    """Return a dataclass's field with a default, whose metadata states `unit`, `role` and `source`."""
    limit: Value = field(default=value, metadata={"unit": unit, "role": role, "source": source})
    return limit
