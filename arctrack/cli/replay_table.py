"""The tables at the end of a replay, narrow enough for a terminal of 80 columns."""

import math
from collections.abc import Sequence

from rich import box
from rich.markup import escape
from rich.table import Table

from arctrack.recording.results import Summary
from arctrack.recording.score import AxisScore, TrackScore

NO_VALUE, TAKEN_OVER = "–", "†"
CONSTANT_REMOVED = "RMS*: with the constant part removed"


def one_table(summaries: Sequence[Summary]) -> Table:
    """Return one recording's errors in full, a line an axis; `summaries` are its replays."""
    table = _table(f"{escape(summaries[0].recording)}: seam error against truth.csv over valid frames, mm")
    table.add_column("arc map")
    table.add_column("error")
    for name in ("RMS", "median", "p95", "max", "constant", "RMS*"):
        table.add_column(name, justify="right", no_wrap=True)
    for summary in summaries:
        if summary.score is not None:
            table.add_row(_map(summary), "lateral", *_axis(summary.score.lateral))
            table.add_row("", "vertical", *_axis(summary.score.vertical))
    table.caption = CONSTANT_REMOVED
    return table


def many_table(summaries: Sequence[Summary], taken_over: Sequence[bool]) -> Table:
    """Return several recordings' errors in short, a row a replay; `taken_over`: an earlier run did it."""
    scored = any(summary.score is not None for summary in summaries)
    table = _table("Seam error against truth.csv over valid frames, mm" if scored else "Replays")
    table.add_column("recording", overflow="fold")
    table.add_column("map")
    table.add_column("valid", justify="right", no_wrap=True)
    if scored:
        for axis in ("y", "z"):
            for name in ("RMS", "max", "RMS*"):
                table.add_column(f"{axis}\n{name}", justify="right", no_wrap=True)
        table.add_column("over\nlimit", justify="right")
    captions = [f"y: lateral, z: vertical; {CONSTANT_REMOVED}"] if scored else []
    if any(taken_over):
        captions.append(
            f"{TAKEN_OVER}: taken over from an earlier run, {sum(taken_over)} of {len(taken_over)}"
        )
    table.caption = "\n".join(captions) or None
    table.add_column("ms a\nframe", justify="right", no_wrap=True)
    for summary, is_taken_over in zip(summaries, taken_over, strict=True):
        mark = f" {TAKEN_OVER}" if is_taken_over else ""
        cells = [escape(summary.recording) + mark, _map(summary), f"{summary.valid}/{summary.laser_on}"]
        if scored:
            cells += _short(summary.score)
        table.add_row(*cells, _number(summary.latency_ms.p50, 1))
    return table


def _table(title: str) -> Table:
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        caption_justify="left",
        caption_style="",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )


def in_words(summary: Summary) -> str:
    """Return a replay's counts and times in one line."""
    lead = "with the arc map" if summary.use_arc_map else "without the arc map"
    text = f"{lead}: {summary.valid} of {summary.laser_on} frames with the laser on are valid"
    if summary.score is not None:
        text += f", {summary.score.beyond_limit} of them beyond {summary.score.limit_mm:g} mm"
    else:
        text += ", nothing to score against truth.csv"
    latency = summary.latency_ms
    return f"{text}; {_number(latency.p50, 1)} ms a frame, p99 {_number(latency.p99, 1)}"


def _map(summary: Summary) -> str:
    return "yes" if summary.use_arc_map else "no"


def _axis(axis: AxisScore) -> list[str]:
    whole = axis.whole
    values = [_number(value, 3) for value in (whole.rms, whole.median, whole.p95, whole.max)]
    return [*values, f"{axis.constant_mm:+.3f}", _number(axis.without_constant.rms, 3)]


def _short(score: TrackScore | None) -> list[str]:
    if score is None:
        return [NO_VALUE] * 7
    values = [
        value
        for axis in (score.lateral, score.vertical)
        for value in (axis.whole.rms, axis.whole.max, axis.without_constant.rms)
    ]
    return [*(_number(value, 3) for value in values), str(score.beyond_limit)]


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else NO_VALUE
