"""A decision checked against random effects and against frames held out of every fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from noise_model.effects import REGISTRY, Values
from sim_to_real.decision.decide import Decision, verdict_without_effects
from sim_to_real.diagnosis import CLEAR_FLOORS, Gap, Verdict
from sim_to_real.fit.trend import effects_at_ends
from sim_to_real.search.hypothesis import Hypothesis
from sim_to_real.search.probe_points import is_negligible
from sim_to_real.variance.random_effects import RandomEffects

COMPRESSION = "image_compression"
"""The random effect that needs no gap to be seen."""

MIN_RANDOM_SHARE = 0.5
"""Random effects explain a gap by themselves if they make up this share of it."""

STRONG_EVIDENCE_NATS = 15.0
"""Evidence above which a negligible effect is hardly the model's own error, nats.

A gap below the model's floor is its error all the same.
"""

MIN_P_IMPROVES, MIN_P_IMPROVES_STRONG = 0.975, 0.5
"""Probability with which an effect must improve held-out pixels; the second if its evidence is strong.

Edges that are not quite in place can hide an improvement.
"""

MIN_CLOSED = 0.5
"""The share of the gap on held-out frames that named effects must be able to close."""

MAX_FLOORS_AFTER = math.sqrt(2.0)
"""Named effects may leave so many floors, beside the error of their own form."""

MIN_VISIBLE_FLOORS = 3.0
"""A gap of so many floors in held-out pixels is one, even if bins show none: near a root bins are few.

Of 132 recordings of the blind check without any effect none has more than 1.2.
"""

JOINT_FORM_REL = 0.05
"""The error of form allowed to several effects: two or three can mimic most of another one's gap."""


def with_random_effects(decision: Decision, baseline: Hypothesis, random: RandomEffects) -> Decision:
    """Return the decision with random effects: named beside others, or alone if they are most of the gap."""
    if not random.effects or decision.verdict in (Verdict.EFFECTS, Verdict.AMBIGUOUS):
        return decision
    if decision.verdict is Verdict.UNKNOWN and sum(random_shares(random).values()) < MIN_RANDOM_SHARE:
        return decision
    return replace(decision, verdict=Verdict.EFFECTS, chosen=baseline)


def with_withheld(decision: Decision, random: RandomEffects, without: Sequence[str]) -> Decision:
    """Return the decision; unknown if the only gap is that of a random effect which is withheld.

    `random` are the random effects found with nothing withheld.
    """
    if decision.verdict is Verdict.NO_GAP and set(random.effects) & set(without):
        return replace(decision, verdict=Verdict.UNKNOWN)
    return decision


def with_compression(decision: Decision, baseline: Hypothesis, random: RandomEffects) -> Decision:
    """Return the decision with compression named wherever frames' own codes show it, gap or none."""
    if decision.verdict is Verdict.NO_GAP and COMPRESSION in random.effects:
        return replace(decision, verdict=Verdict.EFFECTS, chosen=baseline)
    return decision


def random_shares(random: RandomEffects) -> dict[str, float]:
    """Return each random effect's share of the excess of the mean of r^2 over noise."""
    return {name: 1.0 - (1.0 - random.closed[name]) ** 2 for name in random.effects}


def required_probability(decision: Decision, baseline: Hypothesis) -> float:
    """Return the probability with which the chosen effects must improve held-out pixels."""
    return MIN_P_IMPROVES_STRONG if _has_strong_evidence(decision, baseline) else MIN_P_IMPROVES


def _has_strong_evidence(decision: Decision, baseline: Hypothesis) -> bool:
    return decision.chosen.evidence - baseline.evidence >= STRONG_EVIDENCE_NATS


def without_unconfirmed(decision: Decision, baseline: Hypothesis, random: RandomEffects) -> Decision:
    """Return the decision if the chosen effects do not improve held-out frames."""
    return _without_chosen(decision, verdict_without_effects(baseline), baseline, random)


def names_negligible(
    decision: Decision, baseline: Hypothesis, gap: Gap, stated: Callable[[str], Values]
) -> bool:
    """Say whether named effects are so close to what is `stated` that they may be the model's own error."""
    fitted = decision.chosen.refit
    at_ends = effects_at_ends(fitted.effects, fitted.trend)
    is_small = _is_named(decision) and all(is_negligible(effects, stated) for effects in at_ends)
    is_clear = gap.before > CLEAR_FLOORS * gap.floor and baseline.cv_mean_square > 1.0
    may_be_error = gap.before <= gap.floor or not _has_strong_evidence(decision, baseline)
    return is_small and not is_clear and may_be_error


def without_negligible(decision: Decision, baseline: Hypothesis, random: RandomEffects) -> Decision:
    """Return the decision if the chosen effects are negligible."""
    return _without_chosen(decision, Verdict.NO_GAP, baseline, random)


def _without_chosen(
    decision: Decision, verdict: Verdict, baseline: Hypothesis, random: RandomEffects
) -> Decision:
    changed = replace(decision, verdict=verdict, chosen=baseline, ambiguous=())
    return with_random_effects(changed, baseline, random)


def _is_named(decision: Decision) -> bool:
    return bool(decision.chosen.ids) and decision.verdict in (Verdict.EFFECTS, Verdict.AMBIGUOUS)


def checked_on_holdout(decision: Decision, baseline: Hypothesis, gap: Gap) -> Decision:
    """Return the decision after the gap on held-out frames, before and after, has been measured.

    Named effects close too little if they surely close less than half of it, or if they leave more than the
    floor and the error of their form (`Effect.form_rel`) account for. Then the verdict is unknown; or no gap,
    if the baseline leaves no more than the floor. Random effects that are named alone must close as much. If
    nothing is named, a gap up to the floor is no gap. A gap of `MIN_VISIBLE_FLOORS` is never no gap.
    """
    checked = _checked_closing(decision, baseline, gap)
    if checked.verdict is Verdict.NO_GAP and gap.before >= MIN_VISIBLE_FLOORS * gap.floor:
        return replace(checked, verdict=Verdict.UNKNOWN)
    return checked


def _checked_closing(decision: Decision, baseline: Hypothesis, gap: Gap) -> Decision:
    ids, closes_too_little = decision.chosen.ids, gap.ci95[1] < MIN_CLOSED
    if gap.before <= gap.floor and not _is_named(decision):
        return replace(decision, verdict=Verdict.NO_GAP, ambiguous=())
    if not ids:
        is_random = decision.verdict is Verdict.EFFECTS
        return replace(decision, verdict=Verdict.UNKNOWN) if is_random and closes_too_little else decision
    form_rel = REGISTRY[ids[0]].form_rel if len(ids) == 1 else JOINT_FORM_REL
    leaves_too_much = gap.after > math.hypot(MAX_FLOORS_AFTER * gap.floor, form_rel * gap.before)
    if leaves_too_much or closes_too_little:
        verdict = Verdict.UNKNOWN if baseline.cv_mean_square > 1.0 else Verdict.NO_GAP
        return replace(decision, verdict=verdict, ambiguous=())
    return decision
