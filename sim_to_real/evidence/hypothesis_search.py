"""Which hypotheses are fitted: those that could still change the posterior.

A first look, without a fit, gives every effect's evidence along its probe points, and every pair's. Effects
are fitted in that order until the next one is too far behind. Beside the likeliest ones, and in pairs that
explain more than any single effect, further effects are fitted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY, Stage, Values
from noise_model.fit import within_bounds
from sim_to_real.evidence.coordinates import IN_EACH_FRAME
from sim_to_real.evidence.error_model import Columns, ErrorModel, EvidenceTable, Linearized
from sim_to_real.evidence.hypotheses import Hypothesis, Unknown
from sim_to_real.evidence.policy import Policy
from sim_to_real.fit.gauss_newton import FLICKER, Refit, refit, refit_from
from sim_to_real.fit.linearized_model import INTERREFLECTION, RENDERED_EFFECTS, Effects, LinearizedModel
from sim_to_real.fit.trend import MIN_DRIVER_RANGE, TREND_EFFECTS, Driver, Trend, trend_among
from sim_to_real.search.probe_points import EXPENSIVE
from sim_to_real.search.score_test import ScoreTest

MAX_SINGLES, MAX_PAIRS = 10, 3
"""So many effects are fitted at most, and so many pairs."""

MAX_ROUNDS, SETTLED_NATS = 4, 1.0
"""Light is rendered anew at a fit so often at most, as long as the evidence gains so many nats."""

Pairs = dict[frozenset[str], tuple[float, Mapping[str, Values]]]
"""Pairs of effects: what they gain at a first look, nats, and where their fit starts."""

SURPRISE_NATS = 4.0
"""By so many nats a fit may beat its first look even where the gap is small."""

MUCH_SURPRISE, LITTLE_SURPRISE, FLOOR_MEAN_SQUARE = 0.7, 0.3, 1.0
"""And by this share of what the best look gains; the second once a fit leaves no more than the floor."""

BOUNCES = Stage.SURFACE, Stage.MEDIUM, Stage.OPTICS
"""The stages whose free terms come near light that bounces: no fit of it is likelier than all of them."""

STARTS_OF_STAND_INS: Mapping[str, Sequence[Values]] = {
    FLICKER: (REGISTRY[FLICKER].neutral,),
    INTERREFLECTION: (EXPENSIVE[INTERREFLECTION],),
}
"""Where fits of effects without probe points start."""

FAMILIES_IN_PAIRS = 2
"""So many families of each effect are looked at in pairs."""


@dataclass(frozen=True, eq=False)
class HypothesisSearch:
    """Fits hypotheses of a recording: `model` with tangents at `start`, a fit without effects.

    `scores` are the effects' at the start, `errors` the recording's error model.
    """

    model: LinearizedModel
    start: Refit
    scores: Sequence[ScoreTest]
    errors: ErrorModel
    policy: Policy
    without: Sequence[str]
    on_stage: Callable[[str, float], None]

    def hypothesis(self, fitted: Refit) -> Hypothesis:
        """Return a fit with its evidence, and with that of fewer effects about the same nuisances."""
        rows = self.errors.rows
        linear = Linearized.of(fitted, rows)
        exact = self.errors.log_evidence(linear)
        if not fitted.ids:
            return Hypothesis(fitted, exact, exact, linear, {})
        at_none = self._residuals_with(fitted, {})
        form_errors, fewer = [], {}
        for name in fitted.ids:
            others = {other: values for other, values in fitted.effects.items() if other != name}
            residuals = self._residuals_with(fitted, others) if others else at_none
            if others:
                without = Linearized.without(fitted, name, residuals, rows)
                fewer[frozenset(others)] = self.errors.log_evidence(without)
            if name != FLICKER:
                form_errors.append(self.errors.form_error(name, (fitted.residuals - residuals)[rows]))
        off = self.errors.log_evidence(linear, *form_errors) if form_errors else exact
        return Hypothesis(fitted, exact, off, Linearized.without(fitted, None, at_none, rows), fewer)

    def _residuals_with(self, fitted: Refit, effects: Effects) -> Float64:
        """Return the residuals (n,) at a fit's nuisances with some of its effects."""
        trend = trend_among(fitted.trend, effects)
        return self.model.residuals(self.model.lights(fitted.nuisance, effects, trend))

    def none(self, before: Hypothesis, others: Iterable[Hypothesis]) -> Hypothesis:
        """Return no gap, about the nuisances of whichever fit makes it likeliest.

        Every fit renders light anew at its nuisances. Only about the same ones is no gap compared fairly.
        """
        about = [hypothesis.neutral for hypothesis in (before, *others)]
        evidence = [self.errors.log_evidence(neutral) for neutral in about]
        best = int(np.argmax(evidence))
        return Hypothesis(before.refit, evidence[best], evidence[best], about[best], {})

    @staticmethod
    def compared(every: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return hypotheses as likely as any fit makes them: another one may know nuisances better."""
        fewer = [(names, nats) for hypothesis in every for names, nats in hypothesis.fewer.items()]
        return [
            replace(h, exact=max([h.exact, *(nats for names, nats in fewer if names == frozenset(h.ids))]))
            for h in every
        ]

    def free_terms_beside(self, hypothesis: Hypothesis) -> EvidenceTable:
        """Return the evidence of each free term about a hypothesis' nuisances."""
        blocks = [Columns.free(term.columns) for term in self.errors.free_terms]
        return self.errors.table(hypothesis.neutral, blocks)

    def unknown(self, tables: Sequence[EvidenceTable]) -> Unknown:
        """Return an unknown cause: each free term in whichever of some tables makes it likeliest."""
        sizes = self.policy.free_sizes
        terms: dict[tuple[Stage, str], float] = {}
        for n, term in enumerate(self.errors.free_terms):
            each = [max(table.log_evidence(n, size=size) for table in tables) for size in sizes]
            terms[term.stage, term.name] = float(np.logaddexp.reduce(each) - np.log(len(sizes)))
        return Unknown(terms)

    def singles(self, none: Hypothesis, unknown: Unknown) -> list[Hypothesis]:
        """Return the single effects whose fit could change the posterior, likeliest first.

        A fit gains on its first look by what is not linear, which is little where the gap is small.
        """
        looks = {score.id: self._look(score) - self._none_at_start for score in self.scores}
        looks |= {name: look - none.evidence for name, look in self._stand_ins(unknown).items()}
        starts: dict[str, Sequence[Values]] = {**STARTS_OF_STAND_INS}
        starts |= {score.id: score.starts for score in self.scores}
        fitted: list[Hypothesis] = []
        for n, name in enumerate(sorted(looks, key=lambda name: -looks[name])):
            gained = max((hypothesis.evidence - none.evidence for hypothesis in fitted), default=0.0)
            at_floor = any(hypothesis.refit.mean_square < FLOOR_MEAN_SQUARE for hypothesis in fitted)
            share = LITTLE_SURPRISE if at_floor else MUCH_SURPRISE
            if n == MAX_SINGLES or looks[name] < self._needed((1.0 - share) * max(looks.values())):
                break
            if name == INTERREFLECTION and looks[name] < gained:
                continue
            self.on_stage(f"fitting {name}", 0.2 + 0.6 * n / MAX_SINGLES)
            fitted.append(self.hypothesis(self._fitted(name, starts[name])))
        settled = self._settled(fitted, none)
        trends = [trend for single in settled[:1] for trend in self._with_trends(single)]
        return sorted([*trends, *settled], key=lambda hypothesis: -hypothesis.evidence)

    @cached_property
    def _none_at_start(self) -> float:
        """The evidence of no gap about the start: what looks from there gain on."""
        return self.errors.log_evidence(self._at_start)

    def _needed(self, near_best: float) -> float:
        """Return the gain over no gap from which on a fit could still change the posterior, nats.

        It must come near the best one, and make up for its prior odds.
        """
        return max(near_best, self._nats(self.policy.ln_odds_effect)) - SURPRISE_NATS

    def _nats(self, ln_odds: float) -> float:
        """Return the evidence, nats, that makes up for the prior odds of one more effect of the catalogue."""
        return self.policy.temperature * (float(np.log(max(len(self.scores), 1))) - ln_odds)

    def _settled(self, fitted: Sequence[Hypothesis], none: Hypothesis) -> list[Hypothesis]:
        """Return hypotheses, likeliest first, of which those that may be the likeliest have settled."""
        every = sorted(fitted, key=lambda hypothesis: -hypothesis.evidence)
        for n, hypothesis in enumerate(every):
            gained = max(other.evidence for other in every) - none.evidence
            if hypothesis.evidence - none.evidence >= self._needed((1.0 - LITTLE_SURPRISE) * gained):
                every[n] = self.settled(hypothesis)
        return sorted(every, key=lambda hypothesis: -hypothesis.evidence)

    def _with_trends(self, single: Hypothesis) -> list[Hypothesis]:
        """Return an effect whose size changes in the course of a weld, where its form seems to be off."""
        name, fit, observed = single.ids[0], single.refit, self.model.observed
        if name not in TREND_EFFECTS or single.off < single.exact:
            return []
        fitted = []
        for driver in Driver:
            trend = Trend.of(observed, name, driver)
            if trend.half_range > MIN_DRIVER_RANGE:
                self.on_stage(f"fitting {name} that changes with {driver.value}", 0.8)
                changing = refit(self.model, fit.effects, fit.nuisance, trend=trend)
                fitted.append(self.settled(self.hypothesis(changing)))
        return fitted

    def _stand_ins(self, unknown: Unknown) -> dict[str, float]:
        """Return the first looks of effects that have no probe points: free terms stand in for them.

        Those are a level of the arc for each frame, and light that bounces, which takes longer to compute
        than all other effects together.
        """
        shows_arc = int(self.model.observed.shows_arc.sum())
        is_flat = self.model.observed.setup.joint.type == "flat"
        looks = {}
        if shows_arc > 2:
            looks[FLICKER] = unknown.terms[Stage.SOURCE, IN_EACH_FRAME]
        if shows_arc > 0 and not is_flat:
            # Light that bounces is a function of several stages' coordinates: any of them may come nearest.
            looks[INTERREFLECTION] = max(unknown.terms[term] for term in unknown.terms if term[0] in BOUNCES)
        return {name: look for name, look in looks.items() if name not in self.without}

    def _fitted(self, name: str, starts: Sequence[Values]) -> Refit:
        """Return the best fit of an effect from some starts."""
        # Rendering at every step is expensive: such a fit is started once.
        tried = starts[:1] if name in RENDERED_EFFECTS else starts
        fits = [refit_from(self.model, self.start, {name: values}) for values in tried]
        return min(fits, key=lambda fit: fit.mean_square)

    def settled(self, best: Hypothesis) -> Hypothesis:
        """Return a hypothesis about its likeliest parameters: Gauss-Newton steps, light rendered anew.

        A fit weighs all bins alike. The error model's metric is stricter where it knows how images go wrong.
        """
        if FLICKER in best.ids:
            return best
        for _ in range(MAX_ROUNDS):
            again = self.hypothesis(self._stepped(best.refit))
            if again.exact < best.exact + SETTLED_NATS:
                return max(best, again, key=lambda hypothesis: hypothesis.exact)
            best = again
        return best

    def _stepped(self, fitted: Refit) -> Refit:
        """Return the model at the parameters that are likeliest by a fit's derivatives."""
        parameters = fitted.quadratic.parameters
        starts, sigmas = np.array([(p.start, p.prior_sigma) for p in parameters]).T
        sizes = self.errors.likeliest(Linearized.of(fitted, self.errors.rows))
        x = within_bounds(parameters, starts + sigmas * sizes)
        nuisance, effects, trend = fitted.split_parameters(x)
        there = self.model.anchored_at(nuisance, effects, trend)
        return refit(there, effects, nuisance, steps=0, trend=trend)

    def _look(self, score: ScoreTest) -> float:
        """Return the evidence along an effect's probe points, the best family's, its form exact or off."""
        first = self._first_family(score)
        exact = [self._probes.log_evidence(first + n) for n in range(len(score.families))]
        best = self._columns[first + int(np.argmax(exact))]
        form = self.errors.form_error(score.id, best.changes.sum(axis=1))
        return max(max(exact), self.errors.log_evidence(self._at_start, best, form))

    @cached_property
    def _at_start(self) -> Linearized:
        return Linearized.of(self.start, self.errors.rows)

    @cached_property
    def _families(self) -> list[ScoreTest]:
        """All effects' families, an effect's after another's."""
        return [family for score in self.scores for family in score.families]

    @cached_property
    def _columns(self) -> list[Columns]:
        return [Columns.along_probes(family, self.errors.rows) for family in self._families]

    @cached_property
    def _probes(self) -> EvidenceTable:
        """The evidence of all families at the start."""
        return self.errors.table(self._at_start, self._columns)

    def _first_family(self, score: ScoreTest) -> int:
        """Return the place of an effect's first family among all."""
        return next(n for n, family in enumerate(self._families) if family.id == score.id)

    def pairs(self, singles: Sequence[Hypothesis], none: Hypothesis) -> list[Hypothesis]:
        """Return fits of the pairs of effects that explain more than any single effect does, by a first look.

        If two effects of similar size act together, the likeliest single effect is often a third one that
        mimics both. So pairs are looked at on their own, and beside the likeliest single effect.
        """
        if not singles:
            return []
        starts = {**self._pairs_beside(singles[0]), **self._pairs_alone()}
        ranked = sorted(starts.items(), key=lambda item: -item[1][0])
        fitted = []
        for names, (_, effects) in ranked[:MAX_PAIRS]:
            self.on_stage(f"fitting {' and '.join(sorted(names))}", 0.8)
            fitted.append(self.hypothesis(refit_from(self.model, self.start, effects)))
        settled = self._settled(fitted, none)
        return [*settled, *self._alone(settled[:1], singles)]

    def _alone(self, pairs: Sequence[Hypothesis], singles: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return those effects of pairs by themselves that were not fitted alone: one of two may suffice."""
        known = {name for single in singles for name in single.ids}
        return [
            self.settled(self.hypothesis(refit_from(self.model, pair.refit, {name: values})))
            for pair in pairs
            for name, values in pair.refit.effects.items()
            if name not in known
        ]

    def _pairs_beside(self, single: Hypothesis) -> Pairs:
        """Return pairs of a single effect and another one, by what the other gains there."""
        pairs: Pairs = {}
        if FLICKER in single.ids:
            return pairs
        table = self.errors.table(Linearized.of(single.refit, self.errors.rows), self._columns)
        for n, family in enumerate(self._families):
            if family.id in single.ids:
                continue
            names = frozenset((*single.ids, family.id))
            gained = table.log_evidence(n) - single.exact - self._nats(self.policy.ln_odds_further)
            _keep_better(pairs, names, gained, {**single.refit.effects, family.id: family.start})
        return pairs

    def _pairs_alone(self) -> Pairs:
        """Return pairs that beat every single effect at the start, by how much they do."""
        places = [
            self._first_family(score) + n
            for score in self.scores
            for n in range(min(FAMILIES_IN_PAIRS, len(score.families)))
        ]
        alone = max(self._probes.log_evidence(n) for n in range(len(self._families)))
        needed = self._nats(self.policy.ln_odds_further)
        pairs: Pairs = {}
        for first, second in itertools.combinations(places, 2):
            names = frozenset((self._families[first].id, self._families[second].id))
            gained = self._probes.log_evidence(first, second) - alone - needed
            if len(names) == 2:
                starts = {self._families[k].id: self._families[k].start for k in (first, second)}
                _keep_better(pairs, names, gained, starts)
        return pairs


def _keep_better(pairs: Pairs, names: frozenset[str], gained: float, starts: Mapping[str, Values]) -> None:
    """Keep a pair that gains anything, with its best families."""
    if gained > (pairs[names][0] if names in pairs else 0.0):
        pairs[names] = gained, starts
