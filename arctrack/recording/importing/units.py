"""Units of lengths, angles and times: stated, never guessed."""

import math
import re
from dataclasses import dataclass
from types import MappingProxyType

from arctrack.errors import ArctrackError

LENGTH, ANGLE, TIME = "length", "angle", "time"

UNITS = MappingProxyType(
    {
        LENGTH: {"mm": 1.0, "m": 1e3},
        ANGLE: {"deg": math.pi / 180.0, "rad": 1.0},
        TIME: {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    }
)
"""The units of each quantity, and what one of them is in mm, rad or s."""

_KIND = {unit: kind for kind, units in UNITS.items() for unit in units}
_SPELLINGS = {"µs": "us", "μs": "us", "°": "deg"}
_SUFFIX = re.compile(r"(?:[ _]+|\s*(?=[\[(]))[\[(]?(mm|m|deg|°|rad|s|ms|us|µs|μs|ns)[\])]?$", re.IGNORECASE)


@dataclass(frozen=True)
class Units:
    """The units that a user or a convention states; None where neither does."""

    length: str | None = None
    angle: str | None = None
    time: str | None = None

    def of_kind(self, kind: str) -> str | None:
        """Return the unit of a quantity, None if none is stated."""
        unit: str | None = getattr(self, kind)
        return unit


UNSTATED = Units()
"""Nothing is stated."""


def parse_units(text: str) -> Units:
    """Return the units that a list such as "m, rad, ms" states; ArctrackError for one that is none."""
    stated: dict[str, str] = {}
    for word in text.replace(",", " ").split():
        unit = _SPELLINGS.get(word, word)
        kind = _KIND.get(unit)
        if kind is None:
            raise ArctrackError(f"--units {text}: {word} is not known; there are {', '.join(_KIND)}")
        if kind in stated:
            raise ArctrackError(f"--units {text}: states {stated[kind]} and {unit}; leave one")
        stated[kind] = unit
    return Units(**stated)


def split_unit(header: str) -> tuple[str, str | None]:
    """Return a column's name in lower case without its unit, and the unit: x_mm, `x [mm]` are x and mm."""
    match = _SUFFIX.search(header)
    if match is None:
        return header.strip().lower(), None
    unit = match[1].lower()
    return header[: match.start()].strip().lower(), _SPELLINGS.get(unit, unit)


def unit_of(kind: str, named: str | None, stated: Units, assumed: Units) -> str | None:
    """Return the unit that a column's name, the user, or else a convention states; None if none does.

    ValueError if name and user disagree.
    """
    if named is not None and _KIND[named] != kind:
        named = None
    user = stated.of_kind(kind)
    if named is not None and user is not None and named != user:
        raise ValueError(f"its name says {named}, --units says {user}; leave out of --units what names say")
    return named or user or assumed.of_kind(kind)


def factor(kind: str, unit: str) -> float:
    """Return a unit's size in mm, rad or s."""
    return UNITS[kind][unit]
