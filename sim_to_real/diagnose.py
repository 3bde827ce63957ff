"""The diagnosis of a recording: is there a gap, which effects cause it, how far it shrinks with them."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from noise_model.effects import REGISTRY
from noise_model.setup import Setup
from sim_to_real.baseline import OnStage, fit_baseline, silent
from sim_to_real.data.binned import ObservedRecording, PoseAt
from sim_to_real.decision.describe_unknown import describe_unknown
from sim_to_real.decision.holdout_gap import excess_map, measure_gap, predict_holdout
from sim_to_real.decision.model_test import model_test
from sim_to_real.decision.next_experiment import next_measurement
from sim_to_real.decision.recording_cost import RecordingCost, found_effects
from sim_to_real.decision.seam_error import seam_errors_mm
from sim_to_real.decision.unknown_experiment import unknown_experiment
from sim_to_real.diagnosis import (
    NO_GAP,
    Diagnosis,
    DiagnosisVerdict,
    Gap,
    HeldOutPrediction,
    NamedEffect,
    Next,
    ParameterEstimate,
    RankedEffect,
    Reason,
    ReportedTrend,
    UnknownDescription,
    excluded_effects,
)
from sim_to_real.evidence.confidence import (
    cause_probability,
    closed_in_bins,
    gap_in_bins,
    need_probability,
)
from sim_to_real.evidence.error_model import LinearHypothesis
from sim_to_real.evidence.free_functions import FreeFunctions, all_families, locate
from sim_to_real.evidence.hypotheses import Hypothesis, Posterior, UnknownCause
from sim_to_real.evidence.policy import POLICY, Policy
from sim_to_real.evidence.weigh import Judgement, WeightedHypotheses, judge, weigh
from sim_to_real.fit.covariates import Covariates, covariates
from sim_to_real.fit.gauss_newton import Refit, refit, refit_at
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.trend import trend_among
from sim_to_real.variance.random_effects import RandomEffects, random_effects
from tracker.state import Frame


def diagnose(
    setup: Setup,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    *,
    without: Sequence[str] = (),
    on_stage: OnStage | None = None,
    threads: int = 1,
    policy: Policy = POLICY,
) -> Diagnosis:
    """Diagnose a recording's frames; `without` takes effects out of the catalogue, see `excluded_effects`.

    `on_stage` is called with the stage's name and the share of the work done. Frames are predicted on
    `threads` threads; one is best where other processes run. `policy` has the judgement's constants.

    A setup without arc, filter or metal leaves out the effects that need them. The metal is then the one that
    the stripe shows.

    Raises ValueError for a frame with the arc on where arc, filter or metal is missing, for an unknown
    effect, if no frame has a pose, if no frame can be held out of the fit, and if nothing in the frames can
    be compared.
    """
    n_lit = sum(frame.arc_on and not frame.current_a <= 0.0 for frame in frames)
    if n_lit:
        lit = f"the diagnosis of the {n_lit} of {len(frames)} frames whose arc_on is 1 in frames.csv"
        setup.require(lit, "arc", "filter", "material")
    for name in without:
        if name not in REGISTRY:
            raise ValueError(f"{name}: no such effect, there are {', '.join(REGISTRY)}")
    # Many small matrices: the threads of BLAS would wait for each other longer than they compute.
    with threadpool_limits(1, user_api="blas"):
        tell = _never_falling(on_stage or silent)
        return _diagnose(setup, frames, pose_at, excluded_effects(setup, without), tell, threads, policy)


def _diagnose(
    setup: Setup,
    frames: Sequence[Frame],
    pose_at: PoseAt,
    without: Sequence[str],
    tell: OnStage,
    threads: int,
    policy: Policy,
) -> Diagnosis:
    baseline = fit_baseline(setup, frames, pose_at, threads, without, tell)
    model, before, random_before = baseline.model, baseline.fitted, baseline.random
    tell("looking at every effect", 0.1)
    of_bins = covariates(model, before)
    weighed = weigh(
        model, before, of_bins, without, lambda text, share: tell(text, 0.1 + 0.6 * share), policy
    )
    tell("predicting the frames held out", 0.75)
    held_out_frames = HeldOut(
        setup=setup,
        frames=frames,
        pose_at=pose_at,
        observed=baseline.held_out,
        model=model,
        before=before,
        without=without,
        tell=tell,
    )
    assessed = held_out_frames.assess(judge(weighed.posterior, policy))
    while assessed.is_refuted:
        weighed = weighed.without(assessed.judgement.leader)
        assessed = held_out_frames.assess(judge(weighed.posterior, policy))
    judgement, after, random, predicted, gap, _ = assessed
    verdict = _with_random_effects(
        judgement.verdict, random, random_effects(model, before, ()) if without else random, without
    )
    p_cause = 1.0
    if judgement.leader.ids:
        p_cause = cause_probability(judgement.leader, weighed.posterior, policy.cause)
    verdict = weaken(verdict, gap, p_cause, policy)
    tell("locating the gap", 0.9)
    effects: tuple[NamedEffect, ...] = ()
    if verdict is not DiagnosisVerdict.NO_GAP:
        effects = _named_effects(judgement, after, weighed, p_cause, random, random_before)
    none, leader = weighed.posterior.none.neutral, judgement.leader.refit
    named = LinearHypothesis.of(leader) if leader.ids else none
    families = all_families(of_bins, weighed.bins)
    functions = FreeFunctions.of(weighed.errors, families, none, named, weighed.policy)
    stages = weighed.posterior.unknown.stages(weighed.policy.temperature)
    stage = effects[0].stage if effects else max(stages, key=lambda name: stages[name])
    # The gap's location: the first named effect's stage, or the unknown cause's likeliest.
    where = locate(functions, of_bins, before.residuals, stage, stages, excess_map(predicted))
    tell("costing the seam", 0.95)
    likely = found_effects(weighed.posterior, after, random, [effect.id for effect in effects])
    costs = RecordingCost(frames, model, baseline.held_out, after).of_each(likely, weighed.smallest_values)
    unknown, measurement = _unknown_and_next(model, weighed, verdict, leader, of_bins, functions)
    tell("done", 1.0)
    return Diagnosis(
        verdict=verdict,
        effects=effects,
        ranking=ranking(weighed, p_cause, random),
        ambiguous_with=judgement.ambiguous,
        gap=gap,
        where=where,
        next=measurement,
        not_resolvable=weighed.not_resolvable,
        smallest=weighed.smallest,
        left_over=functions.left_over,
        after_with=(*after.ids, *random.effects),
        predicted=predicted,
        model_test=model_test(gap, weighed.posterior, random_before),
        reasons=reasons(weighed.posterior),
        costs=costs,
        unknown=unknown,
    )


class Assessment(NamedTuple):
    """Judgement on frames held out: its fit, random effects, predictions, the gap.

    `idle` are the effects that explain nothing there which the others do not explain.
    """

    judgement: Judgement
    after: Refit
    random: RandomEffects
    predicted: HeldOutPrediction
    gap: Gap
    idle: tuple[str, ...]

    @property
    def is_refuted(self) -> bool:
        """True if an effect explains nothing of the frames held out."""
        return bool(self.idle)


class HeldOut(NamedTuple):
    """Frames held out of all fits, and what predicts them: the model of the others, the fit before."""

    setup: Setup
    frames: Sequence[Frame]
    pose_at: PoseAt
    observed: ObservedRecording
    model: LinearizedModel
    before: Refit
    without: Sequence[str]
    tell: OnStage

    def assess(self, judgement: Judgement) -> Assessment:
        """Return a judgement on these frames, its effects fitted to all bins as the fit before is."""
        fitted = judgement.leader.refit
        after = refit_at(self.model, fitted) if fitted.ids else self.before
        random = random_effects(self.model, after, self.without)
        predicted = predict_holdout(
            self.observed,
            self.model,
            (self.before, {}),
            (after, random.effects),
            lambda done: self.tell("predicting the frames held out", 0.75 + 0.15 * done),
        )
        seam = seam_errors_mm(self.setup, self.frames, self.pose_at, self.model, after)
        gap = measure_gap(predicted, self.setup, seam)
        idle = after.ids if gap.explains_nothing else self.idle(after, random)
        return Assessment(judgement, after, random, predicted, gap, idle)

    def idle(self, after: Refit, random: RandomEffects) -> tuple[str, ...]:
        """Return the effects of several without which these frames are predicted as well."""
        if len(after.ids) < 2:
            return ()
        return tuple(name for name in after.ids if self.gap_without(name, after, random).explains_nothing)

    def gap_without(self, name: str, after: Refit, random: RandomEffects) -> Gap:
        """Return the gap with all of a fit's effects but one, fitted anew from its result, and with all."""
        effects = {other: values for other, values in after.effects.items() if other != name}
        trend = trend_among(after.trend, effects)
        there = self.model.anchored_at(after.nuisance, effects, trend)
        fewer = refit(there, effects, after.nuisance, trend=trend)
        predicted = predict_holdout(
            self.observed, self.model, (fewer, random.effects), (after, random.effects), lambda done: None
        )
        return measure_gap(predicted, self.setup)


def _never_falling(on_stage: OnStage) -> OnStage:
    """Return a listener whose share of work never falls: a search may start a further round."""
    largest = 0.0

    def tell(text: str, share: float) -> None:
        nonlocal largest
        largest = max(largest, share)
        on_stage(text, largest)

    return tell


def _with_random_effects(
    verdict: DiagnosisVerdict, random: RandomEffects, all_random: RandomEffects, without: Sequence[str]
) -> DiagnosisVerdict:
    """Return the verdict with random effects: named with others, or alone where nothing else is wrong.

    `all_random` are those found with nothing withheld: a gap that only a withheld one explains is unknown.
    """
    if verdict is not DiagnosisVerdict.NO_GAP:
        return verdict
    if random.effects:
        return DiagnosisVerdict.EFFECTS
    return DiagnosisVerdict.UNKNOWN if set(all_random.effects) & set(without) else verdict


def weaken(verdict: DiagnosisVerdict, gap: Gap, p_cause: float, policy: Policy) -> DiagnosisVerdict:
    """Return the verdict, or unknown where what it says is not all.

    No gap is not all where held-out frames show a clear gap: the evidence has no bounds for nuisances, and
    may explain bins by values that no fit reaches. Effects are not all where they close less than
    `policy.explained` there, or where they more probably mimic something unknown.
    """
    if verdict is DiagnosisVerdict.NO_GAP:
        return DiagnosisVerdict.UNKNOWN if gap.is_clear_after else verdict
    is_open = gap.closed < policy.explained or p_cause < 0.5
    return DiagnosisVerdict.UNKNOWN if is_open else verdict


def _named_effects(
    judgement: Judgement,
    after: Refit,
    weighed: WeightedHypotheses,
    p_cause: float,
    random: RandomEffects,
    random_before: RandomEffects,
) -> tuple[NamedEffect, ...]:
    """Return the effects that are named, as fitted, and random effects, the largest share first.

    Of an ambiguous verdict they are those of the likeliest hypothesis. `p_cause` is the probability that they
    mimic nothing unknown.
    """
    posterior = weighed.posterior
    shown = after.ids if judgement.verdict is DiagnosisVerdict.AMBIGUOUS else judgement.named
    effects = {name: values for name, values in after.effects.items() if name in shown}
    sigmas = {**after.sigmas, **random.sigmas}
    need = {name: need_probability(name, judgement.leader, posterior, weighed.policy.need) for name in shown}
    of_each = {name: p_cause * need.get(name, 1.0) * p for name, p in posterior.of_each.items()}
    confidence = {**random.confidence, **of_each}
    share = _with_random_shares(shares(posterior, judgement.leader), random_before, random)
    named = [
        NamedEffect(
            name,
            REGISTRY[name].stage.value,
            confidence[name],
            share[name],
            {
                parameter.name: ParameterEstimate(
                    values[parameter.name], sigmas[name][parameter.name], parameter.unit
                )
                for parameter in REGISTRY[name].parameters
                if parameter.name in values
            },
            _trend(after, name),
        )
        for name, values in {**effects, **random.effects}.items()
    ]
    return tuple(sorted(named, key=lambda effect: -effect.share))


def _next(model: LinearizedModel, weighed: WeightedHypotheses, verdict: DiagnosisVerdict) -> Next | None:
    """Return the next measurement where effects are in question, or the cause is unknown."""
    if verdict is DiagnosisVerdict.NO_GAP:
        return None
    is_unknown = verdict is DiagnosisVerdict.UNKNOWN
    measure = partial(next_measurement, model, weighed.posterior, weighed.errors, weighed.policy)
    # Of a set whose further members are hardly probable the nearest are to be told apart.
    return measure(is_unknown) or measure(verdict is DiagnosisVerdict.AMBIGUOUS)


def _unknown_and_next(
    model: LinearizedModel,
    weighed: WeightedHypotheses,
    verdict: DiagnosisVerdict,
    leader: Refit,
    of_bins: Covariates,
    functions: FreeFunctions,
) -> tuple[UnknownDescription | None, Next | None]:
    """Return the description of an unknown cause, None without one, and the next measurement."""
    asked = _next(model, weighed, verdict)
    if verdict is not DiagnosisVerdict.UNKNOWN:
        return None, asked
    errors, policy = weighed.errors, weighed.policy
    fitted = leader if leader.ids else weighed.posterior.none.refit
    compared = of_bins.subset(weighed.bins)
    unknown = describe_unknown(model, compared, fitted, functions, errors, policy)
    if asked is None or not asked.resolves or not has_rivals(weighed):
        asked = unknown_experiment(model, compared, fitted, errors, unknown.terms, policy)
    return unknown, asked


def has_rivals(weighed: WeightedHypotheses) -> bool:
    """Return True if two effects or more may be the whole cause."""
    probabilities = weighed.posterior.of_effects.values()
    return sum(p >= weighed.policy.possible for p in probabilities) > 1


def shares(posterior: Posterior, leader: Hypothesis) -> dict[str, float]:
    """Return each effect's share of the gap that all close together: Shapley's value (1953)."""
    names = leader.ids
    if len(names) < 2:
        return dict.fromkeys(names, 1.0)
    alone = {name: single.refit.mean_square for name, (single, _) in posterior.singles.items()}
    before, after = posterior.none.refit.mean_square, leader.refit.mean_square
    floor = min(1.0, after)

    def size(mean_square: float) -> float:
        return math.sqrt(max(mean_square - floor, 0.0))

    first, second = names
    total = max(size(before) - size(after), 1e-9)
    # What was not fitted alone closes nothing by itself.
    closes = [size(before) - size(min(alone.get(name, before), before)) for name in (first, second)]
    of_first = 0.5 * (closes[0] + total - closes[1]) / total
    of_first = float(np.clip(of_first, 0.0, 1.0))
    return {first: of_first, second: 1.0 - of_first}


def _trend(after: Refit, name: str) -> ReportedTrend | None:
    """Return an effect's trend over the recording, None if it is constant."""
    trend = after.trend
    if trend is None or trend.effect != name:
        return None
    low, high = trend.values_at_ends(after.effects[name])
    return ReportedTrend(
        trend.driver.value,
        trend.driver.unit,
        trend.middle - trend.half_range,
        trend.middle + trend.half_range,
        {name: (low[name], high[name]) for name in low},
    )


def _with_random_shares(
    share: Mapping[str, float], before: RandomEffects, random: RandomEffects
) -> dict[str, float]:
    """Return the shares of all named effects; a random effect has its share of the gap before any fit."""
    of_random = {name: 1.0 - (1.0 - before.closed[name]) ** 2 for name in before.effects}
    scatters = {name: of_random.get(name, 0.0) for name in random.effects}
    rest = max(1.0 - sum(scatters.values()), 0.0) if share else 0.0
    total = rest + sum(scatters.values())
    of_all = {**{name: rest * part for name, part in share.items()}, **scatters}
    # What has no share of a gap, compression, is all that there is.
    return {name: part / total if total > 0.0 else 1.0 / len(of_all) for name, part in of_all.items()}


def ranking(weighed: WeightedHypotheses, p_cause: float, random: RandomEffects) -> tuple[RankedEffect, ...]:
    """Return all single effects, best first, with the share of the gap's size that each closes.

    `p_cause` is the probability that what leads mimics nothing unknown.
    """
    posterior = weighed.posterior
    ranked = []
    for name, (single, p) in posterior.singles.items():
        rest = gap_in_bins(single, posterior)
        effect = RankedEffect(name, p_cause * p, closed_in_bins(single, posterior), left_sigma=rest)
        ranked.append((single.evidence - posterior.none.evidence, effect))
    ranked += [
        (
            random.evidence[name],
            RankedEffect(name, random.confidence[name], random.closed[name], is_random=True),
        )
        for name in random.evidence
    ]
    return tuple(candidate for _, candidate in sorted(ranked, key=lambda pair: -pair[0]))


def reasons(posterior: Posterior) -> tuple[Reason, ...]:
    """Return no gap, an unknown cause and the likeliest hypotheses with effects, the most probable first."""
    none, unknown = posterior.none.evidence, posterior.unknown.evidence
    some = list(zip(posterior.hypotheses, posterior.p, posterior.p_with_unknown, strict=True))
    added = [h.with_unknown.evidence for h in posterior.hypotheses if h.with_unknown is not None]
    best = max([none, unknown, *added, *(h.evidence for h in posterior.hypotheses)]) - none
    compared = [
        Reason(NO_GAP, (), 0.0, best, posterior.p_none),
        Reason(_unknown_text(posterior.unknown), (), unknown - none, best, posterior.p_alone),
    ]
    for hypothesis, p, p_with_unknown in some[:6]:
        words = _hypothesis_text(hypothesis.refit)
        compared.append(Reason(words, hypothesis.ids, hypothesis.evidence - none, best, p))
        if (with_unknown := hypothesis.with_unknown) is not None:
            words = f"{words} beside {_unknown_text(with_unknown)}"
            compared.append(Reason(words, hypothesis.ids, with_unknown.evidence - none, best, p_with_unknown))
    return tuple(sorted(compared, key=lambda reason: (-reason.probability, -reason.evidence)))


def _unknown_text(unknown: UnknownCause) -> str:
    stage, term = unknown.likeliest
    return f"unknown: {term}" if stage is None else f"unknown: {stage.value}, {term}"


def _hypothesis_text(fitted: Refit) -> str:
    trend = fitted.trend
    changing = {} if trend is None else {trend.effect: f" that changes with {trend.driver.value}"}
    return " and ".join(name + changing.get(name, "") for name in fitted.ids)
