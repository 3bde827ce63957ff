"""Profiles of laser profilers, from the files that such sensors and their programs write.

What a file does not say is stated by the user, key by key, and never guessed. Places that are not those of
the setup's columns are laid on them, between neighbours without a gap alone.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from arctrack.errors import ArctrackError, in_file, without_extra
from arctrack.limits import LIMITS
from arctrack.recording import png
from arctrack.recording.csv_file import number
from arctrack.recording.files import blamed_on, read_text
from arctrack.recording.frames import png_path
from arctrack.recording.importing.profile_layout import ProfileLayout, RawProfile
from noise_model.compiled.arrays import Float64
from noise_model.instrument.profiler import Profiler

SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "blank": None}
DECIMALS = {"point": ".", "comma": ","}

GAP = 1.5
"""Neighbours farther apart than so many usual distances have a gap between them."""

SAME = 1e-3
"""Places as near as this share of a pitch are the column's own.

A place in float32 is off by 5e-4 pitches at the end of the most columns; a height along a slope of 45 degrees
is then off by a thousandth of a pitch at most.
"""


class ColumnProfile(NamedTuple):
    """A profile on the profiler's columns: heights, mm, NaN for none, intensities, and sigmas, mm (columns,).

    Without intensities in the file these are 1, without sigmas NaN; `time_s` is NaN where the file says none.
    """

    z_mm: Float64
    intensity: Float64
    sigma_mm: Float64
    time_s: float


class WrittenProfiles(NamedTuple):
    """Profiles that were written as frames: a note on them, and their times (n,), s, NaN for none."""

    note: str
    times_s: Float64


def write_frames(
    sources: Sequence[Path], layout: ProfileLayout, profiler: Profiler, folder: Path
) -> WrittenProfiles:
    """Write the profiles of files as a recording's frames, in order.

    Raises ArctrackError for a file that cannot be read, for a key that is not stated, and where the heights
    lie outside the profiler's range.
    """
    if "sigma" in layout.stated and not profiler.point_sigma:
        raise ArctrackError(
            "--profile sigma: state [camera] point_sigma = true in the setup, else leave it out"
        )
    if "sigma" in layout.stated and layout.stated.get("layout") not in ("cloud", MCAP):
        raise ArctrackError("--profile sigma: layouts cloud and mcap have sigmas; leave it out")
    count, held, beyond, times_s = 0, 0, 0, []
    for source in sources:
        for z_mm, intensity, sigma_mm, time_s in profiles_of(source, layout, profiler):
            image = profiler.profile(z_mm, intensity, sigma_mm)
            held += int(np.count_nonzero(image[0]))
            beyond += int(np.count_nonzero(np.isfinite(z_mm) & (image[0] == 0)))
            png_path(folder, count).write_bytes(png.encode(image))
            times_s.append(time_s)
            count += 1
        if beyond > held:
            raise in_file(
                source,
                f"{beyond} of {beyond + held} heights lie outside [camera] range_mm: state the height of the "
                "middle by --profile zero=VALUE, or a larger range",
            )
    share = held / max(count * profiler.columns, 1)
    note = f"{count} profiles, {100 * share:.1f} % of their columns have a height, {beyond} lie out of range"
    return WrittenProfiles(note, np.array(times_s))


def profiles_of(path: Path, layout: ProfileLayout, profiler: Profiler) -> Iterator[ColumnProfile]:
    """Yield a file's profiles on the profiler's columns."""
    name = layout.need(path, "layout")
    if name not in (*TEXT_READERS, MCAP):
        raise ArctrackError(f"--profile layout={name}: must be one of {', '.join((*TEXT_READERS, MCAP))}")
    if name == MCAP:
        try:
            from arctrack.recording.importing.mcap_profiles import known_keys, mcap_profiles
        except ModuleNotFoundError as error:
            raise without_extra(f"{path}: --profile layout=mcap", error, "mcap") from None
        stated = ProfileLayout({**known_keys(path), **layout.stated})
        raws = mcap_profiles(path, stated)
    else:
        with blamed_on(path, "there is no such file"):
            text = read_text(path, LIMITS.csv_bytes)
        known = {"up_mm": "1", "across_mm": "1"} if name == "gocator" else {}
        stated = ProfileLayout({**known, **layout.stated})
        raws = TEXT_READERS[name](path, text, stated)
    up_mm, across_mm = stated.scale(path, "up_mm"), stated.scale(path, "across_mm")
    zero, middle = (stated.number(key, stated.stated.get(key, "0")) for key in ("zero", "middle"))
    for raw in raws:
        up = np.where(raw.up == stated.nothing, np.nan, raw.up)
        intensity = np.ones(len(up)) if raw.intensity is None else raw.intensity
        sigma = np.full(len(up), np.nan) if raw.sigma is None else raw.sigma * abs(up_mm)
        values = np.stack([(up - zero) * up_mm, intensity, sigma])
        z_mm, intensity, sigma_mm = on_columns((raw.across - middle) * across_mm, values, profiler)
        yield ColumnProfile(z_mm, intensity, sigma_mm, raw.time_s)


def on_columns(y_mm: Float64, values: Float64, profiler: Profiler) -> Float64:
    """Return values (k, columns) of points (k, n) at the columns' places, NaN where a gap lies.

    The first values are heights, NaN where there is no point.
    """
    order = np.argsort(y_mm, kind="stable")
    known = order[np.isfinite(values[0, order])]
    y, held, wanted = y_mm[known], values[:, known], profiler.y_mm
    if len(y) < 2:
        return np.full((len(values), profiler.columns), np.nan)
    # Points of a cloud do not lie evenly: three of four distances are usual.
    pitch_mm = float(np.quantile(np.diff(y_mm[order]), 0.75, method="lower"))
    after = np.clip(np.searchsorted(y, wanted - SAME * profiler.pitch_mm), 1, len(y) - 1)
    span = y[after] - y[after - 1]
    share = (wanted - y[after - 1]) / np.where(span > 0.0, span, 1.0)
    near = np.rint(share)
    is_own = np.abs(share - near) * span <= SAME * profiler.pitch_mm
    share = np.where(is_own, near, share)
    is_between = (share >= 0.0) & (share <= 1.0) & (is_own | (span <= GAP * pitch_mm))
    left, right = held[:, after - 1], held[:, after]
    mixed = np.where(share == 0.0, left, np.where(share == 1.0, right, (1.0 - share) * left + share * right))
    return np.where(is_between, mixed, np.nan)


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
    across, _, up = layout.axes(path, ("x", "y", "z"))
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
    try:
        points = np.loadtxt(io.StringIO(body or text), ndmin=2)
    except ValueError as error:
        raise in_file(path, f"is no cloud of points: {error}") from None
    names = fields or ("x", "y", "z", *map(str, range(4, points.shape[1] + 1)))
    if points.shape[1] < len(names):
        raise in_file(path, f"has {points.shape[1]} numbers a point, {len(names)} are needed")
    across, along, up = layout.axes(path, names)
    starts = np.flatnonzero(np.diff(points[:, along])) + 1
    field = layout.sigma_field(path, names)
    for part in np.split(points, starts):
        sigma = None if field is None else part[:, list(names).index(field)]
        yield RawProfile(part[:, across], part[:, up], sigma=sigma)


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

TEXT_READERS: Mapping[str, Reader] = {
    "rows": _rows,
    "blocks": _blocks,
    "cloud": _cloud,
    "gocator": _gocator,
}
"""The reader of each layout that is text."""

MCAP = "mcap"
"""The layout that is none."""
