"""The verdict from the posterior: no gap, named effects, an ambiguity set, or an unknown cause."""

from dataclasses import dataclass

from sim_to_real.diagnosis import DiagnosisVerdict
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior
from sim_to_real.evidence.policy import Policy


@dataclass(frozen=True, eq=False)
class Judgement:
    """A verdict: `leader` is the hypothesis whose fit is shown, `named` its effects that are named.

    Where an unknown cause acts beside effects, they are named, too. `ambiguous` holds the effects of the
    hypotheses that share the posterior where none is named.
    """

    verdict: DiagnosisVerdict
    leader: Hypothesis
    named: tuple[str, ...]
    ambiguous: tuple[tuple[str, ...], ...]


def judge(posterior: Posterior, policy: Policy) -> Judgement:
    """Return the verdict that a posterior gives.

    What leads decides between no gap, an unknown cause and effects. Effects are named whose probability,
    given that effects are the cause, is `policy.named`; where none is, the hypotheses that are
    `policy.possible` are a set. Beside an unknown cause the likeliest effects are named, none where it
    probably acts alone.
    """
    of_effects = sum(posterior.p)
    if posterior.p_none >= max(of_effects, posterior.p_unknown):
        return Judgement(DiagnosisVerdict.NO_GAP, posterior.none, (), ())
    if posterior.p_unknown > of_effects or not posterior.hypotheses:
        leader = posterior.likeliest_with_unknown
        return Judgement(DiagnosisVerdict.UNKNOWN, leader, leader.ids, ())
    weighed = list(zip(posterior.hypotheses, posterior.p, strict=True))
    likely = [hypothesis for hypothesis, p in weighed if p >= policy.possible * of_effects]
    sure = [name for name, p in posterior.of_effects.items() if p >= policy.named * of_effects]
    if sure or len(weighed) < 2:
        leader = next((h for h in likely if set(h.ids) == set(sure)), posterior.hypotheses[0])
        return Judgement(DiagnosisVerdict.EFFECTS, leader, tuple(sure or leader.ids), ())
    # Where the next ones are many and none of them likely, the first of these stands for them.
    undecided = likely if len(likely) > 1 else posterior.hypotheses[:2]
    members = tuple(dict.fromkeys(name for hypothesis in undecided for name in hypothesis.ids))
    return Judgement(DiagnosisVerdict.AMBIGUOUS, posterior.hypotheses[0], (), (members,))
