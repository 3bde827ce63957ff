"""Costs of effects to the seam, in words and rows, for the terminal and for the pages."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from arctrack.diagnose.pages.words import NO_VALUE, summary
from sim_to_real.diagnosis import CostFlag, Diagnosis, DiagnosisVerdict, EffectCost, SeamShift

HARMLESS_SHARE = 0.1
"""Share of what the weld can bear below which a gap counts as moving the seam by nothing.

It is a tenth of `[tolerance] seam_mm`, 0.025 mm by default; twice as much would let a fifth pass unsaid.
"""

SHOWN_MM = 0.001
"""Shortest shift that is written as a number, mm: below, a tracker's steps show."""

FLAGS = {
    CostFlag.NO_SEAM: "the tracker finds no seam here, with or without it",
    CostFlag.SEAM_LOST: "the tracker loses the seam",
    CostFlag.NOT_RENDERED: "not computed: it shows in no expected frame, or takes seconds for each",
}
"""Reasons why a cost is unknown."""


@dataclass(frozen=True)
class CostRow:
    """A cost in a table: effect, shifts to the side and in height, mm, and what else is to be said.

    `lateral` and `vertical` are each the shift and its 95 % interval, which is empty for a bound.
    """

    id: str
    summary: str
    lateral: tuple[str, str]
    vertical: tuple[str, str]
    note: str
    is_named: bool


def harmless(diagnosis: Diagnosis, bears_mm: float) -> str:
    """Return that a gap moves the seam by next to nothing, if the weld bears `bears_mm`; or nothing.

    Of a cause that is not known nobody can say so.
    """
    costs = {cost.id: cost for cost in diagnosis.costs if not cost.is_bound}
    if diagnosis.verdict is DiagnosisVerdict.EFFECTS:
        together = [_max_mm(costs, [effect.id for effect in diagnosis.effects])]
    elif diagnosis.verdict is DiagnosisVerdict.AMBIGUOUS:
        together = [_max_mm(costs, ids) for ids in diagnosis.ambiguous_with]
    else:
        return ""
    max_mm = max(together, default=math.inf)
    if max_mm > HARMLESS_SHARE * bears_mm:
        return ""
    # Whole hundredths, rounded up.
    rounded_mm = max(math.ceil(100.0 * max_mm), 1) / 100.0
    return f"There is a gap, and it moves the seam by less than {rounded_mm:.2f} mm."


def _max_mm(costs: dict[str, EffectCost], ids: Sequence[str]) -> float:
    """Return the most that effects together shift the seam, mm; inf where that is not known."""
    return sum(costs[name].max_mm if name in costs else math.inf for name in ids) if ids else math.inf


def found_rows(costs: Sequence[EffectCost]) -> list[CostRow]:
    """Return the costs of what was found, the largest first."""
    return [_row(cost) for cost in costs if not cost.is_bound]


def bound_rows(costs: Sequence[EffectCost]) -> list[CostRow]:
    """Return the most that effects cost which were not found, the largest first."""
    return [_row(cost) for cost in costs if cost.is_bound]


def in_words(row: CostRow) -> str:
    """Return a row as a sentence."""
    side, height = (
        f"{size} mm" + (f" ({interval})" if interval else "")
        for size, interval in (row.lateral, row.vertical)
    )
    note = f"; {row.note}" if row.note else ""
    return f"{row.id} moves the seam {side} to the side and {height} in height{note}"


def largest_bound(costs: Sequence[EffectCost]) -> str:
    """Return which effect that was not found may cost most, in a sentence; nothing without any."""
    known = [cost for cost in costs if cost.is_bound and math.isfinite(cost.max_mm)]
    if not known:
        return ""
    most = max(known, key=lambda cost: cost.max_mm)
    size, _ = shift_text(SeamShift(math.nan, 0.0, most.max_mm, math.nan))
    return f"of what was not found {most.id} may cost most: {size} mm at the smallest size that would show"


def _row(cost: EffectCost) -> CostRow:
    note = FLAGS[cost.flag] if cost.flag is not None else ""
    if cost.flag is None and cost.n_lost:
        note = f"the tracker loses the seam in {cost.n_lost} of {cost.n_frames} frames"
    lateral, vertical = map(shift_text, (cost.lateral_mm, cost.vertical_mm))
    return CostRow(cost.id, summary(cost.id), lateral, vertical, note, cost.is_named)


def shift_text(shift: SeamShift) -> tuple[str, str]:
    """Return a shift, mm, or its bound, and its 95 % interval."""
    if not math.isfinite(shift.high):
        return NO_VALUE, ""
    if shift.high < SHOWN_MM:
        return f"< {SHOWN_MM:g}", ""
    if not math.isfinite(shift.value):
        return f"≤ {_mm(shift.high)}", ""
    return _mm(shift.value), f"{_mm(shift.low)} to {_mm(shift.high)}"


def _mm(value: float) -> str:
    return f"{value:.3f}" if value < 1.0 else f"{value:.2f}"
