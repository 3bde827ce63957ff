"""Hypotheses about a gap with their log evidence, and the posterior over all of them.

No gap; one effect of the catalogue, or several; an unknown cause at one of the stages. All are compared by
one quantity. An effect's form may be off: its evidence is the mean over a form that is exact and one that is
off by a share of what the effect does (`Effect.form_rel`). An unknown cause is any smooth function of the
coordinates of some stage, of any of several sizes. It may act alone or with effects. Two effects that mimic
a third one leave much that an additional unknown cause explains.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.special import logsumexp

from noise_model.compiled.arrays import Float64
from noise_model.effects.effect import Stage
from sim_to_real.evidence.error_model import LinearHypothesis
from sim_to_real.evidence.policy import Policy
from sim_to_real.fit.gauss_newton import Refit

Term: TypeAlias = tuple[Stage | None, str]
"""A free term's stage and name."""


@dataclass(frozen=True)
class UnknownCause:
    """An unknown cause: the log evidence, nats, of each free term, by stage and name."""

    terms: Mapping[Term, float]

    @property
    def evidence(self) -> float:
        """The log evidence, nats, all terms equally probable."""
        return float(logsumexp(list(self.terms.values())) - math.log(len(self.terms)))

    @property
    def likeliest(self) -> Term:
        """The likeliest term's stage and name."""
        return max(self.terms, key=lambda term: self.terms[term])

    def stages(self, temperature: float) -> dict[str, float]:
        """Return the probability of each stage: that of all its terms together, equally probable before.

        The evidence counts divided by the temperature, as it does in a `Posterior`.
        """
        of_stage: dict[str, list[float]] = {}
        for (stage, _), nats in self.terms.items():
            if stage is not None:
                of_stage.setdefault(stage.value, []).append(nats)
        ln = np.array([logsumexp(nats) for nats in of_stage.values()]) / temperature
        return dict(zip(of_stage, np.exp(ln - logsumexp(ln)).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Effects fitted together; none is no gap.

    `exact` is the log evidence of the effects' own form, `off` that of a form that may be off, nats.
    `neutral` is no gap about the same nuisances, `fewer` the evidence there of these effects without one.
    `with_unknown` is an unknown cause in addition to the effects, where it was searched. `changes` (n,) are
    what each effect whose form may be off does.
    """

    refit: Refit
    exact: float
    off: float
    neutral: LinearHypothesis
    fewer: Mapping[frozenset[str], float]
    with_unknown: UnknownCause | None = None
    changes: Mapping[str, Float64] = field(default_factory=dict)

    @property
    def ids(self) -> tuple[str, ...]:
        """The effects."""
        return self.refit.ids

    @property
    def evidence(self) -> float:
        """The log evidence, nats, the form exact or off with equal probability."""
        return float(np.logaddexp(self.exact, self.off) - math.log(2.0))


@dataclass(frozen=True, eq=False)
class Posterior:
    """The probabilities of no gap, of hypotheses with effects, likeliest first, and of an unknown cause.

    `p_with_unknown` are those of each hypothesis' effects with an unknown cause, `p_alone` that of such a
    cause alone.
    """

    none: Hypothesis
    hypotheses: tuple[Hypothesis, ...]
    unknown: UnknownCause
    p_none: float
    p: tuple[float, ...]
    p_with_unknown: tuple[float, ...]
    p_alone: float

    @property
    def p_unknown(self) -> float:
        """The probability that an unknown cause acts, alone or with effects."""
        return self.p_alone + sum(self.p_with_unknown)

    @classmethod
    def of(
        cls,
        none: Hypothesis,
        hypotheses: Sequence[Hypothesis],
        unknown: UnknownCause,
        n_effects: int,
        policy: Policy,
    ) -> "Posterior":
        """Weigh hypotheses by evidence and prior odds; `n_effects` share the odds of one effect evenly.

        The same effects constant, and as they change in the course of a weld, share their odds too.
        """
        forms = Counter(frozenset(hypothesis.ids) for hypothesis in hypotheses)

        def weight(hypothesis: Hypothesis, nats: float) -> float:
            n = len(hypothesis.ids)
            ln_odds = policy.ln_odds_effect + (n - 1) * policy.ln_odds_further - n * math.log(n_effects)
            return nats / policy.temperature + ln_odds - math.log(forms[frozenset(hypothesis.ids)])

        ln_odds_added = policy.ln_odds_further + policy.ln_odds_unknown
        some = sorted(hypotheses, key=lambda h: weight(h, h.evidence), reverse=True)
        ln = [
            none.evidence / policy.temperature,
            *(weight(h, h.evidence) for h in some),
            *(
                -math.inf if h.with_unknown is None else weight(h, h.with_unknown.evidence) + ln_odds_added
                for h in some
            ),
            unknown.evidence / policy.temperature + policy.ln_odds_unknown,
        ]
        p_none, *p, p_alone = np.exp(np.array(ln) - logsumexp(ln)).tolist()
        return cls(none, tuple(some), unknown, p_none, tuple(p[: len(some)]), tuple(p[len(some) :]), p_alone)

    @property
    def singles(self) -> dict[str, tuple[Hypothesis, float]]:
        """Each effect by itself with its probability, likeliest first; of several forms the likeliest."""
        singles: dict[str, tuple[Hypothesis, float]] = {}
        for hypothesis, probability in zip(self.hypotheses, self.p, strict=True):
            if len(hypothesis.ids) == 1:
                singles.setdefault(hypothesis.ids[0], (hypothesis, probability))
        return singles

    @property
    def of_effects(self) -> dict[str, float]:
        """The probability that each effect is there, alone or with others, and nothing unknown."""
        return self._of_each(self.p)

    @property
    def of_each(self) -> dict[str, float]:
        """The probability that each effect is there, whatever else is."""
        return self._of_each([sum(both) for both in zip(self.p, self.p_with_unknown, strict=True)])

    @property
    def likeliest_with_unknown(self) -> Hypothesis:
        """The effects beside which an unknown cause most probably acts; no gap where it acts alone."""
        every = zip((self.p_alone, *self.p_with_unknown), (self.none, *self.hypotheses), strict=True)
        return max(every, key=lambda pair: pair[0])[1]

    def _of_each(self, probabilities: Sequence[float]) -> dict[str, float]:
        total: dict[str, float] = {}
        for hypothesis, probability in zip(self.hypotheses, probabilities, strict=True):
            for name in hypothesis.ids:
                total[name] = total.get(name, 0.0) + probability
        return total
