"""A limit as a field of a record, with what it is and where its value comes from, and the check of all."""

import math
from collections.abc import Collection
from dataclasses import field, fields
from typing import Any, TypeVar

Value = TypeVar("Value", int, float, bool)


def stated(value: Value, unit: str, role: str, source: str, sensitivity: str = "") -> Value:
    """Return a dataclass's field with a default; its metadata has what else is stated, by these names."""
    metadata = {"unit": unit, "role": role, "source": source, "sensitivity": sensitivity}
    limit: Value = field(default=value, metadata=metadata)
    return limit


def check_limits(limits: Any, kind: str, may_be_zero: Collection[str] = ()) -> None:
    """Raise ValueError for a field of a dataclass that is not positive and finite; switches are left out.

    `kind` names the record in the error; the fields in `may_be_zero` may be 0.
    """
    for limit in fields(limits):
        if isinstance(limit.default, bool):
            continue
        value = getattr(limits, limit.name)
        is_low = value < 0.0 if limit.name in may_be_zero else not value > 0.0
        if is_low or not math.isfinite(value):
            raise ValueError(f"{kind} {limit.name}: is {value}; it must be positive and finite")
