"""Enumerations whose values say in words what their members mean."""

from enum import Enum
from typing import TypeVar

E = TypeVar("E", bound=type[Enum])


def described(enumeration: E) -> E:
    """Add to an enumeration's docstring what each member means, as its value says."""
    lines = [enumeration.__doc__ or "", "", "Attributes", "----------"]
    for name, member in enumeration.__members__.items():
        lines += [name, f"    {member.value[:1].upper()}{member.value[1:]}."]
    enumeration.__doc__ = "\n".join(lines)
    return enumeration
