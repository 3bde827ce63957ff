"""Layout of a profiler's files, as the user states it, and the profiles as they stand in them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

from arctrack.errors import ArctrackError, in_file
from arctrack.recording.csv_file import number
from noise_model.compiled.arrays import Float64
from noise_model.spelling import nearest

KEYS = {
    "layout": "rows (a profile a line), blocks (of rows, with an empty line behind each), cloud (points, a "
    "profile where the third axis changes), gocator, or mcap (a message a profile)",
    "topic": "MCAP's topic of the profiles",
    "up_mm": "mm of a height's unit, negative where a larger value is farther from the sensor",
    "across_mm": "mm of a place's unit, or the pitch of columns without places; negative to mirror",
    "axes": "names across, along and up, such as x,z,y; blocks are x, y, z in their order",
    "sigma": "the name of the points' 1 sigma, in the heights' unit, among the fields of a cloud or message; "
    "4, 5, … in plain columns",
    "nothing": "the value without a height, empty for cells without a value",
    "separator": "what parts the cells: comma, semicolon, tab or blank",
    "decimal": "the decimal mark: point or comma",
    "zero": "the value of the profile's z = 0, in the file's unit; 0 unless stated",
    "middle": "the place of the profile's middle column, in the file's unit; 0 unless stated",
}
"""Meaning of each key of --profile."""


class RawProfile(NamedTuple):
    """Points of a profile in the file's units: places (n,), and heights (n,), NaN for none.

    `intensity` and `sigma` (n,), in the heights' unit, are None where the file has none, `time_s` is NaN.
    """

    across: Float64
    up: Float64
    intensity: Float64 | None = None
    sigma: Float64 | None = None
    time_s: float = math.nan


@dataclass(frozen=True)
class ProfileLayout:
    """Layout of a file of profiles, as the user states it by `KEYS`."""

    stated: Mapping[str, str]

    @classmethod
    def of(cls, texts: Sequence[str]) -> Self:
        """Return the layout that options KEY=VALUE state; ArctrackError for what states none."""
        stated: dict[str, str] = {}
        for text in texts:
            name, equals, value = (part.strip() for part in text.partition("="))
            if name not in KEYS or not (equals and value):
                near = nearest(name, KEYS)
                hint = f"; did you mean {near}?" if near else f"; the keys are {', '.join(KEYS)}"
                raise ArctrackError(f"--profile {text}: give KEY=VALUE{hint}")
            stated[name] = value
        return cls(stated)

    def need(self, path: Path, name: str) -> str:
        """Return a key's value; ArctrackError names the file and the cure where it is not stated."""
        if name not in self.stated:
            raise in_file(path, f"does not say {KEYS[name]}: give --profile {name}=…")
        return self.stated[name]

    def choice(self, path: Path, name: str, choices: Mapping[str, str | None]) -> str | None:
        """Return what one of some words stands for."""
        word = self.need(path, name)
        if word not in choices:
            raise ArctrackError(f"--profile {name}={word}: must be one of {', '.join(choices)}")
        return choices[word]

    def number(self, name: str, text: str) -> float:
        """Return a key's value as a number."""
        try:
            return number(text)
        except ValueError as error:
            raise ArctrackError(f"--profile {name}={text}: {error}") from None

    def scale(self, path: Path, name: str) -> float:
        """Return mm of a unit, which is not 0."""
        scale = self.number(name, self.need(path, name))
        if scale == 0.0:
            raise ArctrackError(f"--profile {name}=0: must not be 0; it is {KEYS[name]}")
        return scale

    @property
    def nothing(self) -> float:
        """The value without a height, NaN where none is stated."""
        text = self.stated.get("nothing", "empty")
        return math.nan if text == "empty" else self.number("nothing", text)

    def sigma_field(self, path: Path, names: Sequence[str]) -> str | None:
        """Return the name of the points' sigma among some names, None where it is not stated."""
        stated = self.stated.get("sigma")
        if stated is not None and stated not in names:
            raise in_file(path, f"--profile sigma={stated}: must be one of {', '.join(names)}")
        return stated

    def axes(self, path: Path, names: Sequence[str]) -> tuple[int, int, int]:
        """Return the places of the axes across, along and up among some names."""
        stated = [name.strip() for name in self.need(path, "axes").split(",")]
        if len(stated) != 3 or len({*stated}) != 3 or not {*stated} <= {*names}:
            raise in_file(path, f"--profile axes={','.join(stated)}: must be three of {', '.join(names)}")
        across, along, up = (list(names).index(name) for name in stated)
        return across, along, up
