"""Single effects: scored, the best of them fitted, and compared in bins and in pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from noise_model.arrays import Float64
from noise_model.effects import REGISTRY, Values
from sim_to_real.fit.gauss_newton import FLICKER, MIN_EVIDENCE_NATS, Refit, converged, refit, refit_from
from sim_to_real.fit.linearized_model import RENDERED_EFFECTS, Effects, LinearizedModel
from sim_to_real.search.hypothesis import (
    MIN_MEAN_SQUARE,
    Hypothesis,
    bic_penalty_nats,
    by_evidence,
    cross_validated,
    likelihood_nats,
)
from sim_to_real.search.probe_points import EXPENSIVE, FAMILIES
from sim_to_real.search.score_test import ScoreTest, score_effects, score_flicker, score_trends

N_CONVERGED = 3
"""So many of the best are fitted until they converge, with light rendered anew."""

MAX_GAP_RATIO = 4.0
"""Of these none that leaves more than so many times the gap that the best one leaves."""

N_EXPENSIVE_FRAMES, MIN_EXPENSIVE_CLOSED = 4, 0.3
"""An expensive effect is fitted to all frames only if it closes this share of the gap in so many of them."""

RESOLVED_MEAN_SQUARE = 1.1
"""The gap is resolved by what leaves a smaller mean square and closes at least `MIN_CLOSED_SHARE`."""

MAX_REFITS, MAX_REFITS_BESIDE = 8, 4
"""How many effects are fitted after the score test: alone, and beside effects that were chosen."""

MAX_FRACTION_ONCE_RESOLVED, MAX_NATS_BEHIND = 0.3, 20.0
"""Once an effect resolves the gap, another that leaves more than this share at the score test is not fitted.

It is fitted all the same if its evidence at the score test is less than so many nats behind.
"""

MIN_CLOSED_SHARE = 0.5
"""The share of the gap that an effect must close to resolve it."""

MAX_FRACTION_AT_SCORE = 0.9
"""An effect, unless it is the best, is fitted only if it leaves less of the gap at the score test."""

MAX_TRENDS = 3
"""So many trends are fitted: pairs of an effect and a driver."""

INDISTINGUISHABLE_NATS, MAX_INDISTINGUISHABLE = 5.0, 3
"""Hypotheses whose evidence in bins differs by less, so many at most, are compared in pixels.

If none resolves the bins, the first ones are compared, however much they differ.
"""


@dataclass(frozen=True, eq=False)
class Search:
    """Where effects are sought: the model held against frames, and the catalogue less effects `without`.

    `pixel_misfits` returns what fits leave in pixels of validation frames (n,), over the model's floor.
    `on_stage` is told what is being done, and the share of all work that is done.
    """

    model: LinearizedModel
    without: Sequence[str]
    pixel_misfits: Callable[[Sequence[Refit]], Float64]
    on_stage: Callable[[str, float], None]

    def has(self, name: str, beside: Refit) -> bool:
        """Say whether an effect may be added to those of a fit."""
        return name not in self.without and name not in beside.ids

    def with_pixels(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return a hypothesis with its misfit in pixels."""
        if not math.isnan(hypothesis.pixel_misfit):
            return hypothesis
        return replace(hypothesis, pixel_misfit=float(self.pixel_misfits([hypothesis.refit])[0]))


def score_catalogue(search: Search, baseline: Refit) -> list[ScoreTest]:
    """Return the scores of all effects that may be added to a baseline, those that leave least first."""
    ids = [name for name in FAMILIES if search.has(name, baseline)]
    if set(EXPENSIVE) & set(baseline.ids):
        # Bounced light is computed once: it would not follow an effect that renders anew.
        ids = [name for name in ids if name not in RENDERED_EFFECTS]
    return score_effects(search.model, baseline, ids)


def with_flicker(search: Search, baseline: Refit, scores: Sequence[ScoreTest]) -> list[ScoreTest]:
    """Return scores with that of arc_flicker, if it may be added to a baseline."""
    if not search.has(FLICKER, baseline) or not _shows_arc(search.model):
        return list(scores)
    return [*scores, score_flicker(search.model, baseline)]


def fit_single_effects(
    search: Search, baseline: Refit, scores: Sequence[ScoreTest], mean_square: float
) -> list[Hypothesis]:
    """Return hypotheses of one more effect beside a baseline's, likeliest first.

    `mean_square` is what is left without any: a baseline's nuisances may not have been fitted.
    """
    model, mean_square = search.model, min(mean_square, baseline.mean_square)
    gap = mean_square - MIN_MEAN_SQUARE
    # The score test fits nuisances too: its gap without any effect may be smaller than the baseline's.
    unaided = baseline.quadratic.mean_square(baseline.quadratic.solve())
    gap_at_score = max(unaided - MIN_MEAN_SQUARE, gap)
    hypotheses: list[Hypothesis] = []
    if search.has(FLICKER, baseline) and _shows_arc(model):
        effects: dict[str, Values] = {**baseline.effects, FLICKER: REGISTRY[FLICKER].neutral}
        hypotheses.append(cross_validated(model, refit_from(model, baseline, effects)))
    max_refits = MAX_REFITS_BESIDE if baseline.ids else MAX_REFITS
    for n, score in enumerate(scores[:max_refits]):
        max_fraction = (
            MAX_FRACTION_ONCE_RESOLVED
            if _is_resolved(hypotheses, mean_square) and _is_far_behind(score, hypotheses, baseline)
            else MAX_FRACTION_AT_SCORE
        )
        gap_left = score.residual_fraction * baseline.mean_square - MIN_MEAN_SQUARE
        if n and gap_left > max_fraction * gap_at_score:
            continue
        search.on_stage(f"fitting {score.id}", 0.2 + 0.6 * n / max_refits)
        # Rendering at every step is expensive: such a fit is started once.
        is_rendered = bool(RENDERED_EFFECTS & {score.id, *baseline.ids})
        starts = score.starts[:1] if is_rendered else score.starts
        fits = [refit_from(model, baseline, {**baseline.effects, score.id: start}) for start in starts]
        hypotheses.append(cross_validated(model, min(fits, key=lambda fit: fit.mean_square)))
    hypotheses = by_evidence(hypotheses)
    if not _is_resolved(hypotheses, mean_square):
        # Which of the best is best shows only once light is rendered anew where they came to.
        for n, near in enumerate(hypotheses[:N_CONVERGED]):
            least = min(hypothesis.cv_mean_square for hypothesis in hypotheses)
            if near.cv_mean_square - MIN_MEAN_SQUARE > min(gap, MAX_GAP_RATIO * (least - MIN_MEAN_SQUARE)):
                continue
            search.on_stage(f"fitting {near.ids[-1]} again", 0.8 + 0.05 * n)
            hypotheses[n] = cross_validated(model, converged(model, near.refit))
    return by_evidence(hypotheses)


def with_expensive(search: Search, baseline: Refit, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses, likeliest first, with those of expensive effects."""
    model, fitted = search.model, list(hypotheses)
    if model.observed.setup.joint.type == "flat":
        return fitted
    model.take_tangents(baseline.nuisance, baseline.effects, baseline.trend)
    for name, start in EXPENSIVE.items():
        search.on_stage(f"looking at {name}", 0.95)
        effects = {**baseline.effects, name: start}
        if not search.has(name, baseline) or not _closes_enough_in_few(model, baseline, effects):
            continue
        fitted.append(cross_validated(model, converged(model, refit_from(model, baseline, effects))))
    return by_evidence(fitted)


def with_trends(
    search: Search, baseline: Refit, scores: Sequence[ScoreTest], hypotheses: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Return single effects, likeliest first, of which some may have a trend from frame to frame.

    `scores` are those at the baseline. An effect that closes nothing while it is constant may have a trend,
    too. The pixels' penalty of a constant effect does not carry over to its trend.
    """
    model, single = search.model, {hypothesis.ids[0]: hypothesis for hypothesis in hypotheses}
    for trend_score in score_trends(model, baseline, scores)[:MAX_TRENDS]:
        name, driver = trend_score.trend.effect, trend_score.trend.driver
        search.on_stage(f"fitting {name} that changes with {driver.value}", 0.97)
        if name not in single:
            start = next(score.start for score in scores if score.id == name)
            single[name] = cross_validated(model, refit_from(model, baseline, {name: start}))
        fitted = refit(model, {name: trend_score.start}, baseline.nuisance, trend=trend_score.trend)
        with_trend = cross_validated(model, converged(model, fitted))
        steady = single[name]
        min_gain = 0.0 if steady.refit.trend else MIN_EVIDENCE_NATS
        if with_trend.bin_evidence - steady.bin_evidence > min_gain:
            single[name] = with_trend
    return by_evidence(single.values())


def told_apart_by_pixels(
    search: Search, hypotheses: Sequence[Hypothesis], baseline: Hypothesis
) -> tuple[list[Hypothesis], Hypothesis]:
    """Return hypotheses, likeliest first, with a penalty by pixels for those alike in bins; and the baseline.

    Pixels are not predicted if the baseline is likelier than all. A bin shows no blur: to it an effect that
    widens the stripe is much the same as one that dims it.
    """
    best, near = hypotheses[0].evidence, list(hypotheses[:MAX_INDISTINGUISHABLE])
    if best <= baseline.evidence:
        return list(hypotheses), baseline
    if _is_resolved(hypotheses, baseline.cv_mean_square):
        near = [rival for rival in near if best - rival.evidence < INDISTINGUISHABLE_NATS]
        if len(near) < 2:
            return list(hypotheses), baseline
    of_baseline, *misfits = search.pixel_misfits([rival.refit for rival in (baseline, *near)]).tolist()
    # In pixels 1 is the model's floor, and differences below it are chance.
    nats = [likelihood_nats(max(misfit, 1.0)) for misfit in misfits]
    weighed = [
        replace(hypothesis, pixel_misfit=misfit, pixel_penalty_nats=max(nats) - nats_of_pixels)
        for hypothesis, misfit, nats_of_pixels in zip(near, misfits, nats, strict=True)
    ]
    every = by_evidence([*weighed, *hypotheses[len(near) :]])
    return every, replace(baseline, pixel_misfit=of_baseline)


def _closes_enough_in_few(model: LinearizedModel, baseline: Refit, effects: Effects) -> bool:
    """Say whether effects close `MIN_EXPENSIVE_CLOSED` of the gap in a few frames that the arc lights."""
    lit = np.flatnonzero(model.observed.shows_arc)
    if not len(lit):
        return False
    few = model.subset(
        np.isin(np.arange(len(model.observed.frames)), lit[:: -(-len(lit) // N_EXPENSIVE_FRAMES)])
    )
    before = refit_from(few, baseline, baseline.effects).mean_square
    after = refit_from(few, baseline, effects).mean_square
    # Fitted to a few frames alone, nuisances may leave less than the model's floor.
    least = 1.0 if before > 1.0 else MIN_MEAN_SQUARE
    return before - max(after, least) > MIN_EXPENSIVE_CLOSED * (before - least)


def _is_resolved(hypotheses: Sequence[Hypothesis], mean_square: float) -> bool:
    """Say whether one of the hypotheses resolves the gap of a mean square."""
    max_mean_square = min(
        RESOLVED_MEAN_SQUARE, MIN_MEAN_SQUARE + MIN_CLOSED_SHARE * (mean_square - MIN_MEAN_SQUARE)
    )
    return any(
        hypothesis.cv_mean_square <= max_mean_square and not hypothesis.is_bound_limited
        for hypothesis in hypotheses
    )


def score_gain_nats(score: ScoreTest, baseline: Refit) -> float:
    """Return the evidence that an effect would gain beside a baseline's by the score test, nats."""
    mean_square = score.residual_fraction * baseline.mean_square
    gained = likelihood_nats(mean_square) - likelihood_nats(baseline.mean_square)
    return gained - bic_penalty_nats(score.n_parameters)


def _is_far_behind(score: ScoreTest, hypotheses: Sequence[Hypothesis], baseline: Refit) -> bool:
    """Say whether an effect has far less evidence at the score test than another that was fitted."""
    evidence = likelihood_nats(baseline.mean_square) + score_gain_nats(score, baseline)
    return evidence < max(hypothesis.evidence for hypothesis in hypotheses) - MAX_NATS_BEHIND


def _shows_arc(model: LinearizedModel) -> bool:
    return bool(model.observed.shows_arc.sum() > 2)
