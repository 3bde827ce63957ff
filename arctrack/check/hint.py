"""Likeliest mistake in a recording, and its cure, in a line."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from arctrack.check.check_sample import CheckCase
from arctrack.check.explanations import WeighedCause, explanations, likely_causes

MAX_NAMED = 3
"""Number of causes that a hint names."""


@dataclass(frozen=True)
class Hint:
    """Likeliest mistake, its cure and its probability; `case` is the one without that mistake."""

    what: str
    cure: str
    probability: float
    case: CheckCase | None = None

    def __str__(self) -> str:
        return f"{self.what}; {self.cure}"


def likely_mistake(case: CheckCase) -> Hint | None:
    """Return the likeliest mistake, None where nothing, or nothing known, is wrong."""
    return hint_of(explanations(case))


def hint_of(ranked: Sequence[WeighedCause]) -> Hint | None:
    """Return the hint of explanations, the likeliest first; what explains the case as well is named too.

    A cure is named only where the tracker reads the frames with it.
    """
    likely = likely_causes(ranked) if ranked else []
    if not likely:
        return None
    best = ranked[0]
    mending = [each for each in likely if each.is_read]
    if not mending:
        cure = "with that alone mended the tracker does not read the frames: look for another mistake too"
        return Hint(best.seen + best.what, cure, best.probability, best.case)
    by_cure: dict[str, Hint] = {}
    for each in mending:
        what = each.what if by_cure else each.seen + each.what
        by_cure.setdefault(each.cure, Hint(what, each.cure, each.probability, each.case))
    return either([*by_cure.values()])


def either(hints: Sequence[Hint]) -> Hint | None:
    """Return the first hint; its cure names the others too, which explain a recording as well."""
    if not hints:
        return None
    first, *others = hints
    return replace(first, cure="; or else ".join([first.cure, *map(str, others[: MAX_NAMED - 1])]))
