"""Search of the hypotheses to fit: those that could still change the posterior.

A first look, without a fit, gives every effect's evidence along its probe points, and every pair's. Effects
are fitted in that order until the next one is too far behind. With the likeliest ones, and in pairs that
explain more than any single effect, further effects are fitted.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from noise_model.calibration_errors import POSE
from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY, Effects, Stage
from noise_model.fit import within_bounds
from sim_to_real.evidence.coordinates import IN_EACH_FRAME
from sim_to_real.evidence.error_model import ErrorModel, LinearHypothesis, SizeColumns
from sim_to_real.evidence.evidence_table import EvidenceTable
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior, Term, UnknownCause
from sim_to_real.evidence.looks import Looks, PairLook
from sim_to_real.evidence.policy import Policy
from sim_to_real.fit.gauss_newton import FLICKER, LEVEL_SIGMA, Refit, refit, refit_at
from sim_to_real.fit.linearized_model import INTERREFLECTION, LinearizedModel
from sim_to_real.fit.nuisances import BIASED_MEAN_SQUARE, N_LEVELS, SEAM_FROM
from sim_to_real.fit.trend import MIN_DRIVER_RANGE, TREND_EFFECTS, Driver, Trend, trend_among
from sim_to_real.search.score_test import EXPENSIVE, ScoreTest

TermEvidence: TypeAlias = Mapping[Term, Sequence[float]]
"""The evidence of each free term, nats, at each size that its columns may have."""

MAX_ROUNDS, SETTLED_NATS = 4, 1.0
"""Largest number of renderings at a fit, and the least gain of evidence for another one."""

SURPRISE_NATS = 4.0
"""Largest gain of a fit over its first look even where the gap is small."""

MUCH_SURPRISE, LITTLE_SURPRISE, FLOOR_MEAN_SQUARE = 0.7, 0.3, 1.0
"""The same gain as a share of the best fit's; the smaller share once a fit leaves no more than the floor."""

MOVING = tuple(name for name, effect in REGISTRY.items() if effect.stage in (Stage.GEOMETRY, Stage.TIMING))
"""Effects that move the image: while an unknown cause of a large gap leads, all of them are fitted.

A linear look predicts little of a stripe that lies elsewhere.
"""

HAND_EYE = "hand_eye"
"""The effect that moves the camera, as the nuisances of its pose do."""

CLEAR_SIGMAS = 3.0
"""A motion that leaves the tolerance's bounds by so many of its own sigmas is more than that."""

POSE_NUISANCES = slice(N_LEVELS, SEAM_FROM)

STARTS_OF_STAND_INS: Mapping[str, Sequence[Effects]] = {
    FLICKER: ({FLICKER: REGISTRY[FLICKER].neutral},),
    INTERREFLECTION: ({INTERREFLECTION: EXPENSIVE[INTERREFLECTION]},),
}
"""Starts of the fits of effects without probe points."""


@dataclass(frozen=True, eq=False)
class HypothesisSearch:
    """Fits hypotheses of a recording: `model` with tangents at `start`, a fit without effects.

    `scores` are the candidates' at the start, `errors` the recording's error model.
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
        linear = LinearHypothesis.of(fitted)
        exact = self.errors.log_evidence(linear)
        if not fitted.ids:
            return Hypothesis(fitted, exact, exact, linear, {})
        none, change = self._without(fitted, None)
        changes, fewer = {}, {}
        for name in fitted.ids:
            others = frozenset(fitted.ids) - {name}
            if others:
                without, change = self._without(fitted, name)
                fewer[others] = self.errors.log_evidence(without)
            if name != FLICKER:
                changes[name] = change
        forms = [self.errors.form_errors(name, change) for name, change in changes.items()]
        off = self.errors.log_evidence_off(linear, forms) if forms else exact
        return Hypothesis(fitted, exact, off, none, fewer, changes=changes)

    def _without(self, fitted: Refit, name: str | None) -> tuple[LinearHypothesis, Float64]:
        """Return a fit without one of its effects, or without any, and what that changes (n,)."""
        effects = {other: values for other, values in fitted.effects.items() if name not in (None, other)}
        lights = self.model.lights(fitted.nuisance, effects, trend_among(fitted.trend, effects))
        if FLICKER in effects:
            by = np.zeros((len(lights), fitted.n_nuisances))
            by[:, 0] = fitted.arc_ln
            frames = self.model.observed.frames
            lights = [self.model.extrapolate(*parts) for parts in zip(frames, lights, by, strict=True)]
        residuals = self.model.residuals(lights)
        without = LinearHypothesis.without(fitted, name, residuals, self.model.nuisance_columns(lights))
        return without, fitted.residuals - residuals

    def none(self, before: Hypothesis, others: Iterable[Hypothesis]) -> Hypothesis:
        """Return no gap about the nuisances of the fit that makes it likeliest.

        Each fit renders light anew at its nuisances: no gap must be compared at the same ones.
        """
        about = [hypothesis.neutral for hypothesis in (before, *others)]
        evidence = [self.errors.log_evidence(neutral) for neutral in about]
        best = int(np.argmax(evidence))
        return Hypothesis(before.refit, evidence[best], evidence[best], about[best], {})

    @staticmethod
    def compared(every: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return hypotheses with their largest evidence of all fits: another fit may have better levels."""
        fewer = [(names, nats) for hypothesis in every for names, nats in hypothesis.fewer.items()]
        return [
            replace(h, exact=max([h.exact, *(nats for names, nats in fewer if names == frozenset(h.ids))]))
            for h in every
        ]

    def free_term_evidence(self, hypothesis: Hypothesis) -> TermEvidence:
        """Return the evidence of each free term about a hypothesis' nuisances."""
        return self._free_terms(self._table(hypothesis.neutral))

    def likely_in_full(self, posterior: Posterior) -> list[Hypothesis]:
        """Return a posterior's hypotheses, the likely ones with all that may be added to their effects.

        That is an unknown cause, and errors of their forms where the effects themselves do nothing.
        """
        weighed = zip(posterior.hypotheses, posterior.p, range(len(posterior.p)), strict=True)
        # The first three are weighed in full, however unlikely they are.
        return [self._in_full(h) if n < 3 or p >= self.policy.possible else h for h, p, n in weighed]

    def _in_full(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return a hypothesis with an unknown cause added to its effects, and more of their forms' errors."""
        linear = LinearHypothesis.of(hypothesis.refit)
        forms = [self.errors.form_error(name, change) for name, change in hypothesis.changes.items()]
        tables = self._table(linear), self._table(linear.extended(*forms))
        exact, off = map(self._free_terms, tables)
        mean = {term: (np.logaddexp(exact[term], off[term]) - math.log(2.0)).tolist() for term in exact}
        apart = [
            table.log_evidence(block, size=size)
            for name, change in hypothesis.changes.items()
            for block, size in self.errors.form_errors_apart(name, change)
            for table in tables
        ]
        if apart:
            nats = float(np.logaddexp.reduce(apart)) - math.log(len(apart))
            hypothesis = replace(hypothesis, off=float(np.logaddexp(hypothesis.off, nats)) - math.log(2.0))
        return replace(hypothesis, with_unknown=self.unknown([mean]))

    def _table(self, linear: LinearHypothesis) -> EvidenceTable:
        return self.errors.table(linear, self.errors.free_blocks)

    def _free_terms(self, table: EvidenceTable) -> TermEvidence:
        """Return the evidence of each free term added to a hypothesis."""
        return {
            (term.stage, term.name): [
                table.log_evidence(*term.blocks, size=size) for size in self.policy.free_sizes
            ]
            for term in self.errors.free_terms.terms
        }

    def unknown(self, term_evidence: Sequence[TermEvidence]) -> UnknownCause:
        """Return an unknown cause: each free term about whichever nuisances make it likeliest.

        A level of the arc in each frame is no unknown cause where a flickering arc is a candidate.
        """
        return UnknownCause(
            {
                term: nats
                for term, nats in likeliest(term_evidence).items()
                if term != (Stage.SOURCE, IN_EACH_FRAME) or FLICKER in self.without
            }
        )

    def singles(self, none: Hypothesis, term_evidence: Sequence[TermEvidence]) -> list[Hypothesis]:
        """Return the single effects whose fit could change the posterior, likeliest first.

        A fit gains on its first look by what is not linear, which is little where the gap is small.
        """
        looks = {score.id: self.looks.evidence(score) - self.looks.none for score in self.scores}
        looks |= {
            name: look - none.evidence for name, look in self._stand_ins(likeliest(term_evidence)).items()
        }
        starts: dict[str, Sequence[Effects]] = {**STARTS_OF_STAND_INS}
        starts |= {score.id: self.looks.starts_of(score) for score in self.scores}
        fitted: list[Hypothesis] = []
        unknown, is_large = self.unknown(term_evidence).evidence, self.start.mean_square > BIASED_MEAN_SQUARE
        # Light that bounces comes last: what others explain better than free terms near it needs no fit.
        max_fits = 10
        ranked = sorted(looks.keys() - {INTERREFLECTION}, key=lambda name: (-looks[name], name))[:max_fits]
        moving = [name for name in MOVING if name in looks and name not in ranked]
        for n, name in enumerate([*ranked, *moving, *(looks.keys() & {INTERREFLECTION})]):
            gained = max((hypothesis.evidence - none.evidence for hypothesis in fitted), default=0.0)
            at_floor = any(hypothesis.refit.mean_square < FLOOR_MEAN_SQUARE for hypothesis in fitted)
            share = LITTLE_SURPRISE if at_floor else MUCH_SURPRISE
            if name == INTERREFLECTION and looks[name] < gained:
                continue
            is_open = name in MOVING and is_large and gained < unknown - none.evidence
            if looks[name] < self._needed((1.0 - share) * gained) and not is_open:
                continue
            self.on_stage(f"fitting {name}", 0.2 + 0.6 * n / max_fits)
            if name == INTERREFLECTION:
                bouncing_s = self.model.bouncing_s(self.start.nuisance, starts[name][0])
                self.on_stage(f"fitting {name}, for {bouncing_s:.0f} s or so", 0.2 + 0.6 * n / max_fits)
            fitted.append(self.hypothesis(self.fit(starts[name], self.start.nuisance)))
        settled = self._settled(self.approached(fitted), unknown)
        trends = [trend for single in settled[:3] for trend in self._with_trends(single)]
        return sorted([*self._settled(trends, unknown), *settled], key=_evidence, reverse=True)

    def approached(self, fitted: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return fits; if all are far off, the likeliest are refitted from their results.

        Where every fit leaves a mean square that biases nuisances, light was not linear between start and
        fit. A narrower stripe that lies elsewhere converges in some steps; a cause that the catalogue lacks
        does not.
        """
        every = sorted(fitted, key=_evidence, reverse=True)
        if any(hypothesis.refit.mean_square < BIASED_MEAN_SQUARE for hypothesis in every):
            return every
        for n, far in enumerate(every[:3]):
            for _ in range(MAX_ROUNDS):
                near = refit_at(self.model, far.refit, self.errors.loss.about)
                # Continue only while a step removes 30 % of what was left.
                if near.mean_square > 0.7 * far.refit.mean_square:
                    break
                every[n] = far = self.hypothesis(near)
        return every

    def _needed(self, near_best: float) -> float:
        """Return the gain over no gap from which on a fit could still change the posterior, nats.

        It must come near the best one, and make up for its prior odds.
        """
        return max(near_best, self._nats(self.policy.ln_odds_effect)) - SURPRISE_NATS

    def _nats(self, ln_odds: float) -> float:
        """Return the evidence, nats, that makes up for the prior odds of one more effect of the catalogue."""
        return self.policy.temperature * (float(np.log(max(len(self.scores), 1))) - ln_odds)

    def _settled(self, fitted: Sequence[Hypothesis], rival: float) -> list[Hypothesis]:
        """Return hypotheses, likeliest first; those that may be the likeliest are rendered until they
        converge.

        A new rendering changes a fit's evidence by a share of its misfit, so a fit far behind stays behind.
        `rival` is the evidence of a competitor that needs no convergence.
        """
        every, settled = list(fitted), 0
        while settled < len(every):
            # Those that have settled come first among equals: each settles once.
            every[settled:] = sorted(every[settled:], key=_evidence, reverse=True)
            best = max(rival, *(hypothesis.evidence for hypothesis in every))
            if every[settled].evidence < best - self._nats_possible:
                break
            every[settled] = self.settled(every[settled])
            settled += 1
        return sorted(every, key=_evidence, reverse=True)

    @cached_property
    def looks(self) -> Looks:
        """The first look, from which fits start."""
        return Looks(LinearHypothesis.of(self.start), self.start.nuisance, self.scores, self.errors)

    @property
    def _nats_possible(self) -> float:
        """Largest deficit of a hypothesis that still has a part of the posterior, nats."""
        return -self.policy.temperature * math.log(self.policy.possible) + SURPRISE_NATS

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
                changing = self.fit([fit.effects], fit.nuisance, trend)
                fitted.append(self.hypothesis(changing))
        return fitted

    def _stand_ins(self, free: Mapping[Term, float]) -> dict[str, float]:
        """Return the first looks of effects that have no probe points: free terms stand in for them.

        Those are a level of the arc for each frame, and light that bounces, which takes longer to compute
        than all other effects together.
        """
        is_flat = self.model.observed.setup.joint.type == "flat"
        looks = {}
        if self._may_flicker:
            looks[FLICKER] = free[Stage.SOURCE, IN_EACH_FRAME]
        if self.model.observed.shows_arc.any() and not is_flat and INTERREFLECTION not in self.without:
            # Light that bounces is a function of several stages' coordinates: any of them may come nearest.
            looks[INTERREFLECTION] = max(
                nats
                for (stage, _), nats in free.items()
                if stage in (Stage.SURFACE, Stage.MEDIUM, Stage.OPTICS)
            )
        return looks

    def fit(self, starts: Sequence[Effects], nuisance: Float64, trend: Trend | None = None) -> Refit:
        """Return the likeliest fit of effects from some starts, light extrapolated from the start's.

        A linear extrapolation may fail far from its origin: the fit starts where the cost is smallest.
        """
        loss = self.errors.loss

        def cost(effects: Effects) -> float:
            return loss.cost(self.model.residuals(self.model.lights(nuisance, effects, trend)))

        best = min(starts, key=cost) if len(starts) > 1 else starts[0]
        return refit(self.model, best, nuisance, trend=trend, loss_about=loss.about)

    def settled(self, best: Hypothesis) -> Hypothesis:
        """Return a hypothesis about its likeliest parameters, light rendered again there until it stays."""
        for _ in range(MAX_ROUNDS):
            again = refit_at(self.model, best.refit, self.errors.loss.about)
            before, best = best, self.hypothesis(again)
            if abs(best.exact - before.exact) < SETTLED_NATS:
                break
        return best

    def pairs(self, singles: Sequence[Hypothesis], rival: float) -> list[Hypothesis]:
        """Return fits of the pairs of effects that explain more than any single effect does, by a first look.

        If two effects of similar size act together, the likeliest single effect is often a third one that
        mimics both. So pairs are looked at on their own, and with the likeliest single effect.
        """
        if not singles:
            return []
        best, needed = singles[0], self._nats(self.policy.ln_odds_further)
        looks = self.looks.pairs_with(best.refit, best.exact, needed)
        if best.refit.mean_square > FLOOR_MEAN_SQUARE:
            known = {look.ids for look in looks}
            looks += [look for look in self.looks.pairs_alone(needed) if look.ids not in known]
            looks += self._flicker_with(best, needed)
        fitted = []
        for look in looks:
            self.on_stage(f"fitting {' and '.join(sorted(look.ids))}", 0.8)
            trend = trend_among(best.refit.trend, look.starts[0])
            fitted.append(self.hypothesis(self.fit(look.starts, look.nuisance, trend)))
        settled = self._settled(fitted, max(rival, best.evidence))
        alone = [single for pair in settled[:1] for single in self._alone(pair, singles)]
        return [*settled, *self._settled(alone, max(rival, best.evidence))]

    def within_tolerance(self, every: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the likely hypotheses of a camera that moved without that, where its tolerance allows it.

        The camera's pose is a nuisance as well, and a fit of the nuisances alone may end beside their best
        values. They take over the motion that was found, and are fitted anew from there.
        """
        if not every:
            return []
        best, fitted = max(map(_evidence, every)), []
        for hypothesis in every:
            fit = hypothesis.refit
            if HAND_EYE not in fit.ids or hypothesis.evidence < best - self._nats_possible:
                continue
            moved = fit.nuisance.copy()
            moved[POSE_NUISANCES] += [fit.effects[HAND_EYE][name] for name in POSE]
            nuisance = within_bounds(self.model.nuisances, moved)
            sigmas = np.array([fit.sigmas[HAND_EYE][name] for name in POSE])
            if np.any(np.abs(nuisance - moved)[POSE_NUISANCES] > CLEAR_SIGMAS * sigmas):
                continue
            others = {name: values for name, values in fit.effects.items() if name != HAND_EYE}
            trend = trend_among(fit.trend, others)
            there = self.model.anchored_at(nuisance, others, trend)
            anew = refit(there, others, nuisance, trend=trend, loss_about=self.errors.loss.about)
            fitted.append(self.settled(self.hypothesis(anew)))
        return fitted

    def _flicker_with(self, best: Hypothesis, needed: float) -> list[PairLook]:
        """Return a flickering arc added to an effect, where a first look says that it gains enough, nats."""
        if not self._may_flicker or FLICKER in best.ids:
            return []
        levels = self.errors.free_terms.columns_of(Stage.SOURCE, IN_EACH_FRAME)
        look = self.errors.log_evidence(
            LinearHypothesis.of(best.refit), SizeColumns.free(LEVEL_SIGMA * levels)
        )
        if look - best.exact < needed:
            return []
        both = {**STARTS_OF_STAND_INS[FLICKER][0], **best.refit.effects}
        return [PairLook([both], best.refit.nuisance)]

    @property
    def _may_flicker(self) -> bool:
        """True if a flickering arc is a candidate: with two frames none could be separated from a level."""
        return int(self.model.observed.shows_arc.sum()) > 2 and FLICKER not in self.without

    def _alone(self, pair: Hypothesis, singles: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return single fits of a pair's effects that were not fitted alone: one of the two may suffice.

        It must keep most of the pair's gain.
        """
        known = {name for single in singles for name in single.ids}
        needed = self._needed((1.0 - LITTLE_SURPRISE) * (pair.exact - self.looks.none))
        return [
            self.hypothesis(self.fit([{name: values}], pair.refit.nuisance))
            for name, values in pair.refit.effects.items()
            if name not in known and pair.fewer[frozenset({name})] - self.looks.none >= needed
        ]


def best_of_each(every: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the likeliest of several fits of the same effects, in the order of their first ones."""
    best: dict[tuple[frozenset[str], object], Hypothesis] = {}
    for hypothesis in every:
        trend = hypothesis.refit.trend
        key = frozenset(hypothesis.ids), None if trend is None else (trend.effect, trend.driver)
        best[key] = max(best.get(key, hypothesis), hypothesis, key=_evidence)
    return list(best.values())


def likeliest(term_evidence: Sequence[TermEvidence]) -> dict[Term, float]:
    """Return the evidence of each free term, nats, about whichever nuisances make it likeliest."""
    evidence: dict[Term, float] = {}
    for term in term_evidence[0]:
        of_sizes = np.max([free_terms[term] for free_terms in term_evidence], axis=0)
        evidence[term] = float(np.logaddexp.reduce(of_sizes) - np.log(len(of_sizes)))
    return evidence


def _evidence(hypothesis: Hypothesis) -> float:
    return hypothesis.evidence
