"""What becomes of a decision when what scatters, and frames held out of everything, have been asked."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from noise_model.effects import REGISTRY, Values
from sim_to_real.decision.decide import Decision, without_help
from sim_to_real.diagnosis import CLEAR_FLOORS, Gap, Verdict
from sim_to_real.fit.trend import ends_of
from sim_to_real.search.hypothesis import Candidate
from sim_to_real.search.probe_points import is_trifle
from sim_to_real.variance.random_effects import Scatter

MOSTLY_RANDOM = 0.5
"""A gap that nothing else explains is that of random effects if they make up this share of it."""

MANY_NATS = 15.0
"""With so much more evidence than its absence an effect hardly is the model's own error, though a trifle.

Unless the gap is below the model's floor: that is its error.
"""

HELPS, HELPS_BESIDE = 0.975, 0.5
"""So surely an effect must help in pixels held out, and so surely one of `MANY_NATS`: an edge can hide it."""

CLOSES = 0.5
"""The share of the gap on frames held out that effects must be able to close if they are named."""

FLOORS_LEFT = math.sqrt(2.0)
"""What is named may leave so many floors besides what its form may be off: the model's own and as much."""

SEEN_FLOORS = 3.0
"""A gap of so many floors in pixels held out is one, whatever bins say: near a root they are few.

Of 132 recordings of the blind check without any effect none has more than 1.2.
"""

SEVERAL_REL = 0.05
"""Of several effects no form may be off by more: two or three mimic most of another one's gap."""


def with_random(decision: Decision, baseline: Candidate, random: Scatter) -> Decision:
    """Return the verdict with what scatters: it is named beside others, or alone if it is most of the gap."""
    if not random.effects or decision.verdict in (Verdict.EFFECTS, Verdict.AMBIGUOUS):
        return decision
    if decision.verdict is Verdict.UNKNOWN and sum(random_shares(random).values()) < MOSTLY_RANDOM:
        return decision
    return replace(decision, verdict=Verdict.EFFECTS, chosen=baseline)


def with_withheld(decision: Decision, random: Scatter, without: Sequence[str]) -> Decision:
    """Return the verdict; unknown if there is no gap but in what scatters, whose effect is withheld.

    `random` is what scatters if nothing is withheld.
    """
    if decision.verdict is Verdict.NO_GAP and set(random.effects) & set(without):
        return replace(decision, verdict=Verdict.UNKNOWN)
    return decision


def random_shares(random: Scatter) -> dict[str, float]:
    """Return the share of the mean of r^2 beyond noise that each random effect makes up."""
    return {name: 1.0 - (1.0 - random.closed[name]) ** 2 for name in random.effects}


def must_help(decision: Decision, baseline: Candidate) -> float:
    """Return how surely pixels held out must be predicted better with what was chosen."""
    return HELPS_BESIDE if _has_many_nats(decision, baseline) else HELPS


def _has_many_nats(decision: Decision, baseline: Candidate) -> bool:
    return decision.chosen.evidence - baseline.evidence >= MANY_NATS


def not_held_up(decision: Decision, baseline: Candidate, random: Scatter) -> Decision:
    """Return the verdict if what was chosen closes nothing in frames that nothing was fitted to."""
    return _without_chosen(decision, without_help(baseline), baseline, random)


def names_trifle(decision: Decision, baseline: Candidate, gap: Gap, stated: Callable[[str], Values]) -> bool:
    """Say whether what is named is a trifle, from what is `stated`, that the model's own error looks like."""
    fitted = decision.chosen.refit
    ends = ends_of(fitted.effects, fitted.change)
    is_small = _is_named(decision) and all(is_trifle(of, stated) for of in ends)
    is_clear = gap.before > CLEAR_FLOORS * gap.floor and baseline.left > 1.0
    may_be_error = gap.before <= gap.floor or not _has_many_nats(decision, baseline)
    return is_small and not is_clear and may_be_error


def without_trifle(decision: Decision, baseline: Candidate, random: Scatter) -> Decision:
    """Return the verdict if what was chosen is a trifle."""
    return _without_chosen(decision, Verdict.NO_GAP, baseline, random)


def _without_chosen(decision: Decision, verdict: Verdict, baseline: Candidate, random: Scatter) -> Decision:
    found = replace(decision, verdict=verdict, chosen=baseline, ambiguous=())
    return with_random(found, baseline, random)


def _is_named(decision: Decision) -> bool:
    return bool(decision.chosen.ids) and decision.verdict in (Verdict.EFFECTS, Verdict.AMBIGUOUS)


def closing(decision: Decision, baseline: Candidate, gap: Gap) -> Decision:
    """Return the verdict if what is named closes too little of the gap held out.

    That is surely less than half. It is too little, too, if more is left than the floor and the effect's
    form, see `Effect.form_rel`, account for. It is unknown then; or no gap, if the baseline leaves no more
    than the model may be off. A gap that is no larger than the floor is none if nothing is named, and one of
    `SEEN_FLOORS` is none for nobody. What scatters and is named alone must close as much.
    """
    found = _closing(decision, baseline, gap)
    if found.verdict is Verdict.NO_GAP and gap.before >= SEEN_FLOORS * gap.floor:
        return replace(found, verdict=Verdict.UNKNOWN)
    return found


def _closing(decision: Decision, baseline: Candidate, gap: Gap) -> Decision:
    ids, closes_too_little = decision.chosen.ids, gap.ci95[1] < CLOSES
    if gap.before <= gap.floor and not _is_named(decision):
        return replace(decision, verdict=Verdict.NO_GAP, ambiguous=())
    if not ids:
        is_random = decision.verdict is Verdict.EFFECTS
        return replace(decision, verdict=Verdict.UNKNOWN) if is_random and closes_too_little else decision
    form_rel = REGISTRY[ids[0]].form_rel if len(ids) == 1 else SEVERAL_REL
    is_left = gap.after > math.hypot(FLOORS_LEFT * gap.floor, form_rel * gap.before)
    if is_left or closes_too_little:
        verdict = Verdict.UNKNOWN if baseline.left > 1.0 else Verdict.NO_GAP
        return replace(decision, verdict=verdict, ambiguous=())
    return decision
