"""The verdict from the posterior: no gap, named effects, an ambiguity set, or an unknown cause."""

from __future__ import annotations

from dataclasses import dataclass

from sim_to_real.diagnosis import Verdict
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior
from sim_to_real.evidence.policy import Policy


@dataclass(frozen=True, eq=False)
class Judgement:
    """A verdict: `leader` is the hypothesis whose fit is shown, `named` its effects that are named.

    `ambiguous` are the hypotheses, by their effects, that share the posterior where none is named.
    """

    verdict: Verdict
    leader: Hypothesis
    named: tuple[str, ...]
    ambiguous: tuple[tuple[str, ...], ...]


def judge(posterior: Posterior, policy: Policy) -> Judgement:
    """Return the verdict that a posterior gives.

    What leads decides between no gap, an unknown cause and effects. Effects are named whose probability,
    given that effects are the cause, is `policy.named`; where none is, the hypotheses that are
    `policy.possible` are a set.
    """
    of_effects = sum(posterior.p)
    if posterior.p_none >= max(of_effects, posterior.p_unknown):
        return Judgement(Verdict.NO_GAP, posterior.none, (), ())
    if posterior.p_unknown > of_effects or not posterior.hypotheses:
        return Judgement(Verdict.UNKNOWN, posterior.none, (), ())
    sure = [name for name, p in posterior.of_effects.items() if p >= policy.named * of_effects]
    leader = next((h for h in posterior.hypotheses if set(h.ids) == set(sure)), posterior.hypotheses[0])
    if sure:
        return Judgement(Verdict.EFFECTS, leader, tuple(sure), ())
    likely = [
        h.ids
        for h, p in zip(posterior.hypotheses, posterior.p, strict=True)
        if p >= policy.possible * of_effects
    ]
    members = tuple(dict.fromkeys(name for ids in likely for name in ids))
    return Judgement(Verdict.AMBIGUOUS, leader, (), (members,))
