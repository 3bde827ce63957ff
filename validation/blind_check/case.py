"""A recording of the blind check: what it hides, what was answered, what the baseline says."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from noise_model.effects import REGISTRY
from sim_to_real.decision.experiments import MENU

FAILED = "failed"
"""Stands for the verdict of a recording without a diagnosis."""

VERDICTS = ("effects", "ambiguous", "unknown", "no_gap", FAILED)

MIN_CLEAR_FLOORS = 3.0
"""A gap of so many floors is one that must be found."""

MIN_CLOSED = 0.9
"""Effects that close less of the held-out gap are not all that acts."""

MIN_SURE = 0.95
"""A wrong name with a larger confidence misleads its reader."""


@dataclass(frozen=True)
class Answer:
    """What a diagnosis said: the `verdict`, the effects that it `named`, the largest share first.

    `ranked` are the candidates, best first, `closes` the share of the gap that each closes by itself,
    `confidence` that of the `best`. `gap_before`, `gap_floor` and `gap_closed` are of held-out frames, NaN
    where not known; `unresolvable` pairs were declared so before any fit. `experiment` is what is to be
    measured next, "" for nothing, and `separates` what it would tell apart. `alike` are the effects of an
    ambiguous verdict's sets. Times are wall and processor. A `problem` says why there is no diagnosis.
    """

    verdict: str
    named: tuple[str, ...] = ()
    ranked: tuple[str, ...] = ()
    confidence: float = math.nan
    closes: Mapping[str, float] = field(default_factory=dict)
    stage: str = ""
    gap_before: float = math.nan
    gap_floor: float = math.nan
    gap_closed: float = math.nan
    unresolvable: frozenset[frozenset[str]] = frozenset()
    experiment: str = ""
    separates: tuple[str, ...] = ()
    alike: tuple[str, ...] = ()
    wall_s: float = math.nan
    cpu_s: float = math.nan
    problem: str = ""

    @property
    def first(self) -> str | None:
        """The effect that the verdict names first."""
        return self.named[0] if self.named else None

    @property
    def best(self) -> str | None:
        """The effect that is named first, or ranked first where none is named."""
        return next(iter((*self.named, *self.ranked)), None)

    @property
    def asks_for_witness(self) -> bool:
        """Whether what is to be measured next is none of the experiments."""
        return bool(self.experiment) and all(self.experiment != known.name for known in MENU)

    @property
    def alone(self) -> str | None:
        """The effect that the verdict names alone and for sure."""
        return self.named[0] if self.verdict == "effects" and len(self.named) == 1 else None

    @property
    def is_for_sure(self) -> bool:
        """Whether effects are named for sure: nothing unknown acts beside them."""
        return self.verdict == "effects"

    @property
    def says_more_than_it_closes(self) -> bool:
        """Whether effects are named for sure that leave a part of the gap open."""
        return self.is_for_sure and self.gap_closed < MIN_CLOSED

    @property
    def acting(self) -> frozenset[str]:
        """The effects that are said to act, alone or beside something unknown; of a set none is."""
        return frozenset() if self.verdict == "ambiguous" else frozenset(self.named)

    @property
    def is_clear(self) -> bool:
        """Whether the gap is one that must be found."""
        return self.gap_before >= MIN_CLEAR_FLOORS * self.gap_floor

    @property
    def says_gap(self) -> bool:
        """Whether a gap was found at all."""
        return self.verdict in ("effects", "ambiguous", "unknown")


@dataclass(frozen=True)
class Case:
    """A recording: its hidden `effects`, the answer, and the cosine baseline's effects, best first.

    `again` is the answer with the effect withheld that the first one named alone, None if it named none;
    `longer` that to the recording with the frames of the experiment it asked for, None if there are none.
    """

    name: str
    tier: str
    effects: tuple[str, ...]
    answer: Answer
    cosines: tuple[tuple[str, float], ...] = ()
    again: Answer | None = None
    longer: Answer | None = None

    @property
    def cosine_first(self) -> str | None:
        """What the baseline answers."""
        return self.cosines[0][0] if self.cosines else None

    @property
    def named_first(self) -> bool:
        """Whether the verdict names the hidden effect, or one of them, first."""
        return self.answer.first in self.effects

    @property
    def named_first_for_sure(self) -> bool:
        """Whether it is, and nothing unknown is said to act beside it."""
        return self.named_first and self.answer.verdict != "unknown"

    @property
    def names_all(self) -> bool:
        """Whether the hidden effects and no other are said to act, alone or beside something unknown."""
        return self.answer.acting == set(self.effects)

    @property
    def names_no_wrong(self) -> bool:
        """Whether some effect is said to act, and none that is not hidden."""
        return bool(self.answer.acting) and self.answer.acting <= set(self.effects)

    @property
    def names_false_second(self) -> bool:
        """Whether an effect that is not hidden is said to act next to a hidden one."""
        acting = self.answer.acting
        return not acting.isdisjoint(self.effects) and not acting <= set(self.effects)

    @property
    def is_truly_withheld(self) -> bool:
        """Whether the recording was diagnosed again without the very effect that it hides."""
        return self.again is not None and self.effects == (self.answer.alone,)

    @property
    def in_question(self) -> bool:
        """Whether the verdict is a set of effects that look the same, and the hidden one is in it."""
        return self.answer.verdict == "ambiguous" and not set(self.answer.alike).isdisjoint(self.effects)

    @property
    def is_wrongly_sure(self) -> bool:
        """Whether the verdict names, for sure, an effect first that is not hidden."""
        return self.answer.verdict == "effects" and not self.named_first

    @property
    def in_best_three(self) -> bool:
        """Whether a gap was found and the hidden effect is of the first three, named before ranked."""
        first_three = list(dict.fromkeys((*self.answer.named, *self.answer.ranked)))[:3]
        return self.answer.says_gap and self.effects[0] in first_three

    @property
    def best_is_hidden(self) -> bool:
        """Whether what is named first, or ranked first where nothing is named, is hidden."""
        return self.answer.best in self.effects

    @property
    def cosine_named_first(self) -> bool:
        """Whether the baseline answers the hidden effect, or one of them."""
        return self.cosine_first in self.effects

    @property
    def cosine_in_best_three(self) -> bool:
        """Whether the hidden effect is among the baseline's three best."""
        return self.effects[0] in [name for name, _ in self.cosines[:3]]

    @property
    def asks_for_hidden(self) -> bool:
        """Whether an experiment was asked for that would tell a hidden effect from another."""
        return bool(self.answer.experiment) and not set(self.answer.separates).isdisjoint(self.effects)

    @property
    def is_resolved(self) -> bool:
        """Whether the experiment's answer names the hidden effect first and for sure; of two, both alone."""
        if self.longer is None or self.longer.verdict != "effects":
            return False
        if len(self.effects) > 1:
            return set(self.longer.named) == set(self.effects)
        return self.longer.first in self.effects

    def is_unresolvable(self, named: Iterable[str]) -> bool:
        """Say whether a hidden effect and one of those named were a pair declared not resolvable."""
        pairs = self.answer.unresolvable
        return any(frozenset((hidden, name)) in pairs for hidden in self.effects for name in named)


def stage_of(effect: str | None) -> str | None:
    """Return the stage at which an effect acts."""
    return None if effect is None else REGISTRY[effect].stage.value
