"""Profiles of laser profilers, from the text files that such sensors write.

What a file does not say is stated by the user, key by key, and never guessed. Places that are not those of
the setup's columns are laid on them, between neighbours without a gap alone.
"""

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.limits import LIMITS
from arctrack.recording import png
from arctrack.recording.csv_file import number
from arctrack.recording.files import blamed_on, read_text
from arctrack.recording.frames import png_path
from noise_model.compiled.arrays import Float64
from noise_model.instrument.profiler import Profiler
from noise_model.spelling import nearest

KEYS = {
    "layout": "rows (a profile a line), blocks (of rows, with an empty line behind each), cloud (points, a "
    "profile where the third axis changes) or gocator",
    "up_mm": "mm of a height's unit, negative where a larger value is farther from the sensor",
    "across_mm": "mm of a place's unit, or the pitch of columns without places; negative to mirror",
    "axes": "names across, along and up, such as x,z,y; blocks are x, y, z in their order",
    "nothing": "the value without a height, empty for cells without a value",
    "separator": "what parts the cells: comma, semicolon, tab or blank",
    "decimal": "the decimal mark: point or comma",
    "zero": "the value of the profile's z = 0, in the file's unit; 0 unless stated",
    "middle": "the place of the profile's middle column, in the file's unit; 0 unless stated",
}
"""Meaning of each key of --profile."""

SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "blank": None}
DECIMALS = {"point": ".", "comma": ","}

GAP = 1.5
"""Neighbours farther apart than so many usual distances have a gap between them."""

SAME = 1e-6
"""Places as near as this share of a pitch are the column's own."""


class RawProfile(NamedTuple):
    """Points of a profile in the file's units: places (n,), rising, and heights (n,), NaN for none."""

    across: Float64
    up: Float64


@dataclass(frozen=True)
class ProfileLayout:
    """Layout of a file of profiles, as the user states it by `KEYS`."""

    stated: Mapping[str, str]

    @classmethod
    def of(cls, texts: Sequence[str]) -> "ProfileLayout":
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


def write_frames(sources: Sequence[Path], layout: ProfileLayout, profiler: Profiler, folder: Path) -> str:
    """Write the profiles of files as a recording's frames, in order, and return a note on them.

    Raises ArctrackError for a file that cannot be read, for a key that is not stated, and where the heights
    lie outside the profiler's range.
    """
    count, held, beyond = 0, 0, 0
    for source in sources:
        for z_mm in heights_of(source, layout, profiler):
            codes = profiler.codes(z_mm)
            held += int(np.count_nonzero(codes))
            beyond += int(np.count_nonzero(np.isfinite(z_mm) & (codes == 0)))
            # No file that is read here has an intensity.
            image = np.stack([codes, np.where(codes > 0, 1, 0).astype(np.uint16)])
            png_path(folder, count).write_bytes(png.encode(image))
            count += 1
        if beyond > held:
            raise in_file(
                source,
                f"{beyond} of {beyond + held} heights lie outside [camera] range_mm: state the height of the "
                "middle by --profile zero=VALUE, or a larger range",
            )
    share = held / max(count * profiler.columns, 1)
    return f"{count} profiles, {100 * share:.1f} % of their columns have a height, {beyond} lie out of range"


def heights_of(path: Path, layout: ProfileLayout, profiler: Profiler) -> Iterator[Float64]:
    """Yield the heights (columns,) of a file's profiles on the profiler's columns, mm, NaN for none."""
    with blamed_on(path, "there is no such file"):
        text = read_text(path, LIMITS.csv_bytes)
    name = layout.need(path, "layout")
    if name not in READERS:
        raise ArctrackError(f"--profile layout={name}: must be one of {', '.join(READERS)}")
    stated = layout if name != "gocator" else ProfileLayout({"up_mm": "1", "across_mm": "1", **layout.stated})
    up_mm, across_mm = stated.scale(path, "up_mm"), stated.scale(path, "across_mm")
    zero, middle = (stated.number(key, stated.stated.get(key, "0")) for key in ("zero", "middle"))
    for raw in READERS[name](path, text, stated):
        up = np.where(raw.up == stated.nothing, np.nan, raw.up)
        yield on_columns((raw.across - middle) * across_mm, (up - zero) * up_mm, profiler)


def on_columns(y_mm: Float64, z_mm: Float64, profiler: Profiler) -> Float64:
    """Return heights (columns,) of points (n,) at the columns' places, NaN where a gap lies."""
    order = np.argsort(y_mm, kind="stable")
    known = order[np.isfinite(z_mm[order])]
    y, z, wanted = y_mm[known], z_mm[known], profiler.y_mm
    if len(y) < 2:
        return np.full(profiler.columns, np.nan)
    # Points of a cloud do not lie evenly: three of four distances are usual.
    pitch_mm = float(np.quantile(np.diff(y_mm[order]), 0.75, method="lower"))
    after = np.clip(np.searchsorted(y, wanted - SAME * profiler.pitch_mm), 1, len(y) - 1)
    span = y[after] - y[after - 1]
    share = (wanted - y[after - 1]) / np.where(span > 0.0, span, 1.0)
    near = np.rint(share)
    is_own = np.abs(share - near) * span <= SAME * profiler.pitch_mm
    share = np.where(is_own, near, share)
    is_between = (share >= 0.0) & (share <= 1.0) & (is_own | (span <= GAP * pitch_mm))
    return np.where(is_between, (1.0 - share) * z[after - 1] + share * z[after], np.nan)


def _cells(path: Path, layout: ProfileLayout, lines: Sequence[str], first: int) -> Iterator[Float64]:
    """Yield the numbers of each line, NaN for an empty cell; ArctrackError names the line of another."""
    separator = layout.choice(path, "separator", SEPARATORS)
    mark = layout.choice(path, "decimal", DECIMALS)
    for n, line in enumerate(lines, first):
        cells = line.split(separator)
        # A separator at the end parts nothing.
        cells = cells[:-1] if separator is not None and not cells[-1].strip() and len(cells) > 1 else cells
        try:
            yield np.array(
                [number(cell.replace(str(mark), ".")) if cell.strip() else np.nan for cell in cells]
            )
        except ValueError as error:
            raise in_file(path, f"line {n}: {error}; check --profile separator and decimal") from None


def _rows(path: Path, text: str, layout: ProfileLayout) -> Iterator[RawProfile]:
    """Yield a profile a line; columns count from the middle. A first line 0, 1, 2, … numbers them."""
    layout.need(path, "nothing")
    lines = [line for line in text.splitlines() if line.strip()]
    for n, up in enumerate(_cells(path, layout, lines, 1)):
        if n == 0 and np.array_equal(up, np.arange(len(up))):
            continue
        yield RawProfile(np.arange(float(len(up))) - 0.5 * (len(up) - 1), up)


def _axes(path: Path, layout: ProfileLayout, names: Sequence[str]) -> tuple[int, int, int]:
    """Return the places of the axes across, along and up among some names."""
    axes = [name.strip() for name in layout.need(path, "axes").split(",")]
    if len(axes) != 3 or len({*axes}) != 3 or not {*axes} <= {*names}:
        raise in_file(path, f"--profile axes={','.join(axes)}: must be three of {', '.join(names)}")
    across, along, up = (list(names).index(name) for name in axes)
    return across, along, up


def _blocks(path: Path, text: str, layout: ProfileLayout) -> Iterator[RawProfile]:
    """Yield the rows of three blocks x, y, z, which an empty line parts; rows may be of unequal length."""
    blocks: list[list[Float64]] = [[]]
    lines, first = text.splitlines(), 1
    for n, line in enumerate([*lines, ""], 1):
        if not line.strip():
            if n > first:
                blocks[-1] = list(_cells(path, layout, lines[first - 1 : n - 1], first))
                blocks.append([])
            first = n + 1
    *blocks, _ = blocks
    if len(blocks) != 3 or len({len(block) for block in blocks}) != 1:
        raise in_file(path, f"has {len(blocks)} blocks of {[len(b) for b in blocks]} rows: needs three alike")
    across, _, up = _axes(path, layout, ("x", "y", "z"))
    for n, (places, heights) in enumerate(zip(blocks[across], blocks[up], strict=True), 1):
        if len(places) != len(heights):
            raise in_file(path, f"row {n} of the blocks: {len(places)} places and {len(heights)} heights")
        yield RawProfile(places, heights)


def _cloud(path: Path, text: str, layout: ProfileLayout) -> Iterator[RawProfile]:
    """Yield the points of a cloud, PCD or plain columns, whose coordinate along is the same."""
    head, _, body = text.partition("DATA ascii\n")
    fields = next((line.split()[1:] for line in head.splitlines() if line.startswith("FIELDS")), None)
    if text.startswith("# .PCD") and (not body or fields is None):
        raise in_file(
            path, "is a PCD whose data are not ascii: convert it, as by pcl_convert_pcd_ascii_binary"
        )
    names = fields or ("x", "y", "z")
    try:
        points = np.loadtxt(io.StringIO(body or text), ndmin=2)
    except ValueError as error:
        raise in_file(path, f"is no cloud of points: {error}") from None
    if points.shape[1] < len(names):
        raise in_file(path, f"has {points.shape[1]} numbers a point, {len(names)} are needed")
    across, along, up = _axes(path, layout, names)
    starts = np.flatnonzero(np.diff(points[:, along])) + 1
    for part in np.split(points, starts):
        yield RawProfile(part[:, across], part[:, up])


def _gocator(path: Path, text: str, layout: ProfileLayout) -> Iterator[RawProfile]:
    """Yield the rows of each part of a Gocator's CSV: a line of places, then heights a line."""
    across: Float64 | None = None
    stated = ProfileLayout({"separator": "comma", "decimal": "point"})
    for n, line in enumerate(text.splitlines(), 1):
        head, _, rest = line.partition(",")
        if head == "Y\\X":
            across = next(_cells(path, stated, [rest], n))
        elif head == "End":
            across = None
        elif across is not None:
            # An empty last cell is a height without a value.
            up = next(_cells(path, stated, [f"{rest},"], n))
            if len(up) != len(across):
                raise in_file(path, f"line {n}: has {len(up)} heights for {len(across)} places")
            yield RawProfile(across, up)


Reader = Callable[[Path, str, ProfileLayout], Iterator[RawProfile]]

READERS: Mapping[str, Reader] = {"rows": _rows, "blocks": _blocks, "cloud": _cloud, "gocator": _gocator}
"""The reader of each layout."""
