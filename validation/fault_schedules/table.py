"""Faults by what became of them, as a table, and each failure as the line that runs it again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

from validation.fault_schedules.kinds import KINDS
from validation.fault_schedules.schedules import ScheduleOutcome

HEADER = (
    "| fault | offsets end after, s | the tracker says | torch off by, mm | remark |\n"
    "| --- | --- | --- | --- | --- |"
)


def table(outcomes: Iterable[ScheduleOutcome]) -> str:
    """Return a Markdown table, a row for each fault.

    "Offsets end after" is when the last VALID or HELD offset was sent after the fault began: the median and
    the largest over its schedules. "go on" says in how many they did until its end.
    """
    by_fault: dict[str, list[ScheduleOutcome]] = {kind.name: [] for kind in KINDS}
    for outcome in outcomes:
        by_fault[outcome.fault].append(outcome)
    rows = [
        f"| {kind.name}{_failed(rows)} | {_ends(rows)} | {_said(rows)} | {_off(rows)} | {kind.note} |"
        for kind in KINDS
        if (rows := by_fault[kind.name])
    ]
    return "\n".join((HEADER, *rows))


def failures(seed: int, outcomes: Iterable[ScheduleOutcome]) -> Iterator[str]:
    """Yield a line for each schedule that failed: how it is run again, its fault, and what did not hold."""
    for outcome in outcomes:
        for broken in outcome.broken:
            yield f"--seed {seed} --only {outcome.number}: {outcome.fault}: {broken}"


def _failed(rows: Sequence[ScheduleOutcome]) -> str:
    n_failed = sum(bool(row.broken) for row in rows)
    return f", {n_failed} of {len(rows)} failed" if n_failed else ""


def _ends(rows: Sequence[ScheduleOutcome]) -> str:
    ended = sorted(row.stop_s for row in rows if math.isfinite(row.stop_s))
    go_on = len(rows) - len(ended)
    parts = [f"{ended[len(ended) // 2]:.2f}, {ended[-1]:.2f}"] if ended else []
    if go_on:
        parts.append("go on" if not ended else f"go on in {go_on}")
    return "; ".join(parts)


def _said(rows: Sequence[ScheduleOutcome]) -> str:
    """Return the reasons that at least a tenth of the schedules heard."""
    reasons = sorted(set().union(*(row.reasons for row in rows)))
    often = [name for name in reasons if sum(name in row.reasons for row in rows) * 10 >= len(rows)]
    return ", ".join(often)


def _off(rows: Sequence[ScheduleOutcome]) -> str:
    off_mm = sorted(row.torch_error_mm for row in rows)
    return f"{off_mm[len(off_mm) // 2]:.2f}, {off_mm[-1]:.2f}"
