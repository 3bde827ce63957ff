"""The tables at the end of a replay."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich import box
from rich.table import Table

from arctrack.recording.results import Summary
from arctrack.recording.score import AxisScore, Score

NO_VALUE = "–"


def one_table(summaries: Sequence[Summary]) -> Table | str:
    """Return one recording's errors in full, a line an axis; `summaries` are its replays.

    Without truth, or without a valid frame, there is but a line of words.
    """
    first = summaries[0]
    words = f"{first.recording}: {first.valid} of {first.frames} frames valid"
    if first.score is None:
        return f"{words}, {_latency(first)} ms a frame; nothing to score against truth.csv"
    title = f"{words}; errors against truth.csv"
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    table.add_column("arc map")
    table.add_column("error, mm")
    for name in ("RMS", "median", "p95", "max", "constant part", "RMS without it"):
        table.add_column(name, justify="right")
    for name in ("valid", f"beyond {first.score.limit_mm:g} mm", "ms a frame"):
        table.add_column(name, justify="right")
    for summary in summaries:
        if summary.score is not None:
            lead = _map(summary)
            tail = [f"{summary.valid}/{summary.frames}", str(summary.score.beyond_limit), _latency(summary)]
            table.add_row(lead, "lateral", *_axis(summary.score.lateral), *tail)
            table.add_row("", "vertical", *_axis(summary.score.vertical))
    return table


def many_table(summaries: Sequence[Summary]) -> Table:
    """Return several recordings' errors in short, a row a replay."""
    scored = any(summary.score is not None for summary in summaries)
    table = Table(
        title="Seam error against truth.csv over valid frames, mm" if scored else "Replays",
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
    )
    table.add_column("recording", no_wrap=True)
    table.add_column("arc\nmap")
    table.add_column("valid", justify="right")
    if scored:
        for axis in ("lateral", "vertical"):
            for name in ("RMS", "max", "RMS*"):
                table.add_column(f"{axis}\n{name}", justify="right", no_wrap=True)
        table.add_column("beyond\nlimit", justify="right")
        table.caption = "RMS*: constant part removed"
        table.caption_justify = "left"
    table.add_column("ms a\nframe", justify="right")
    for summary in summaries:
        cells = [summary.recording, _map(summary), f"{summary.valid}/{summary.frames}"]
        if scored:
            cells += _short(summary.score)
        table.add_row(*cells, _latency(summary))
    return table


def _map(summary: Summary) -> str:
    return "yes" if summary.use_arc_map else "no"


def _latency(summary: Summary) -> str:
    return _number(summary.latency_ms.p50, 1)


def _axis(axis: AxisScore) -> list[str]:
    whole = axis.whole
    values = [_number(value, 3) for value in (whole.rms, whole.median, whole.p95, whole.max)]
    return [*values, f"{axis.constant_mm:+.3f}", _number(axis.without_constant.rms, 3)]


def _short(score: Score | None) -> list[str]:
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
