"""Images that a source names, their order, their numbers, and the times that their names carry."""

import calendar
import glob
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file, no_such_path
from arctrack.limits import LIMITS
from arctrack.printable import cut
from arctrack.recording.frame_hints import IMPORTED, VIDEOS
from arctrack.recording.importing.units import TIME, Units, factor
from arctrack.recording.time_sources import TimeSource
from noise_model.compiled.arrays import Float64

MAX_GAPS_NAMED = 5
"""Gaps in the numbering that are named one by one."""

_DIGITS = re.compile(r"(\d+)")
_DECIMAL = re.compile(r"(\d+)\.(\d+)$")


@dataclass(frozen=True)
class ImageSeries:
    """Images in the order of their numbers.

    `paths` are the files, `indices` their frame numbers, which rise; `step` is by how much these go up where
    none is missing; `notes` say how names became numbers, and which are missing. The frames of a `video` have
    names after it; `times` are its own then, and `warnings` say what is wrong with it.
    """

    paths: tuple[Path, ...]
    indices: tuple[int, ...]
    step: int
    notes: tuple[str, ...]
    video: Path | None = None
    times: TimeSource | None = None
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.paths)

    def in_order(self, order: Sequence[int]) -> "ImageSeries":
        """Return the images in another order, counted from 0; themselves if the order is theirs."""
        if list(order) == list(range(len(self))):
            return self
        paths = tuple(self.paths[n] for n in order)
        return ImageSeries(paths, tuple(range(len(self))), 1, ("frames are counted from 0, by their times",))


def find_images(sources: Sequence[Path]) -> ImageSeries:
    """Return the images of folders, files and patterns, by their numbers, or the frames of a video.

    Numbers are compared as numbers: img_2 comes before img_10. Where the names differ in one number alone, it
    is the frame's number; otherwise frames are counted from 0.

    Raises ArctrackError if there is none, if names differ in more than their numbers, or if two of them have
    the same number.
    """
    if len(sources) == 1 and sources[0].suffix.lower() in VIDEOS and sources[0].is_file():
        return _frames_of(sources[0])
    ordered = images_of(sources)
    _check_one_pattern(ordered, sources[0])
    for before, after in pairwise(ordered):
        if _numbers(before) == _numbers(after):
            raise in_file(
                after, f"has the number of {before.name}; leave one of them out, as by the pattern '*.png'"
            )
    indices, notes = _indices(ordered)
    ordered, indices, wraps = _unwrapped(ordered, indices)
    step = math.gcd(*np.diff(indices).tolist()) or 1
    return ImageSeries(tuple(ordered), indices, step, (*notes, *wraps, *_gaps(indices, step)))


def images_of(sources: Sequence[Path]) -> list[Path]:
    """Return the images of folders, files and patterns by their numbers; ArctrackError if there is none."""
    paths = [path for source in sources for path in _images_of(source)]
    if len(paths) > LIMITS.csv_rows:
        raise in_file(sources[0], f"names {len(paths)} images: {LIMITS.csv_rows} are the most")
    return sorted(set(paths), key=lambda path: (_numbers(path), path))


def distinct_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Return each file's name, with its folder's, or the whole path, where two would be equal."""
    names = {path: path.name for path in paths}
    for longer in (lambda path: f"{path.parent.name}/{path.name}", str):
        counts = Counter(names.values())
        names = {path: name if counts[name] == 1 else longer(path) for path, name in names.items()}
    return names


def _frames_of(video: Path) -> ImageSeries:
    if video.suffix.lower() != ".mkv":
        raise in_file(video, "only grey FFV1 in .mkv is read; export the frames of other videos as PNG")
    from arctrack.recording import ffv1

    index = ffv1.index_of(video)
    count = len(index)
    if not 0 < count <= LIMITS.csv_rows:
        raise in_file(video, f"holds {count} frames: 1 to {LIMITS.csv_rows} are read")
    names = tuple(video.with_name(f"{video.name} frame {n}") for n in range(count))
    warnings = () if index.breaks_off is None else (index.breaks_off,)
    return ImageSeries(names, tuple(range(count)), 1, (), video, index.times, warnings)


def _images_of(source: Path) -> list[Path]:
    if source.is_dir():
        images = [path for path in source.iterdir() if _is_image(path)]
        if not images:
            raise in_file(source, f"holds no image: {', '.join(IMPORTED)} are read")
        return images
    if source.exists():
        return [source]
    if not glob.has_magic(str(source)):
        raise no_such_path(source, "there is no such file or folder")
    matches = [Path(name) for name in glob.glob(str(source))]
    if not matches:
        raise in_file(source, "no file fits this pattern")
    return matches


def _is_image(path: Path) -> bool:
    # What begins with a point is an editor's or a system's copy.
    return path.suffix.lower() in IMPORTED and not path.name.startswith(".")


def _texts(path: Path) -> tuple[str, ...]:
    return (str(path.parent), *_DIGITS.split(path.stem)[::2])


def _numbers(path: Path) -> tuple[int, ...]:
    return tuple(int(digits) for digits in _DIGITS.split(path.stem)[1::2])


def _check_one_pattern(paths: Sequence[Path], source: Path) -> None:
    """Raise ArctrackError unless all names are equal except for their numbers."""
    first = paths[0]
    other = next((path for path in paths if _texts(path) != _texts(first)), None)
    if other is not None:
        raise ArctrackError(
            f"{source}: {cut(first.name)} and {cut(other.name)} are of two series, and nothing says which "
            f"comes first; name one of them, as by the pattern '{_pattern(first)}'"
        )


def _pattern(path: Path) -> str:
    return str(path.with_name(_DIGITS.sub("*", path.stem) + path.suffix))


def _indices(paths: Sequence[Path]) -> tuple[tuple[int, ...], list[str]]:
    numbers = [_numbers(path) for path in paths]
    varying = [column for column in zip(*numbers, strict=True) if len(set(column)) > 1]
    if not varying:
        # A single image: its last number is its own.
        varying = [(numbers[0][-1],)] if numbers[0] else []
    if len(varying) == 1 and varying[0][-1] <= LIMITS.frame_number and not holds_dates(paths):
        return varying[0], []
    counted = "frames are counted from 0: their names hold "
    reason = "no number" if not varying else "times or dates"
    return tuple(range(len(paths))), [counted + reason]


def _unwrapped(
    paths: list[Path], indices: tuple[int, ...]
) -> tuple[list[Path], tuple[int, ...], tuple[str, ...]]:
    """Return images and numbers in the order of a counter that went on from 0 or 1 behind its last number.

    That is where both its ends are among the numbers and nothing else of half its range is.
    """
    last = indices[-1]
    # The last numbers of counters of 1, 2 and 4 bytes.
    is_last = str(last) == "9" * len(str(last)) or last in (255, 65535, 2**32 - 1)
    jumps = np.diff(indices)
    if indices[0] > 1 or not is_last or not len(jumps) or jumps.max() <= last / 2:
        return paths, indices, ()
    cut_at = int(np.argmax(jumps)) + 1
    # A camera that counts from 1 leaves no number out.
    more = last + 1 - indices[0]
    numbers = (*indices[cut_at:], *(number + more for number in indices[:cut_at]))
    note = f"the numbers begin anew after {last}: {paths[0].name} is frame {last + 1}"
    return [*paths[cut_at:], *paths[:cut_at]], numbers, (note,)


def check_decimals(series: ImageSeries) -> None:
    """Raise ArctrackError if numbers with a point have another order as decimals than as two counters."""
    if series.video is not None:
        return
    hits = [_DECIMAL.search(path.stem) for path in series.paths]
    decimals = [match for match in hits if match is not None]
    counters = {match[2] for match in decimals}
    # Places of one width have one order; numbers without a gap behind one point are a counter.
    if len({len(text) for text in counters}) < 2 or len(decimals) < len(hits):
        return
    is_counter = len({match[1] for match in decimals}) == 1 and not any("missing" in n for n in series.notes)
    for (before, after), (path, later) in zip(pairwise(decimals), pairwise(series.paths), strict=True):
        if not is_counter and float(before[0]) > float(after[0]):
            raise in_file(
                later,
                f"comes after {path.name} by its numbers, before it as a decimal; say that they are times by "
                "--times-in-names, or name all with as many places",
            )


def _gaps(indices: Sequence[int], step: int) -> Iterable[str]:
    if step > 1:
        yield f"the numbers go up by {step}"
    gaps = [(before + step, after - step) for before, after in pairwise(indices) if after - before > step]
    if not gaps:
        return
    names = [f"{first}" if first == last else f"{first} to {last}" for first, last in gaps[:MAX_GAPS_NAMED]]
    more = f" and {len(gaps) - MAX_GAPS_NAMED} more gaps" if len(gaps) > MAX_GAPS_NAMED else ""
    count = sum((last - first) // step + 1 for first, last in gaps)
    yield f"{count} numbers are missing: {', '.join(names)}{more}"


NAME = "the times in the names"

DAY_S, MONTHS = 86400.0, 12

_OF_DAY = r"([01]\d|2[0-3])%s([0-5]\d)%s([0-5]\d)(?:([-_.,]%s)(\d{1,9}))?(?!\d)"
_DATED = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(0[1-9]|1[0-2])[-_.]?(0[1-9]|[12]\d|3[01])[-T_ .]*"
    + _OF_DAY % ("[-_.:h]?", "[-_.:m]?", "?")
)
_DAY_FIRST = re.compile(
    r"(?<!\d)(0[1-9]|[12]\d|3[01])[-_.](0[1-9]|[12]\d|3[01])[-_.]((?:19|20)\d\d)[-T_ .]*"
    + _OF_DAY % ("[-_.:h]?", "[-_.:m]?", "?")
)
_OF_DAY_ALONE = re.compile(r"(?<!\d)" + _OF_DAY % ("[-_.:h]", "[-_.:m]", ""))
_TRAILING_COUNT = re.compile(r"\d{1,9}$")
_TRAILING_NUMBER = re.compile(r"\d+(?:\.\d+)?$")

_EPOCH = re.compile(r"(?<!\d)1\d{9}(\d{3}){0,3}(?!\d)")


def times_in_names(paths: Sequence[Path], stated: Units) -> TimeSource:
    """Return the times of names; ArctrackError for a name without, and for a number without a unit."""
    dated = _by_calendar(paths)
    if dated:
        return dated[0]
    if stated.time is None:
        raise ArctrackError("--times-in-names: names state no unit: give --units s, ms, us or ns")
    values, decimals = [], 0
    for path in paths:
        digits = _TRAILING_NUMBER.search(path.stem)
        if digits is None:
            raise in_file(path, "its name ends with no time; give the times by --frames")
        values.append(float(digits[0]))
        decimals = max(decimals, len(digits[0].partition(".")[2]))
    unit_s = factor(TIME, stated.time)
    return TimeSource(NAME, np.array(values) * unit_s, unit_s * 10.0**-decimals)


def holds_dates(paths: Sequence[Path]) -> bool:
    """Return True if each name holds a date and a time of day: no count, for 230000 follows 225959."""
    for form in (_DATED, _DAY_FIRST):
        times = [form.search(path.stem) for path in paths]
        if None not in times:
            return len({match and match[0] for match in times}) > 1
    return False


def recognized_times(paths: Sequence[Path]) -> list[TimeSource]:
    """Return times of names that can be nothing else, of a calendar or since 1970, and a counter behind."""
    dated = _by_calendar(paths)
    if dated:
        return dated
    hits = [_EPOCH.search(path.stem) for path in paths]
    digits = [match[0] for match in hits if match is not None]
    if len(digits) < len(paths) or len({len(text) for text in digits}) > 1:
        return []
    # Seconds since 1970 have ten digits from 2001 to 2286; three more make ms, six us, nine ns.
    tick_s = 10.0 ** (10 - len(digits[0]))
    # Whole ns since 1970 are more than a float holds.
    first = int(digits[0])
    return [TimeSource(NAME, np.array([float(int(text) - first) for text in digits]) * tick_s, tick_s)]


def _by_calendar(paths: Sequence[Path]) -> list[TimeSource]:
    for form in (_DATED, _DAY_FIRST, _OF_DAY_ALONE):
        hits = [form.search(path.stem) for path in paths]
        matches = [match for match in hits if match is not None]
        if len(matches) == len(paths):
            return _calendar_times(matches, form)
    return []


def _calendar_times(matches: Sequence[re.Match[str]], form: re.Pattern[str]) -> list[TimeSource]:
    """Return times in s since 1970, or since a midnight, by the camera's clock; and a counter behind them."""
    fields = np.array([match.groups()[:-2] for match in matches], dtype=np.int64)
    dates = np.tile((1970, 1, 1), (len(matches), 1)) if form is _OF_DAY_ALONE else fields[:, :3]
    if form is _DAY_FIRST:
        # The month is first in the United States.
        month, day = (0, 1) if dates[:, 1].max() > MONTHS else (1, 0)
        dates = dates[:, [2, month, day]]
    whole_s = np.array(
        [
            float(calendar.timegm((*date, *time_of_day)))
            for date, time_of_day in zip(dates.tolist(), fields[:, -3:].tolist(), strict=True)
        ]
    )
    if form is _OF_DAY_ALONE:
        whole_s = _past_midnight(whole_s)
    behind = [_TRAILING_COUNT.search(match.string, match.end()) for match in matches]
    counts = [int(count[0]) for count in behind if count is not None]
    parts = [match.groups()[-2:] for match in matches]
    if not counts and _are_counts(parts, whole_s):
        counts, parts = [int(str(digits)) for _, digits in parts], [(None, None)] * len(parts)
    parts_s, resolution_s = _parts_of_second(parts)
    sources = [TimeSource(NAME, whole_s + parts_s, resolution_s)]
    if len(counts) == len(matches):
        sources.append(TimeSource("the numbers in the names", np.array(counts, float), is_count=True))
    return sources


def _past_midnight(of_day_s: Float64) -> Float64:
    """Return times of day that go on at midnight: what lies across half a day's gap was the day before."""
    ordered = np.unique(of_day_s)
    gaps = np.diff(ordered)
    if not len(gaps) or gaps.max() <= DAY_S / 2.0:
        return of_day_s
    return np.where(of_day_s <= ordered[np.argmax(gaps)], of_day_s + DAY_S, of_day_s)


def _are_counts(parts: Sequence[tuple[str | None, ...]], whole_s: Float64) -> bool:
    """Return True if digits behind a dash count: they rise over the second's end, or by one within it."""
    if not all(separator in ("-", "_") for separator, _ in parts):
        return False
    counts = np.array([int(str(digits)) for _, digits in parts])
    steps = np.diff(counts[np.lexsort((counts, whole_s))])
    return bool(len(steps) and (steps > 0).all() and (np.ptp(whole_s) > 0.0 or (steps == 1).all()))


def _parts_of_second(parts: Sequence[tuple[str | None, ...]]) -> tuple[Float64, float]:
    """Return the part of a second that separators and digits state, s, and its rounding."""
    if any(digits is None for _, digits in parts):
        return np.zeros(len(parts)), 1.0
    texts = [str(digits) for _, digits in parts]
    length = max(map(len, texts))
    if all(separator in ("-", "_") for separator, _ in parts):
        # Milliseconds are often written without leading zeros.
        places = 3 * math.ceil(length / 3)
        return np.array([int(text) for text in texts]) / 10.0**places, 10.0**-places
    return np.array([float(f"0.{text}") for text in texts]), 10.0**-length
