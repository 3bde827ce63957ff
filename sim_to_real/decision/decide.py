"""The verdict from the hypotheses' scores: no gap, named effects, an ambiguity set, or unknown.

A score is the mean square R of residuals over noise and the model's floor. The floor is generous: a model
without a gap has R below 1. Of the baseline's gap a hypothesis leaves (R - 1) / (R_0 - 1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arrays import Bool, Float64
from sim_to_real.diagnosis import Verdict
from sim_to_real.fit.gauss_newton import FLICKER, MIN_EVIDENCE_NATS, Refit, converged, refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import BIASED_MEAN_SQUARE
from sim_to_real.search.hypothesis import (
    MAX_MISFIT_AT_FLOOR,
    MIN_VISIBLE_MISFIT,
    UNRESOLVED_MEAN_SQUARE,
    Hypothesis,
    bic_penalty_nats,
    cross_validated,
    is_explained,
    likelihood_nats,
    posterior_probabilities,
)
from sim_to_real.search.identifiability import not_resolvable, projected_signatures
from sim_to_real.search.score_test import ScoreTest
from sim_to_real.search.single_effects import (
    INDISTINGUISHABLE_NATS,
    RESOLVED_MEAN_SQUARE,
    Search,
    fit_single_effects,
    score_catalogue,
    told_apart_by_pixels,
    with_expensive,
    with_trends,
)
from sim_to_real.search.stepwise import best_beside

MIN_UNKNOWN_MEAN_SQUARE = 2.0
"""From this mean square on there is a gap, even if no effect of the catalogue helps."""

MIN_POSTERIOR = 0.9
"""A hypothesis that is less probable is not named alone."""

MIN_POSTERIOR_IN_SET = 0.05
"""Hypotheses that are at least as probable are in the ambiguity set."""


@dataclass(frozen=True, eq=False)
class Decision:
    """The verdict, the chosen hypothesis, all single effects that were fitted, and the scores of all effects.

    `posterior_probabilities` (n,) are those of the single effects, `posterior_probability` is the chosen
    one's. `signatures` are the effects' at the start of all fits, `indistinguishable` the pairs whose
    signatures agree.
    """

    verdict: Verdict
    chosen: Hypothesis
    posterior_probability: float
    singles: tuple[Hypothesis, ...]
    posterior_probabilities: Float64
    ambiguous: tuple[tuple[str, ...], ...]
    scores: tuple[ScoreTest, ...]
    signatures: Mapping[str, Float64]
    indistinguishable: tuple[tuple[str, str], ...]


def _unlimited_first(
    model: LinearizedModel, hypotheses: Sequence[Hypothesis], baseline: Hypothesis
) -> list[Hypothesis]:
    """Return single effects, likeliest first, but a bound-limited one behind one that explains the gap.

    That one must be about as likely.
    """
    first = hypotheses[0]
    if not first.is_bound_limited:
        return list(hypotheses)
    near = [rival for rival in hypotheses if first.evidence - rival.evidence < INDISTINGUISHABLE_NATS]
    explaining = [rival for rival in near if is_explained(model, rival, baseline)][:1]
    return [*explaining, *(rival for rival in hypotheses if rival not in explaining)]


def verdict_without_effects(baseline: Hypothesis) -> Verdict:
    """Return the verdict if no effect of the catalogue helps: the cause of a large gap is unknown."""
    return Verdict.NO_GAP if baseline.cv_mean_square < MIN_UNKNOWN_MEAN_SQUARE else Verdict.UNKNOWN


def decide(search: Search, baseline: Hypothesis) -> Decision:
    """Seek the effects that explain the gap of a baseline."""
    model, start = search.model, baseline.refit
    if baseline.cv_mean_square > BIASED_MEAN_SQUARE:
        # A large gap biases the nuisances so far that no effect could fit: start from the stated values.
        model.take_tangents(model.neutral, {})
        start = refit(model, {}, model.neutral, steps=0)
    search.on_stage("looking at every effect", 0.0)
    scores = tuple(score_catalogue(search, start))
    signatures = projected_signatures(start, scores)
    indistinguishable = not_resolvable(signatures)
    if not scores or likelihood_nats(0.0) - bic_penalty_nats(1) - baseline.evidence < MIN_EVIDENCE_NATS:
        # The catalogue is empty, or not even a perfect fit would be preferred to the baseline.
        verdict = verdict_without_effects(baseline)
        none = np.zeros(0)
        return Decision(verdict, baseline, math.nan, (), none, (), scores, signatures, indistinguishable)
    fitted, baseline, is_negligible = _fitted_singles(search, start, scores, baseline)
    explained = is_explained(model, fitted[0], baseline)
    singles = tuple(fitted)
    p = posterior_probabilities(singles, baseline)
    # Below the floor the best of many effects gains something by chance.
    gained = singles[0].evidence - baseline.evidence
    by_chance = baseline.cv_mean_square <= 1.0 and gained < MIN_EVIDENCE_NATS + math.log(len(scores))

    def decision(verdict: Verdict, chosen: Hypothesis, *ambiguous: tuple[str, ...]) -> Decision:
        others = [single for single in singles if single.ids != chosen.ids]
        of_all = posterior_probabilities([chosen, *others], baseline)
        return Decision(
            verdict,
            chosen,
            float(of_all[0]) if chosen.ids else math.nan,
            singles,
            p,
            ambiguous,
            scores,
            signatures,
            indistinguishable,
        )

    if is_negligible:
        return decision(Verdict.NO_GAP, baseline)
    if gained < MIN_EVIDENCE_NATS:
        return decision(verdict_without_effects(baseline), baseline)
    if by_chance and search.with_pixels(baseline).pixel_misfit <= MIN_VISIBLE_MISFIT:
        return decision(Verdict.NO_GAP, baseline)
    best = singles[0]
    if explained:
        best = search.with_pixels(best)
        if best.pixel_misfit > MAX_MISFIT_AT_FLOOR:
            # Pixels are finer than bins: they show a fit that has not quite converged.
            best = search.with_pixels(_converged(model, best))
        singles = (best, *singles[1:])
    joint = best_beside(search, baseline, best, explained, start, scores)
    rivals = _rivals(singles, indistinguishable)
    is_likely = (p >= MIN_POSTERIOR_IN_SET) | rivals
    likely = tuple(single.ids[0] for single, is_one in zip(singles, is_likely, strict=True) if is_one)
    if explained and (joint is None or len(joint.ids) == 1):
        if len(likely) == 1 or (p[0] >= MIN_POSTERIOR and not rivals.any()):
            return decision(Verdict.EFFECTS, best)
        shared = _shared_among_rivals(p, rivals)
        undecided = decision(Verdict.AMBIGUOUS, best, likely)
        return replace(undecided, posterior_probability=float(shared[0]), posterior_probabilities=shared)
    if joint is None:
        return decision(Verdict.UNKNOWN, best)
    if len(joint.ids) == 1 and len(likely) > 1:
        # One effect suffices after it was fitted beside another, but it is no likelier than that one.
        return decision(Verdict.AMBIGUOUS, joint, tuple(dict.fromkeys((*joint.ids, *likely))))
    return decision(Verdict.EFFECTS, joint)


def _fitted_singles(
    search: Search, start: Refit, scores: Sequence[ScoreTest], baseline: Hypothesis
) -> tuple[list[Hypothesis], Hypothesis, bool]:
    """Return single effects, likeliest first, and the baseline, with pixel misfits where bins do not decide.

    The third value says whether a gap that no effect explains shows in bins only, and not in pixels.
    """
    model = search.model
    hypotheses = fit_single_effects(search, start, scores, baseline.cv_mean_square)
    hypotheses, baseline = told_apart_by_pixels(search, hypotheses, baseline)
    hypotheses = _unlimited_first(model, hypotheses, baseline)
    explained = is_explained(model, hypotheses[0], baseline)
    is_open = hypotheses[0].cv_mean_square > RESOLVED_MEAN_SQUARE and not explained
    is_small = (
        baseline.cv_mean_square < MIN_UNKNOWN_MEAN_SQUARE and baseline.pixel_misfit <= MAX_MISFIT_AT_FLOOR
    )
    helps = explained and hypotheses[0].evidence - baseline.evidence >= MIN_EVIDENCE_NATS
    if not is_open and not helps:
        # Bounced light stays near the root: it is little in the mean of all bins, but pixels show it.
        baseline = search.with_pixels(baseline)
        if baseline.pixel_misfit > MIN_VISIBLE_MISFIT:
            hypotheses = with_expensive(search, start, hypotheses)
            hypotheses, baseline = told_apart_by_pixels(search, hypotheses, baseline)
    elif is_open and not is_small:
        hypotheses = with_expensive(search, start, hypotheses)
        if not is_explained(model, hypotheses[0], baseline):
            hypotheses, baseline = _with_trends(search, start, scores, hypotheses, baseline)
    elif explained and hypotheses[0].ids == (FLICKER,):
        # Levels of single frames absorb much of an effect that grows from frame to frame.
        hypotheses, baseline = _with_trends(search, start, scores, hypotheses, baseline)
    return _unlimited_first(model, hypotheses, baseline), baseline, is_open and is_small


def _with_trends(
    search: Search,
    start: Refit,
    scores: Sequence[ScoreTest],
    hypotheses: Sequence[Hypothesis],
    baseline: Hypothesis,
) -> tuple[list[Hypothesis], Hypothesis]:
    """Return single effects of which some may have a trend, likeliest first, and the baseline."""
    singles = with_trends(search, start, scores, hypotheses)
    if not singles[0].refit.trend:
        return singles, baseline
    # Pixels have judged the constant effect, not its trend.
    singles, baseline = told_apart_by_pixels(search, singles, baseline)
    return [search.with_pixels(singles[0]), *singles[1:]], search.with_pixels(baseline)


def _rivals(singles: Sequence[Hypothesis], indistinguishable: Sequence[tuple[str, str]]) -> Bool:
    """Return which effects (n,) remain possible beside the likeliest, the first, however improbable.

    They resolve the gap, with more parameters, where the likeliest does not. Or they explain as much as it
    does and the recording cannot tell them from it: then they are improbable only for their number of
    parameters.
    """
    first = singles[0]
    leaves_some = first.cv_mean_square > UNRESOLVED_MEAN_SQUARE
    look_same = _indistinguishable_from(first.ids[-1], indistinguishable)
    as_much = likelihood_nats(first.cv_mean_square) - MIN_EVIDENCE_NATS

    def is_rival(single: Hypothesis) -> bool:
        if single.is_bound_limited or single is first:
            return False
        resolves = leaves_some and single.cv_mean_square <= RESOLVED_MEAN_SQUARE
        fits_as_well = likelihood_nats(single.cv_mean_square) > as_much
        return resolves or (single.ids[-1] in look_same and fits_as_well)

    return np.array([is_rival(single) for single in singles])


def _indistinguishable_from(name: str, indistinguishable: Sequence[tuple[str, str]]) -> set[str]:
    """Return the effects that the recording cannot tell from one."""
    return {other for pair in indistinguishable if name in pair for other in pair} - {name}


def _shared_among_rivals(probabilities: Float64, rivals: Bool) -> Float64:
    """Return probabilities (n,) of which the first and its rivals share theirs evenly."""
    sharing = rivals.copy()
    sharing[0] = True
    return np.where(sharing, probabilities[sharing].mean(), probabilities)


def _converged(model: LinearizedModel, hypothesis: Hypothesis) -> Hypothesis:
    """Return a hypothesis whose fit has converged."""
    return replace(
        cross_validated(model, converged(model, hypothesis.refit)),
        pixel_penalty_nats=hypothesis.pixel_penalty_nats,
    )


def open_pair(decision: Decision) -> tuple[Hypothesis, Hypothesis] | None:
    """Return the two single effects that a measurement should tell apart; None if nothing is open.

    Of an ambiguity set they are its two likeliest; beside what is named it is the likeliest of those that the
    recording cannot tell from it.
    """
    singles = list(decision.singles)
    if decision.verdict is Verdict.NO_GAP:
        return None
    if decision.verdict is Verdict.AMBIGUOUS:
        singles = [single for single in singles if single.ids[0] in decision.ambiguous[0]]
    elif decision.verdict is Verdict.EFFECTS and singles:
        named = next((single for single in singles if single.ids[-1] in decision.chosen.ids), None)
        if named is None:
            return None
        others = _indistinguishable_from(named.ids[-1], decision.indistinguishable) - set(decision.chosen.ids)
        singles = [named, *(single for single in singles if single.ids[-1] in others)]
    return (singles[0], singles[1]) if len(singles) > 1 else None
