"""Capture times of frames by several sources: stamps of a video, tables, names, counters, a rate."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64

SAME_FRAME = 0.5
"""Times that differ by less than this share of a period, beyond what they are rounded to, mean one frame."""


@dataclass(frozen=True)
class TimeSource:
    """Times of the frames by one source.

    `values` (n,) are s on any clock, or the counts of a counter where `is_count`; NaN where the source has
    none. `resolution_s` is the rounding of its times.
    """

    name: str
    values: Float64
    resolution_s: float = 0.0
    is_count: bool = False


def contradictions(used: TimeSource, others: Sequence[TimeSource], frames: Sequence[int]) -> Iterator[str]:
    """Yield a line on each source that contradicts the increasing times that are used.

    Clocks need not begin together; a counter's period is that of most of its steps.
    """
    for other in others:
        known = np.flatnonzero(np.isfinite(other.values))
        # One value for all is the time of a copy, or of the series' start.
        if len(known) < 2 or np.ptp(other.values[known]) == 0.0:
            continue
        numbers = [frames[n] for n in known.tolist()]
        tolerance_s = used.resolution_s + other.resolution_s
        compare = _lost_frames if other.is_count else _other_clock
        yield from compare(used, other, used.values[known], other.values[known], numbers, tolerance_s)


def _other_clock(
    used: TimeSource,
    other: TimeSource,
    used_s: Float64,
    other_s: Float64,
    frames: Sequence[int],
    tolerance_s: float,
) -> Iterator[str]:
    """Yield where another clock leaves the times used: by its rate, at a step, or in single frames."""
    used_s, other_s = used_s - used_s[0], other_s - other_s[0]
    period_s = float(np.median(np.diff(used_s)))
    tolerance_s += SAME_FRAME * period_s
    off = np.abs(other_s - used_s) > tolerance_s
    if not off.any():
        return
    first = int(np.argmax(off))
    contradict = f"{other.name} contradict {used.name}"
    seconds = f"{other_s[first]:.6g} s where {used_s[first]:.6g} s, counted from frame {frames[0]}"
    slope, start_s = np.polyfit(used_s, other_s, 1)
    if slope > 0.0 and (np.abs(other_s - slope * used_s - start_s) <= tolerance_s).all():
        rates = f"{1.0 / (slope * period_s):.5g} frames a second where {1.0 / period_s:.5g}"
        yield f"{contradict} by their rate, {rates}; frame {frames[first]}: {seconds}"
    elif bool(off[first:].mean() > 0.5):
        yield f"{contradict} from frame {frames[first]} on: {seconds}"
    else:
        yield f"{contradict} in {off.sum()} of {len(off)} frames, the first frame {frames[first]}: {seconds}"


def _lost_frames(
    used: TimeSource,
    other: TimeSource,
    used_s: Float64,
    counts: Float64,
    frames: Sequence[int],
    tolerance_s: float,
) -> Iterator[str]:
    """Yield where the times used leave the period of a counter; nothing of frames without a period."""
    steps_s, steps = np.diff(used_s), np.diff(counts)
    if (steps <= 0.0).any():
        n = int(np.argmax(steps <= 0.0))
        went = f"from {counts[n]:.0f} to {counts[n + 1]:.0f}"
        yield f"{other.name} contradict {used.name} at frame {frames[n + 1]}: they go {went}"
        return
    period_s = float(np.median(steps_s / steps))
    error_s = np.abs(steps_s - steps * period_s)
    tolerance_s += SAME_FRAME * period_s
    if np.median(error_s) > tolerance_s:
        return
    (steep,) = np.nonzero(error_s > tolerance_s)
    for n in steep[:1]:
        lost = round(steps_s[n] / period_s - steps[n])
        what = f"some {lost} frames are lost" if lost > 0 else f"{-lost} numbers have no time"
        more = f", and so at {len(steep) - 1} more places" if len(steep) > 1 else ""
        yield (
            f"{used.name} go from frame {frames[n]} to frame {frames[n + 1]} in {steps_s[n]:.6g} s, "
            f"{other.name} by {steps[n]:.0f} where {period_s:.6g} s are the rule: {what}{more}"
        )
