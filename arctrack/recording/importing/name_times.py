"""Times that names of images carry: a date with a time of day, a time of day, or a number."""

import calendar
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError, in_file
from arctrack.recording.importing.units import TIME, Units, factor
from arctrack.recording.time_sources import TimeSource
from noise_model.compiled.arrays import Float64

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
